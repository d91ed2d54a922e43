"""The contact law: a smooth pressure that grows with penetration."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real


class Penalty(eqx.Module):
    """Frictionless penalty per reference area.

    The pressure is zero outside, grows with the square of the penetration up to depth
    `smoothing` [m] and linearly, by `stiffness` [Pa/m], beyond; its slope is continuous.
    """

    stiffness: Float[Array, ""] = eqx.field(converter=real)
    smoothing: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        for name, unit in (("stiffness", "Pa/m"), ("smoothing", "m")):
            do = "Ten Young's moduli over the size of a cell is a start for the stiffness."
            _check.positive("contact.Penalty", name, getattr(self, name), unit, do)

    def energy(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Energy per area [J/m^2] at a gap [m], negative where bodies overlap."""
        depth, ramp = self._parts(gap)
        beyond = depth - ramp
        width = self.smoothing
        within = ramp**3 / (6 * width)
        return self.stiffness * (within + 0.5 * beyond * (beyond + ramp))

    def pressure(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Contact pressure [Pa], minus the slope of the energy."""
        depth, ramp = self._parts(gap)
        return self.stiffness * (ramp**2 / (2 * self.smoothing) + depth - ramp)

    def penetration(self, pressure: Float[Array, "..."]) -> Float[Array, "..."]:
        """Depth [m] at which the pressure [Pa] is reached."""
        depth = pressure / self.stiffness + self.smoothing / 2
        small = depth < self.smoothing
        square = jnp.where(small, 2 * self.smoothing * pressure / self.stiffness, 1.0)
        return jnp.where(small, jnp.sqrt(square), depth)

    def _parts(self, gap):
        """Penetration, and the part of it within the smooth start."""
        depth = jnp.where(gap < 0, -gap, jnp.zeros_like(gap))
        return depth, jnp.where(depth < self.smoothing, depth, self.smoothing)
