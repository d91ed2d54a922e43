"""A body moved by a stepper for contact, beside blocks of first order."""

import jax
import jax.numpy as jnp
import pytest

from sorojax import rod as R, systems
from sorojax.math.lie import SE2
from sorojax.units import kPa, mm


class Bladder(R.AbstractChamber):
    """Gas on one side of a finger."""

    ports = ()

    def volume(self, q):
        return 4e-6 + 2e-7 * q[0]


def finger():
    """A finger with its gas and its valve."""
    rod = R.rod(
        SE2(),
        R.constant("kappa_z"),
        R.circle(5 * mm),
        length=80 * mm,
        young_modulus=1e6,
        poisson_ratio=0.4,
        density=1100.0,
        nodes=6,
    )
    body = R.assembly(SE2(), finger=R.Part(rod))
    forces = (R.Gravity(), R.Damping(0.02), R.PartForce("finger", Bladder()))
    kinds = ("volume", "volume_rate", "compliance")
    return systems.Network(
        {
            "body": systems.AssemblyBody(body, forces),
            "air": systems.Reservoir(),
            "valve": systems.Regulator(4e-9, integral_gain=2e-8),
        },
        {
            "air.mass_flow": "valve.mass_flow",
            "valve.pressure": "air.pressure",
            "body.finger_pressure": "air.pressure",
        }
        | {f"air.{kind}": f"body.finger_{kind}" for kind in kinds},
        ("valve.setpoint",),
    )


def test_it_moves_as_the_whole_network_does():
    network, setpoint = finger(), {"valve.setpoint": jnp.asarray(20 * kPa)}
    film = systems.simulate(network, 0.2, inputs=setpoint, save=2)
    want = film.state["body"]["q"][-1], film.state["air"][-1]
    misses = []
    for substeps in (5, 10):
        move, now = systems.partitioned(network, 0.01, substeps=substeps)
        for _ in range(20):
            now = move(now, setpoint)
        got = now.state["body"]["q"], now.state["air"]
        misses.append(
            [
                float(jnp.max(jnp.abs(a - b) / jnp.abs(b)))
                for a, b in zip(got, want, strict=True)
            ]
        )
    assert float(now.time) == pytest.approx(0.2)
    assert max(misses[1]) < 0.01
    assert misses[1][0] < 0.7 * misses[0][0]  # of order 1
    assert jax.tree.structure(now.state) == jax.tree.structure(network.initial_state())


def test_it_wants_a_body():
    with pytest.raises(ValueError, match="need the name of one among"):
        systems.partitioned(finger(), 0.01, body="air")
