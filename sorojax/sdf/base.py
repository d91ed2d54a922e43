"""The abstract signed distance, negative inside and in metres, and scalar functions whose
first and second derivatives are finite everywhere.

At a tie `where` picks one branch, so a derivative there is one-sided instead of an average of
two; it is also several times faster than `maximum` on a CPU.
"""

from __future__ import annotations

import abc
import functools
import math
from dataclasses import fields
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import Numbers, real

Box = tuple[Float[Array, " dim"], Float[Array, " dim"]]
Number = float | Float[Array, ""]


class Exactness(NamedTuple):
    """On which sides of the surface |f| is the true distance; elsewhere it is a bound."""

    outside: bool
    inside: bool


EXACT = Exactness(outside=True, inside=True)
OUTSIDE = Exactness(outside=True, inside=False)
BOUND = Exactness(outside=False, inside=False)


@displayed
class AbstractSdf(eqx.Module):
    """An implicit shape: a field that is negative inside and zero on the surface.

    A new shape gives `distance`, `dim` and `bounding_box`; it states its
    `lipschitz` constant when that is not 1 and its `exactness` where the field is the
    true Euclidean distance. Everywhere |f| <= lipschitz * distance to the surface.

    Shapes combine by `|` or `+` (union), `&` or `/` (intersection), `-` (difference);
    `*` scales about the origin.
    """

    def __check_init__(self):
        check_numbers(self)

    @property
    @abc.abstractmethod
    def dim(self) -> int:
        """2 or 3."""

    @abc.abstractmethod
    def distance(self, *x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Field [m] at separate coordinate arrays x, y[, z] [m]."""

    @abc.abstractmethod
    def bounding_box(self) -> Box:
        """Lower and upper corner [m] of a box that holds the inside; may be infinite."""

    @property
    def lipschitz(self) -> Number:
        """Bound of |grad f|: no point within |f| / lipschitz changes sign."""
        return 1.0

    @property
    def exactness(self) -> Exactness:
        """On which sides |f| is the true distance to the surface."""
        return BOUND

    @property
    def exact(self) -> bool:
        """Whether |f| is the true distance to the surface everywhere."""
        return all(self.exactness)

    def level_box(self, level: Number) -> Box:
        """Corners [m] of a box that holds all points where the field is below `level` [m].

        A bound may stay small far from the surface, so nothing is known of it outside.
        """
        lower, upper = self.bounding_box()
        if self.exactness.outside:
            return lower - level, upper + level
        if _check.is_concrete(level) and level <= 0:
            return lower, upper
        return jnp.full_like(lower, -jnp.inf), jnp.full_like(upper, jnp.inf)

    def __call__(self, p: Float[Array, "*points dim"]) -> Float[Array, "*points"]:
        """Field [m] at points `p` [m]."""
        p = real(p)
        if p.ndim < 1 or p.shape[-1] != self.dim:
            raise ValueError(
                f"{type(self).__name__}: points have shape {p.shape}, this shape needs "
                f"(..., {self.dim}). Put the coordinates on the last axis."
            )
        return cast(self, p.dtype).distance(*(p[..., i] for i in range(self.dim)))

    def __or__(self, other: AbstractSdf) -> AbstractSdf:
        from sorojax.sdf.operations.booleans import union

        return union(self, other)

    def __and__(self, other: AbstractSdf) -> AbstractSdf:
        from sorojax.sdf.operations.booleans import intersection

        return intersection(self, other)

    def __sub__(self, other: AbstractSdf) -> AbstractSdf:
        from sorojax.sdf.operations.booleans import Difference

        return Difference(self, other)

    def __add__(self, other: AbstractSdf) -> AbstractSdf:
        return self | other

    def __truediv__(self, other: AbstractSdf) -> AbstractSdf:
        return self & other

    def __mul__(self, factor: Number) -> AbstractSdf:
        from sorojax.sdf.operations.transform import scale

        return scale(self, factor)

    __rmul__ = __mul__


def steepest(*slopes: Number) -> Number:
    """The largest of `slopes`; a float unless one of them is traced."""
    if all(_check.is_concrete(slope) for slope in slopes):
        return max(float(slope) for slope in slopes)
    return functools.reduce(jnp.maximum, slopes)


def number(value: Number) -> Number:
    """`value` as a float unless it is traced."""
    return float(value) if _check.is_concrete(value) else value


class AbstractByLevel(AbstractSdf):
    """A shape whose bounding box is that of its level zero."""

    @abc.abstractmethod
    def level_box(self, level: Number) -> Box: ...

    def bounding_box(self) -> Box:
        return self.level_box(0.0)


def positive(value: Numbers) -> Array:
    """`value` as an array; a field with this converter holds one number above zero."""
    return real(value)


def check_numbers(shape: AbstractSdf) -> None:
    """Raise a `ValueError` if a field is not finite, or not positive where it has to be."""
    where = type(shape).__name__
    for field in fields(shape):
        value = getattr(shape, field.name)
        if field.metadata.get("converter") is positive:
            _check.shape(where, field.name, value, (), "Give one number.")
            _check.positive(where, field.name, value, "m", "Give a length above zero.")
        elif eqx.is_inexact_array(value):
            _check.finite(where, field.name, value, "Give real numbers.")


def cast(shape: AbstractSdf, dtype: jnp.dtype) -> AbstractSdf:
    """`shape` with its parameters in `dtype`, so that the field follows its input."""

    def convert(leaf: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
        same = not eqx.is_inexact_array(leaf) or leaf.dtype == dtype
        return leaf if same else leaf.astype(dtype)

    return jax.tree.map(convert, shape)


# Scalar building blocks whose first and second derivatives are finite everywhere


Scalar = Float[Array, "..."]


def minimum(a: Scalar, b: Scalar) -> Scalar:
    return jnp.where(a <= b, a, b)


def maximum(a: Scalar, b: Scalar) -> Scalar:
    return jnp.where(a >= b, a, b)


def ordered(a: Scalar, b: Scalar) -> tuple[Scalar, Scalar]:
    """The smaller and the larger of two, each of them once also at a tie.

    `minimum` and `maximum` both take the first there, and its slope with it.
    """
    swap = a > b
    return jnp.where(swap, b, a), jnp.where(swap, a, b)


def absolute(a: Scalar) -> Scalar:
    return jnp.where(a < 0, -a, a)


def positive_part(a: Scalar) -> Scalar:
    return jnp.where(a > 0, a, jnp.zeros_like(a))


def root(square: Scalar) -> Scalar:
    """sqrt(square), with zero slope instead of infinity at zero."""
    # The branch not taken is differentiated too, so it must stay finite at zero.
    above = square > 0
    safe = jnp.where(above, square, jnp.ones_like(square))
    return jnp.where(above, jnp.sqrt(safe), jnp.zeros_like(square))


def norm(*components: Scalar) -> Scalar:
    """Euclidean length of the vector of `components`; its slope at zero is zero."""
    return root(sum((c * c for c in components[1:]), start=components[0] ** 2))


def quotient(a: Scalar, b: Scalar) -> Scalar:
    """a / b, and zero where b is zero."""
    safe = jnp.where(b == 0, jnp.ones_like(b), b)
    return jnp.where(b == 0, jnp.zeros_like(a), a / safe)


def clip(a: Scalar, low: Scalar | float, high: Scalar | float) -> Scalar:
    """`a` between `low` and `high`, with slope one at both."""
    a = jnp.where(a < low, low + jnp.zeros_like(a), a)
    return jnp.where(a > high, high + jnp.zeros_like(a), a)


def box_distance(*excess: Scalar) -> Scalar:
    """Distance to a box from the coordinates less its half sides."""
    largest = functools.reduce(maximum, excess)
    inner = minimum(largest, jnp.zeros_like(largest))
    return inner + norm(*(positive_part(e) for e in excess))


def segment_side(x: Scalar, y: Scalar, a: tuple[Scalar, ...], b: tuple[Scalar, ...]) -> Scalar:
    """Distance to the segment from a to b, negative on its right side.

    Beside the segment it is the distance to its line, which has a slope on the segment.
    """
    ex, ey = b[0] - a[0], b[1] - a[1]
    length = norm(ex, ey)
    px, py = x - a[0], y - a[1]
    t = quotient(px * ex + py * ey, length + jnp.zeros_like(px))
    side = quotient(ex * py - ey * px, length + jnp.zeros_like(px))
    past = t - clip(t, 0.0, length)
    sign = jnp.where(side < 0, -1, 1).astype(side.dtype)
    return jnp.where(past == 0, side, sign * norm(past, side))


def sector(x: Scalar, y: Scalar, count: int) -> tuple[Scalar, Scalar]:
    """(x, y) turned by a multiple of 2 pi / count to within pi / count of the x axis."""
    step = 2 * math.pi / count
    # Which sector it is does not vary, so the angle needs no slope at the origin.
    turn = step * jnp.round(jnp.arctan2(*jax.lax.stop_gradient((y, x))) / step)
    c, s = jnp.cos(turn), jnp.sin(turn)
    return c * x + s * y, c * y - s * x
