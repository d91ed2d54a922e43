"""Boolean combinations of shapes: bounds of the true distance, Lipschitz as their parts."""

import abc
import functools
import math
from collections.abc import Callable, Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.sdf.base import (
    AbstractByLevel,
    AbstractSdf,
    Box,
    Exactness,
    Number,
    absolute,
    maximum,
    minimum,
    positive_part,
    steepest,
)


def check_same_dim(where: str, shapes: tuple[AbstractSdf, ...]) -> None:
    if len({shape.dim for shape in shapes}) != 1:
        raise ValueError(
            f"{where}: got shapes of dimension {[shape.dim for shape in shapes]}, need at "
            "least one shape and one dimension. Combine plane with plane, solid with solid."
        )


def hull(boxes: list[Box], low: Callable, high: Callable) -> Box:
    lower = functools.reduce(low, (box[0] for box in boxes))
    return lower, functools.reduce(high, (box[1] for box in boxes))


def around(shapes: Sequence[AbstractSdf], level: Number) -> Box:
    """The box of all `shapes` below `level` [m]."""
    return hull([shape.level_box(level) for shape in shapes], jnp.minimum, jnp.maximum)


def common(shapes: Sequence[AbstractSdf], level: Number) -> Box:
    """The box that those of all `shapes` below `level` [m] have in common."""
    return hull([shape.level_box(level) for shape in shapes], jnp.maximum, jnp.minimum)


class AbstractCombination(AbstractByLevel):
    """Several `shapes` of one dimension as one."""

    shapes: tuple[AbstractSdf, ...] = eqx.field(converter=tuple)

    def __check_init__(self):
        check_same_dim(type(self).__name__, self.shapes)

    @property
    def dim(self) -> int:
        return self.shapes[0].dim

    @property
    def lipschitz(self) -> Number:
        return steepest(*(shape.lipschitz for shape in self.shapes))


class Union(AbstractCombination):
    """Inside any of `shapes`; the distance is exact outside them."""

    @property
    def exactness(self) -> Exactness:
        return Exactness(all(s.exactness.outside for s in self.shapes), False)

    def distance(self, *x):
        return functools.reduce(minimum, (shape.distance(*x) for shape in self.shapes))

    def level_box(self, level) -> Box:
        return around(self.shapes, level)


class Intersection(AbstractCombination):
    """Inside all of `shapes`; the distance is exact inside them."""

    @property
    def exactness(self) -> Exactness:
        return Exactness(False, all(s.exactness.inside for s in self.shapes))

    def distance(self, *x):
        return functools.reduce(maximum, (shape.distance(*x) for shape in self.shapes))

    def level_box(self, level) -> Box:
        return common(self.shapes, level)


class Difference(AbstractByLevel):
    """Inside `base` and outside `removed`."""

    base: AbstractSdf
    removed: AbstractSdf

    def __check_init__(self):
        check_same_dim("Difference", (self.base, self.removed))

    @property
    def dim(self) -> int:
        return self.base.dim

    @property
    def lipschitz(self) -> Number:
        return steepest(self.base.lipschitz, self.removed.lipschitz)

    @property
    def exactness(self) -> Exactness:
        return Exactness(False, self.base.exactness.inside and self.removed.exactness.outside)

    def distance(self, *x):
        return maximum(self.base.distance(*x), -self.removed.distance(*x))

    def level_box(self, level) -> Box:
        return self.base.level_box(level)


def union(*shapes: AbstractSdf) -> Union:
    """Union of shapes: the pointwise minimum of their fields, as `a | b`.

    Unions among the arguments are taken apart, so that long sums do not nest. The field
    is the exact distance outside the shapes where theirs is, and a bound inside.

    Args:
        *shapes: One or more shapes of one dimension.

    Returns:
        The union.

    Raises:
        ValueError: If there is no shape, or plane and solid ones are mixed.

    Example:
        >>> row = sdf.union(*(sdf.Circle([x * mm, 0], 4 * mm) for x in (0, 5, 10)))
        >>> print(f"{float(row(jnp.array([12 * mm, 0.0]))) / mm:.1f} mm")
        -2.0 mm
    """
    flat = (s.shapes if isinstance(s, Union) else (s,) for s in shapes)
    return Union(sum(flat, start=()))


def intersection(*shapes: AbstractSdf) -> Intersection:
    """One flat `Intersection` of `shapes`.

    Args:
        *shapes: Two shapes or more.

    Returns:
        Their common part.
    """
    flat = (s.shapes if isinstance(s, Intersection) else (s,) for s in shapes)
    return Intersection(sum(flat, start=()))


# Smooth combinations: what rounds a joint, how deep it dips, how smooth it is


class AbstractBlend(eqx.Module):
    """A smooth minimum of two fields over a width k [m].

    Attributes:
        dip: Largest depth below the sharp minimum, reached at equal fields, over k.
        continuity: Number of continuous derivatives.
        slope: Factor on the larger Lipschitz constant of the parts.
    """

    dip: eqx.AbstractClassVar[float]
    continuity: eqx.AbstractClassVar[float]
    slope: eqx.AbstractClassVar[float]

    @abc.abstractmethod
    def __call__(self, a: Array, b: Array, k: Array) -> Array:
        """Blended minimum [m] of the fields `a` and `b` [m]."""


class Quadratic(AbstractBlend):
    """Parabola where |a - b| < k: C1, dip k/4."""

    dip: ClassVar[float] = 1 / 4
    continuity: ClassVar[float] = 1
    slope: ClassVar[float] = 1.0

    def __call__(self, a, b, k):
        h = positive_part(k - absolute(a - b))
        return minimum(a, b) - h * h / (4 * k)


class Cubic(AbstractBlend):
    """Cubic where |a - b| < k: C2, dip k/6."""

    dip: ClassVar[float] = 1 / 6
    continuity: ClassVar[float] = 2
    slope: ClassVar[float] = 1.0

    def __call__(self, a, b, k):
        h = positive_part(k - absolute(a - b)) / k
        return minimum(a, b) - h * h * h * k / 6


class Circular(AbstractBlend):
    """Circular arc between orthogonal faces where |a - b| < k: C1, dip (1 - 1/sqrt 2) k."""

    dip: ClassVar[float] = 1 - math.sqrt(0.5)
    continuity: ClassVar[float] = 1
    slope: ClassVar[float] = 1.0

    def __call__(self, a, b, k):
        h = positive_part(k - absolute(a - b)) / k
        return minimum(a, b) - k / 2 * (1 + h - jnp.sqrt(1 + h * (2 - h)))


class Exponential(AbstractBlend):
    """-k ln(exp(-a/k) + exp(-b/k)): smooth, dip k ln 2, not local."""

    dip: ClassVar[float] = math.log(2)
    continuity: ClassVar[float] = math.inf
    slope: ClassVar[float] = 1.0

    def __call__(self, a, b, k):
        return minimum(a, b) - k * jnp.log1p(jnp.exp(-absolute(a - b) / k))


class Chamfer(AbstractBlend):
    """Flat face that cuts k off both sides of a right angle: C0, dip k/sqrt 2."""

    dip: ClassVar[float] = math.sqrt(0.5)
    continuity: ClassVar[float] = 0
    # Where both fields rise in the same direction, their scaled sum is steeper.
    slope: ClassVar[float] = math.sqrt(2)

    def __call__(self, a, b, k):
        return minimum(minimum(a, b), (a + b - k) * math.sqrt(0.5))


class AbstractPair(AbstractByLevel):
    """Two shapes of one dimension, `first` and `second`, as one."""

    first: AbstractSdf
    second: AbstractSdf

    def __check_init__(self):
        check_same_dim(type(self).__name__, (self.first, self.second))

    @property
    def dim(self) -> int:
        return self.first.dim

    @property
    def lipschitz(self) -> Number:
        return steepest(self.first.lipschitz, self.second.lipschitz)


class AbstractBlended(AbstractPair):
    """Two shapes joined by a `blend` of width `k` [m]."""

    k: Float[Array, ""] = eqx.field(converter=real)
    blend: AbstractBlend = Quadratic()

    def __check_init__(self):
        where = type(self).__name__
        _check.positive(where, "k", self.k, "m", "Use `|`, `&` or `-` for a sharp edge.")

    @property
    def lipschitz(self) -> Number:
        return super().lipschitz * self.blend.slope


class SmoothUnion(AbstractBlended):
    """Union with a fillet where the two fields differ by less than `k`.

    The default blend is quadratic, with one continuous derivative and a fillet that is k/4 deep
    where both fields are equal: min(a, b) - max(k - |a - b|, 0)^2 / (4 k).

    Attributes:
        first: One shape.
        second: Another of the same dimension.
        k: Width of the blend [m], positive.
        blend: `Quadratic()`, `Cubic()`, `Circular()`, `Exponential()` or `Chamfer()`.

    Raises:
        ValueError: If `k` is not positive, or one shape is plane and the other solid.

    Example:
        >>> floor, wall = sdf.HalfPlane([0, 0], [0, 1]), sdf.HalfPlane([0, 0], [1, 0])
        >>> joint = sdf.SmoothUnion(floor, wall, 4 * mm)
        >>> print(f"{float(joint(jnp.array([0.0, 0.0]))) / mm:.1f} mm")  # k/4 inside
        -1.0 mm

    Reference:
        Quilez, Smooth minimum, 2013, for the polynomial blends.
    """

    def distance(self, *x):
        return self.blend(self.first.distance(*x), self.second.distance(*x), self.k)

    def level_box(self, level) -> Box:
        return around((self.first, self.second), level + self.blend.dip * self.k)


class SmoothIntersection(AbstractBlended):
    """Intersection of `first` and `second` whose edges are rounded off where the fields differ
    by less than `k` [m]; `blend` is one of those of `SmoothUnion`."""

    def distance(self, *x):
        return -self.blend(-self.first.distance(*x), -self.second.distance(*x), self.k)

    def level_box(self, level) -> Box:
        return common((self.first, self.second), level)


class SmoothDifference(AbstractBlended):
    """`first` without `second`; the edges between them are rounded off over `k` [m], as `blend`
    of `SmoothUnion` has it."""

    def distance(self, *x):
        return -self.blend(-self.first.distance(*x), self.second.distance(*x), self.k)

    def level_box(self, level) -> Box:
        return self.first.level_box(level)
