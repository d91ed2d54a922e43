"""A soft hand: five planar fingers of five modes, five reservoirs, one sampled controller."""

import equinox as eqx
import jax
import jax.numpy as jnp

from sorojax import rod, systems
from sorojax.math.lie import SE2
from sorojax.units import MPa, mm

FINGERS, MODES = 5, 5
PERIOD = 0.01  # s between calls of the controller
AREA = 2e-5  # m^2 of a chamber
EXPOSED = ("air.mass_flow",)
WIRES = {
    "body.pressure": "air.pressure",
    "air.volume": "body.volume",
    "air.volume_rate": "body.volume_rate",
}


def finger(length) -> systems.Network:
    """A finger with its gas: 11 states."""
    body = rod.rod(
        SE2(),
        rod.chebyshev(kappa_z=MODES),
        rod.circle(6 * mm),
        length=length,
        young_modulus=1 * MPa,
        poisson_ratio=0.4,
        density=1100.0,
        nodes=8,
    )
    chamber = rod.thread_chambers(body, rod.Straight((3 * mm,)), AREA)
    block = systems.RodBody(body, (chamber, rod.Gravity(), rod.Damping(0.02)))
    blocks = {"body": block, "air": systems.Reservoir(dead_volume=2e-6)}
    return systems.Network(blocks, WIRES, EXPOSED)


def lengths():
    return jnp.array([80.0, 90.0, 95.0, 88.0, 70.0]) * mm


def hand() -> systems.Network:
    """Five fingers as one stacked block."""
    fingers = systems.stack([finger(length) for length in lengths()])
    return systems.Network({"fingers": fingers}, {}, ("fingers.air.mass_flow",))


def separate() -> systems.Network:
    """The same fingers, block by block."""
    blocks: dict[str, systems.AbstractBlock] = {
        f"finger{k}": finger(length) for k, length in enumerate(lengths())
    }
    exposed = tuple(f"{name}.air.mass_flow" for name in blocks)
    return systems.Network(blocks, {}, exposed)


class Grip(eqx.Module):
    """Proportional flow towards a wave of pressures, one after the other."""

    gain: jax.Array = eqx.field(converter=jnp.asarray, default=2e-9)

    def start(self, t, measurement):
        return jnp.zeros_like(measurement)

    def __call__(self, t, measurement, state):
        phase = jnp.arange(FINGERS, dtype=measurement.dtype)
        target = 15e3 * (1 - jnp.cos(6 * t + 0.5 * phase))
        return self.gain * (target - measurement), state
