"""The contact law: a smooth pressure that grows with penetration."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.contact.friction import AbstractFriction, DirectionalCoulomb, friction_law


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

    def mean_pressure(
        self, before: Float[Array, "..."], after: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Mean of the pressure over the way from one gap to another [Pa]: times that way it
        is what the energy loses, to the last digit."""
        (d0, r0), (d1, r1) = self._parts(before), self._parts(after)
        way, width = before - after, self.smoothing
        still = jnp.abs(way) <= _STILL * (jnp.abs(before) + jnp.abs(after) + width)
        way = jnp.where(still, jnp.ones_like(way), way)
        b0, b1 = d0 - r0, d1 - r1
        within = (r1 - r0) / way * (r0 * r0 + r0 * r1 + r1 * r1) / (6 * width)
        beyond = (b1 - b0) / way * (b0 + b1 + width) / 2
        here = self.pressure((before + after) / 2)
        return jnp.where(still, here, self.stiffness * (within + beyond))

    def energy_of_step(
        self, before: Float[Array, "..."], after: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Energy per area [J/m^2] whose slope in the gap `after` is minus the mean pressure
        over the step. Its value is a quadrature, its slope exact."""
        return _energy_of_step(self.stiffness, self.smoothing, before, after)

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


_STILL = 1e-6  # way over the gaps, below which the pressure is that in the middle


def _by_quadrature(stiffness, smoothing, before, after):
    law = Penalty(stiffness, smoothing)
    total = jnp.zeros_like(after)
    for at, weight in zip(*np.polynomial.legendre.leggauss(4), strict=True):
        share = (1 + float(at)) / 2
        lost = law.energy(before + share * (after - before)) - law.energy(before)
        total = total + float(weight) / (2 * share) * lost
    return total


@jax.custom_jvp
def _energy_of_step(stiffness, smoothing, before, after):
    return _by_quadrature(stiffness, smoothing, before, after)


def _slope_of_step(primals, tangents):
    """Exact in the gap after the step, the only one that forces are slopes in."""
    stiffness, smoothing, before, after = primals
    value = _by_quadrature(*primals)
    slope = jnp.zeros_like(value)
    if not isinstance(tangents[3], SymbolicZero):
        slope = slope - Penalty(stiffness, smoothing).mean_pressure(before, after) * tangents[3]
    moving = [k for k in range(3) if not isinstance(tangents[k], SymbolicZero)]
    if moving:

        def of(*moved):
            given = dict(zip(moving, moved, strict=True))
            return _by_quadrature(*(given.get(k, primals[k]) for k in range(4)))

        at, along = zip(*((primals[k], tangents[k]) for k in moving), strict=True)
        slope = slope + jax.jvp(of, at, along)[1]
    return value, slope


_energy_of_step.defjvp(_slope_of_step, symbolic_zeros=True)


# The law of contact along a line: force per length, friction and damping


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
        friction: Friction law, or the coefficient [-] of Coulomb's; None costs nothing.
        slip: Speed below which friction is viscous [m/s].
        damping: Growth of the normal force with the closing speed [s/m], after Hunt and
            Crossley; None costs nothing.

    Reference:
        Hunt and Crossley, J. Appl. Mech. 42, 1975, for the damping.
    """

    stiffness: Float[Array, ""] = eqx.field(converter=real)
    smoothing: Float[Array, ""] = eqx.field(converter=real)
    friction: AbstractFriction | None = eqx.field(converter=friction_law, default=None)
    slip: Float[Array, ""] = eqx.field(converter=real, default=1e-3)
    damping: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        do = "Five to fifty Young's moduli suit the stiffness, 0.2 % of the radius the depth."
        for name, unit in (("stiffness", "N/m^2"), ("smoothing", "m"), ("slip", "m/s")):
            _check.positive("contact.LinePenalty", name, getattr(self, name), unit, do)
        if isinstance(self.friction, DirectionalCoulomb):
            raise TypeError(
                "contact.LinePenalty: got a DirectionalCoulomb for `friction`, which holds "
                "without creep. Give a number or a Coulomb; fem.Contact takes both."
            )
        if self.damping is not None:
            do = "Leave it out for none."
            _check.positive("contact.LinePenalty", "damping", self.damping, "s/m", do)

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
        self, pressure: Float[Array, "..."], sliding: Float[Array, "... dim"]
    ) -> Float[Array, "..."]:
        """Friction per length and sliding velocity [N s/m^2], at a normal force per length p
        [N/m]: limit(p) / sqrt(|v|^2 + slip^2)."""
        assert self.friction is not None
        speed = jnp.sqrt(jnp.sum(sliding**2, axis=-1) + self.slip**2)
        return self.friction.limit(pressure) / speed

    def _parts(self, gap):
        """Share of the smooth start that is used, and the depth beyond it."""
        depth = jnp.where(gap < 0, -gap, jnp.zeros_like(gap))
        ramp = jnp.where(depth < self.smoothing, depth, self.smoothing)
        return ramp / self.smoothing, depth - ramp
