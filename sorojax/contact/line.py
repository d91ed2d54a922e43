"""The law of contact along a line: force per length, friction and damping."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real


class LinePenalty(eqx.Module):
    """A force per length of a thin body, two times differentiable in the gap.

    The normal force is zero outside; its slope rises smoothly over the depth `smoothing`
    and is `stiffness` beyond. Because all is per length, results do not depend on the
    number of points. Friction and damping never add energy. A rod of mass m per length that
    hits flat at speed v sinks in by v sqrt(m / stiffness).

    Attributes:
        stiffness: [N/m^2]; five Young's moduli of the rod is a start, fifty for impacts.
        smoothing: Depth at which the full stiffness is reached [m]; 0.2 % of the radius
            of the rod is a start.
        friction: Coulomb coefficient [-]; None costs nothing.
        slip: Speed below which friction is viscous [m/s].
        damping: Growth of the normal force with the closing speed [s/m], after Hunt and
            Crossley; None costs nothing.

    Reference:
        Hunt and Crossley, J. Appl. Mech. 42, 1975, for the damping.
    """

    stiffness: Float[Array, ""] = eqx.field(converter=real)
    smoothing: Float[Array, ""] = eqx.field(converter=real)
    friction: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    slip: Float[Array, ""] = eqx.field(converter=real, default=1e-3)
    damping: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        do = "Five to fifty Young's moduli suit the stiffness, 0.2 % of the radius the depth."
        for name, unit in (("stiffness", "N/m^2"), ("smoothing", "m"), ("slip", "m/s")):
            _check.positive("contact.LinePenalty", name, getattr(self, name), unit, do)
        for name, unit in (("friction", "-"), ("damping", "s/m")):
            value = getattr(self, name)
            if value is not None:
                do = "Leave it out for none."
                _check.positive("contact.LinePenalty", name, value, unit, do)

    def energy(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Stored energy per length [J/m] at a gap [m], negative where bodies overlap."""
        x, beyond = self._parts(gap)
        width = self.smoothing
        ramp = width**2 * (x**4 / 4 - x**5 / 10)
        return self.stiffness * (ramp + beyond * (width + beyond) / 2)

    def pressure(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Normal force per length [N/m] at rest, minus the slope of the energy."""
        x, beyond = self._parts(gap)
        return self.stiffness * (self.smoothing * (x**3 - x**4 / 2) + beyond)

    def slope(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Minus the slope of the pressure [N/m^2]."""
        x, _ = self._parts(gap)
        return self.stiffness * (3 * x**2 - 2 * x**3)

    def approach(self, rate: Float[Array, "..."]) -> Float[Array, "..."]:
        """Factor of the pressure when the gap changes by `rate` [m/s]; never negative."""
        if self.damping is None:
            return jnp.ones_like(rate)
        return jnp.maximum(1 - self.damping * rate, jnp.zeros_like(rate))

    def drag(
        self, normal_force: Float[Array, "..."], sliding: Float[Array, "... dim"]
    ) -> Float[Array, "..."]:
        """Friction per sliding velocity [N s/m^2]: mu N / sqrt(|v|^2 + slip^2)."""
        assert self.friction is not None
        speed = jnp.sqrt(jnp.sum(sliding**2, axis=-1) + self.slip**2)
        return self.friction * normal_force / speed

    def _parts(self, gap):
        """Share of the smooth start that is used, and the depth beyond it."""
        depth = jnp.where(gap < 0, -gap, jnp.zeros_like(gap))
        ramp = jnp.where(depth < self.smoothing, depth, self.smoothing)
        return ramp / self.smoothing, depth - ramp
