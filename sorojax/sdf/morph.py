"""Shapes mixed, roughened and scaled by axis: bounds of the distance."""

import abc
import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.sdf.base import AbstractSdf, Box, Number, number, steepest
from sorojax.sdf.combine import check_same_dim, hull
from sorojax.sdf.transform import AbstractWrapped


class Morph(AbstractSdf):
    """The mean of two fields: `first` at `fraction` 0, `second` at 1."""

    first: AbstractSdf
    second: AbstractSdf
    fraction: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_same_dim("morph", (self.first, self.second))
        _check.between(
            "morph", "fraction", self.fraction, -1e-12, 1 + 1e-12, "", "Choose a mean."
        )

    @property
    def dim(self) -> int:
        return self.first.dim

    @property
    def lipschitz(self) -> Number:
        return steepest(self.first.lipschitz, self.second.lipschitz)

    def distance(self, *x):
        a, b = self.first.distance(*x), self.second.distance(*x)
        return a + self.fraction * (b - a)

    def bounding_box(self) -> Box:
        return self.level_box(0.0)

    def level_box(self, level) -> Box:
        # Where the mean is below the level, one of the two is.
        boxes: list[Box] = [self.first.level_box(level), self.second.level_box(level)]
        return hull(boxes, jnp.minimum, jnp.maximum)


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
    """The mean of two fields: `first` at `fraction` 0, `second` at 1."""
    return Morph(first, second, fraction)


def displace(shape: AbstractSdf, relief: AbstractRelief) -> Displaced:
    """`shape` with `relief` added to its field, such as `Waves`."""
    return Displaced(shape, relief)


def stretch(shape: AbstractSdf, factors: Numbers) -> Stretched:
    """`shape` scaled by one of `factors` per axis; a bound of the distance."""
    return Stretched(shape, factors)
