"""A finite-element tube and a rod finger on one air volume, in one network."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R, systems as S
from sorojax.math.lie import SE2
from sorojax.math.status import Status
from sorojax.units import mm
from tests.test_systems_fem import ATMOSPHERE, _breathing, tube

DURATION, STEPS = 2e-4, 40
OPTIONS = {"save": 5, "step": DURATION / STEPS}


class Bladder(R.AbstractChamber):
    """Gas on one side of the finger."""

    ports = ()

    def volume(self, q):
        return 2e-7 + 1e-8 * q[0]


def finger(modulus=1e6):
    rod = R.rod(
        SE2(),
        R.constant("kappa_z"),
        R.circle(1 * mm),
        length=10 * mm,
        young_modulus=modulus,
        poisson_ratio=0.4,
        density=1100.0,
        nodes=6,
    )
    return S.RodBody(rod, (Bladder(),))


def sharing(tube_modulus=1e6, rod_modulus=1e6, speed=3.0):
    """Both bodies on a sealed reservoir of 5 kPa, whose volume is the sum of theirs."""
    blocks = {
        "tube": tube(modulus=tube_modulus, speed=speed),
        "finger": finger(rod_modulus),
        "air": S.Reservoir(start_pressure=5e3),
        "volume": S.sum_of([1, 1], unit="m^3"),
        "rate": S.sum_of([1, 1], unit="m^3/s"),
    }
    wires = {
        "tube.pressure": "air.pressure",
        "finger.pressure": "air.pressure",
        "volume.a": "tube.volume",
        "volume.b": "finger.volume",
        "rate.a": "tube.volume_rate",
        "rate.b": "finger.volume_rate",
        "air.volume": "volume.value",
        "air.volume_rate": "rate.value",
        "air.compliance": "finger.compliance",
    }
    return S.Network(blocks, wires)


@pytest.mark.slow
def test_gas_tube_and_finger_exchange_no_more_than_there_is():
    """Pressure times the common volume stays; what the bodies gain the gas has lost."""
    film = S.simulate(sharing(), DURATION, **OPTIONS)
    assert film.status == Status.successful
    volume = film["tube.volume"] + film["finger.volume"]
    product = (film["air.pressure"] + ATMOSPHERE) * volume
    assert jnp.allclose(product, product[0], rtol=1e-7)
    q, v = film.state["finger"]["q"], film.state["finger"]["v"]
    rod = finger().rod
    held = jax.vmap(lambda q, v: R.kinetic_energy(rod, q, v) + R.potential_energy(rod, q))(q, v)
    has = film["tube.kinetic_energy"] + film["tube.elastic_energy"] + held
    given = product * jnp.log(volume / volume[0]) - ATMOSPHERE * (volume - volume[0])
    missed = jnp.abs(has - has[0] - given)
    moved = jnp.max(jnp.abs(held - held[0]))
    assert jnp.max(missed) < 0.01 * moved, (missed, moved)


@pytest.mark.slow
def test_under_one_given_pressure_each_moves_as_it_does_alone():
    """Nothing but the pressure joins them: two sources for one, to rounding."""
    goal = S.Source(S.SmoothRamp([0.0, DURATION], [0.0, 2e3]), unit="Pa")
    film, *alone = (
        S.simulate(
            S.Network(
                {"goal": goal, **blocks},
                {f"{name}.pressure": "goal.value" for name in blocks},
            ),
            DURATION,
            **OPTIONS,
        )
        for blocks in (
            {"tube": tube(speed=3.0), "finger": finger()},
            {"tube": tube(speed=3.0)},
            {"finger": finger()},
        )
    )
    for name, one in zip(("tube", "finger"), alone, strict=True):
        for leaf, lonely in one.state[name].items():
            scale = jnp.max(jnp.abs(lonely))
            assert jnp.allclose(film.state[name][leaf], lonely, atol=1e-9 * scale), leaf


@pytest.mark.slow
def test_gradients_by_numbers_of_both_agree_with_differences():
    _breathing()  # outside of what is compiled

    def end(scale):
        network = sharing(1e6 * scale[0], 1e6 * scale[1], 3.0 * scale[2])
        film = S.simulate(network, DURATION, save=2, step=DURATION / 8)
        return film["air.pressure"][-1] / 1e3 + film.state["finger"]["q"][-1, 0]

    one, h = jnp.ones(3), 1e-3
    both = jax.jit(jax.value_and_grad(end))  # one program for values and slopes
    ends = [both(one + k * h * row)[0] for row in jnp.eye(3) for k in (-2, -1, 1, 2)]
    differences = np.asarray(ends).reshape(3, 4) @ np.array([1, -8, 8, -1]) / (12 * h)
    assert np.allclose(both(one)[1], differences, rtol=1e-6)
