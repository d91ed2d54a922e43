"""Shapes bent out of their form: bounds whose Lipschitz constant holds everywhere.

A map that stretches more and more away from the shape is followed only near it: the
point is first moved into a box around the shape, and beyond that box the distance to
the box takes over. So one constant holds in the whole space.
"""

import abc
import math
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.sdf.base import (
    AbstractSdf,
    Box,
    Number,
    clip,
    maximum,
    minimum,
    norm,
    number,
    quotient,
    steepest,
)
from sorojax.sdf.operations.booleans import AbstractPair, around
from sorojax.sdf.operations.transform import AbstractWrapped

_MARGIN = 0.1  # of the size of the shape, between it and the side of its domain


class AbstractConfined(AbstractSdf):
    """A solid, `shape`, changed by `rate` along z; the change is followed within a domain
    around it."""

    shape: AbstractSdf
    rate: Float[Array, ""] = eqx.field(converter=real)
    dim: ClassVar[int] = 3

    @abc.abstractmethod
    def _domain(self) -> Box:
        """Corners [m] of the domain, which holds the changed solid."""

    @abc.abstractmethod
    def _straight(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
        """Where points of the domain are in the solid as it was."""

    def distance(self, *x):
        lower, upper = self._domain()
        held = tuple(clip(c, lower[i], upper[i]) for i, c in enumerate(x))
        beyond = norm(*(c - h for c, h in zip(x, held, strict=True)))
        value = self.shape.distance(*self._straight(*held))
        return jnp.where(beyond > 0, maximum(value, beyond), value)

    def bounding_box(self) -> Box:
        return self._domain()

    def level_box(self, level) -> Box:
        lower, upper = self._domain()
        return lower - level, upper + level


class Twisted(AbstractConfined):
    """A solid twisted about z by `rate` [rad/m].

    The Lipschitz constant is that of the solid times a + sqrt(1 + a^2), the stretch of
    the simple shear 2 a = rate * radius at the corner of its domain.
    """

    def _domain(self) -> Box:
        lower, upper = self.shape.bounding_box()
        far = jnp.maximum(jnp.abs(lower[:2]), jnp.abs(upper[:2]))
        radius = (1 + _MARGIN) * jnp.sqrt(jnp.sum(far**2))
        margin = _MARGIN * (upper[2] - lower[2])
        low, high = lower[2] - margin, upper[2] + margin
        return jnp.stack([-radius, -radius, low]), jnp.stack([radius, radius, high])

    @property
    def lipschitz(self) -> Number:
        half = jnp.abs(self.rate) * self._domain()[1][0] * math.sqrt(2) / 2
        stretch = half + jnp.sqrt(1 + half * half)  # largest singular value of the shear
        return steepest(self.shape.lipschitz * number(stretch), 1.0)

    def _straight(self, x, y, z):
        c, s = jnp.cos(self.rate * z), jnp.sin(self.rate * z)
        return c * x + s * y, c * y - s * x, z

    def bounding_box(self) -> Box:
        domain, (lower, upper) = self._domain(), self.shape.bounding_box()
        return (
            jnp.concatenate([domain[0][:2], lower[2:]]),
            jnp.concatenate([domain[1][:2], upper[2:]]),
        )


class Tapered(AbstractConfined):
    """A solid whose section at height z is scaled by 1 + `rate` z, rate in 1/m."""

    def __check_init__(self):
        lower, upper = self._domain()
        if _check.is_concrete(lower) and _check.is_concrete(self.rate):
            least = float(jnp.minimum(1 + self.rate * lower[2], 1 + self.rate * upper[2]))
            if not least > 0:
                raise ValueError(
                    f"taper: the section shrinks to {least:g} of itself between z = "
                    f"{float(lower[2]):g} m and {float(upper[2]):g} m, need more than 0. "
                    "Lower `rate`, or cut the shape."
                )

    def _domain(self) -> Box:
        lower, upper = self.shape.bounding_box()
        margin = _MARGIN * (upper[2] - lower[2])
        ends = jnp.stack([lower[2] - margin, upper[2] + margin])
        most = jnp.max(1 + self.rate * ends)
        wide = _MARGIN * jnp.max(upper - lower)
        low, high = lower[:2] - wide, upper[:2] + wide
        return (
            jnp.stack([*jnp.minimum(low * most, low), ends[0]]),
            jnp.stack([*jnp.maximum(high * most, high), ends[1]]),
        )

    @property
    def lipschitz(self) -> Number:
        lower, upper = self._domain()
        sizes = 1 + self.rate * jnp.stack([lower[2], upper[2]])
        least = jnp.min(sizes)
        far = jnp.maximum(jnp.abs(lower[:2]), jnp.abs(upper[:2]))
        shear = jnp.abs(self.rate) * jnp.sqrt(jnp.sum(far**2)) / least**2
        stretch = jnp.maximum(1.0, 1 / least) + shear
        return steepest(self.shape.lipschitz * number(stretch), 1.0)

    def _straight(self, x, y, z):
        size = 1 + self.rate * z
        return x / size, y / size, z


class Bent(AbstractWrapped):
    """A bar along x bent in the plane of x and y to the curvature `bend` [1/m].

    The line y = 0 keeps its length; material at y turns on the radius 1/bend - y.
    """

    shape: AbstractSdf
    bend: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        lower, upper = self.shape.bounding_box()
        if _check.is_concrete(lower) and _check.is_concrete(self.bend):
            inner = float(self._inner())
            turn = float(jnp.abs(self.bend) * jnp.maximum(-lower[0], upper[0]))
            if not (inner > 0 and turn < math.pi):
                raise ValueError(
                    f"bend: the shape reaches {turn:g} rad around the centre (need less than "
                    f"pi) and {inner:g} of the radius is left at its inner side (need more "
                    "than 0). Lower `bend`."
                )

    def _inner(self) -> Array:
        """Radius over 1/bend of a circle inside of which there is no material."""
        lower, upper = self.shape.bounding_box()
        high = jnp.where(self.bend > 0, upper[1], -lower[1])
        return 0.8 * (1 - jnp.abs(self.bend) * high)

    @property
    def lipschitz(self) -> Number:
        stretch = number(jnp.maximum(1.0, 1 / self._inner()))
        slope = steepest(self.shape.lipschitz * stretch, 1.0)
        return number((slope * slope + 0.25) ** 0.5)  # with the half slope inside the circle

    def distance(self, x, y, *z):
        k = self.bend
        near, across = 1 - k * y, k * x
        ratio = norm(near, across)  # radius over 1/bend
        inner, most = self._inner(), 1 / jnp.maximum(jnp.abs(k), 1e-9)
        outside = ratio >= inner
        straight = (2 * y - k * (x * x + y * y)) / (1 + ratio)
        height = jnp.where(outside, straight, quotient(1 - inner, k) + jnp.zeros_like(x))
        along = _arc(x, near, across, k)
        # The bar is also met the other way round the circle.
        other = jnp.where(along > 0, along - 2 * math.pi * most, along + 2 * math.pi * most)
        value = minimum(
            self.shape.distance(along, height, *z), self.shape.distance(other, height, *z)
        )
        # Towards the centre the angle turns faster and faster: fade its influence out.
        value = minimum(value, jnp.where(outside, ratio, inner) * most)
        faded = ratio / inner * value + (inner - ratio) * most / 2
        return jnp.where(outside, value, faded)

    def level_box(self, level) -> Box:
        lower, upper = self.shape.level_box(level)
        # No point moves further from the origin than the bar reaches along and across.
        far = jnp.maximum(jnp.abs(lower), jnp.abs(upper))
        reach = (far[0] + far[1])[None].repeat(2)
        box = jnp.concatenate([-reach, lower[2:]]), jnp.concatenate([reach, upper[2:]])
        # Around the centre of the bend the field stays low everywhere.
        open_ = level >= self._inner() / jnp.maximum(jnp.abs(self.bend), 1e-9) / 2
        infinity = jnp.full_like(lower, jnp.inf)
        return jnp.where(open_, -infinity, box[0]), jnp.where(open_, infinity, box[1])


def _arc(x: Array, near: Array, across: Array, k: Array) -> Array:
    """atan2(k x, 1 - k y) / k, by its series where the angle is small."""
    small = (across < 1e-4) & (across > -1e-4) & (near > 0.5)
    slope = jnp.where(small, across / jnp.where(small, near, 1.0), 0.0)
    series = x / jnp.where(small, near, 1.0) * (1 - slope * slope / 3)
    centre = (near == 0) & (across == 0)
    safe_near = jnp.where(small | centre, jnp.ones_like(near), near)
    angle = jnp.arctan2(jnp.where(small | centre, jnp.zeros_like(across), across), safe_near)
    return jnp.where(small, series, quotient(angle, k + jnp.zeros_like(angle)))


def twist(shape: AbstractSdf, rate: Numbers) -> Twisted:
    """A solid twisted about z by `rate` [rad/m].

    Args:
        shape: A solid.
        rate: Angle per height [rad/m].

    Returns:
        The twisted solid.
    """
    return Twisted(shape, rate)


def taper(shape: AbstractSdf, rate: Numbers) -> Tapered:
    """A solid whose section at height z is scaled by 1 + `rate` z, rate in 1/m.

    Args:
        shape: A solid.
        rate: Change of scale per height [1/m].

    Returns:
        The tapered solid.
    """
    return Tapered(shape, rate)


def bend(shape: AbstractSdf, curvature: Numbers) -> Bent:
    """A bar along x bent in the plane of x and y to `curvature` [1/m].

    Args:
        shape: A bar along x.
        curvature: Of its axis [1/m].

    Returns:
        The bent bar.
    """
    return Bent(shape, curvature)


# Shapes mixed, roughened and scaled by axis: bounds of the distance


class Morph(AbstractPair):
    """The mean of two fields: `first` at `fraction` 0, `second` at 1."""

    fraction: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        _check.between(
            "morph", "fraction", self.fraction, -1e-12, 1 + 1e-12, "", "Choose a mean."
        )

    def distance(self, *x):
        a, b = self.first.distance(*x), self.second.distance(*x)
        return a + self.fraction * (b - a)

    def level_box(self, level) -> Box:
        # Where the mean is below the level, one of the two is.
        return around((self.first, self.second), level)


class AbstractRelief(eqx.Module):
    """A bounded function of the place, added to a field by `displace`."""

    @abc.abstractmethod
    def __call__(self, *x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Displacement [m], positive inwards."""

    @property
    @abc.abstractmethod
    def height(self) -> Float[Array, ""]:
        """Bound of its size [m]."""

    @property
    @abc.abstractmethod
    def lipschitz(self) -> Float[Array, ""]:
        """Bound of its slope."""


class Waves(AbstractRelief):
    """Product of sines along all axes: `amplitude` and `wavelength` in m."""

    amplitude: Float[Array, ""] = eqx.field(converter=real)
    wavelength: Float[Array, ""] = eqx.field(converter=real)

    def __call__(self, *x):
        value = self.amplitude + jnp.zeros_like(x[0])
        for c in x:
            value = value * jnp.sin(2 * math.pi / self.wavelength * c)
        return value

    @property
    def height(self) -> Float[Array, ""]:
        return jnp.abs(self.amplitude)

    @property
    def lipschitz(self) -> Float[Array, ""]:
        return jnp.abs(self.amplitude) * 2 * math.pi / self.wavelength


class Displaced(AbstractWrapped):
    """`shape` with `relief` added to its field: Lipschitz constants add up."""

    shape: AbstractSdf
    relief: AbstractRelief

    @property
    def lipschitz(self) -> Number:
        return self.shape.lipschitz + number(self.relief.lipschitz)

    def distance(self, *x):
        return self.shape.distance(*x) + self.relief(*x)

    def level_box(self, level) -> Box:
        return self.shape.level_box(level + self.relief.height)


class Stretched(AbstractWrapped):
    """`shape` scaled by one of `factors` per axis about the origin.

    The field is scaled by the least factor, so that it stays a bound.
    """

    shape: AbstractSdf
    factors: Float[Array, " dim"] = eqx.field(converter=real)

    def __check_init__(self):
        _check.shape("stretch", "factors", self.factors, (self.shape.dim,), "One per axis.")
        _check.positive("stretch", "factors", self.factors, "", "Use `mirror` to reflect.")

    def distance(self, *x):
        value = self.shape.distance(*(c / self.factors[i] for i, c in enumerate(x)))
        return value * jnp.min(self.factors)

    def level_box(self, level) -> Box:
        lower, upper = self.shape.level_box(level / jnp.min(self.factors))
        return lower * self.factors, upper * self.factors


def morph(first: AbstractSdf, second: AbstractSdf, fraction: Numbers) -> Morph:
    """The mean of two fields: `first` at `fraction` 0, `second` at 1.

    Args:
        first: The shape at 0.
        second: The shape at 1.
        fraction: Between them [-].

    Returns:
        The shape between.
    """
    return Morph(first, second, fraction)


def displace(shape: AbstractSdf, relief: AbstractRelief) -> Displaced:
    """`shape` with `relief` added to its field, such as `Waves`.

    Args:
        shape: The shape.
        relief: What is added, in metres.

    Returns:
        The shape with the relief.
    """
    return Displaced(shape, relief)


def stretch(shape: AbstractSdf, factors: Numbers) -> Stretched:
    """`shape` scaled by one of `factors` per axis; a bound of the distance.

    Args:
        shape: The shape.
        factors: One per axis [-].

    Returns:
        The stretched shape.
    """
    return Stretched(shape, factors)
