"""Boolean combinations of shapes: bounds of the true distance, Lipschitz as their parts."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.sdf.base import AbstractSdf, Box
from sorojax.sdf.scalar import absolute, maximum, minimum, positive_part


def _check_same_dim(where: str, shapes: tuple[AbstractSdf, ...]) -> None:
    if len({shape.dim for shape in shapes}) != 1:
        raise ValueError(
            f"{where}: got shapes of dimension {[shape.dim for shape in shapes]}, need at "
            "least one shape and one dimension. Combine plane with plane, solid with solid."
        )


def _hull(boxes: list[Box], low: Callable, high: Callable) -> Box:
    lower = functools.reduce(low, (box[0] for box in boxes))
    return lower, functools.reduce(high, (box[1] for box in boxes))


class Union(AbstractSdf):
    """Inside any of `shapes`; the distance is exact outside them."""

    shapes: tuple[AbstractSdf, ...] = eqx.field(converter=tuple)

    def __check_init__(self):
        _check_same_dim("Union", self.shapes)

    @property
    def dim(self) -> int:
        return self.shapes[0].dim

    @property
    def lipschitz(self) -> float:
        return max(shape.lipschitz for shape in self.shapes)

    def distance(self, *x):
        return functools.reduce(minimum, (shape.distance(*x) for shape in self.shapes))

    def bounding_box(self) -> Box:
        boxes = [shape.bounding_box() for shape in self.shapes]
        return _hull(boxes, jnp.minimum, jnp.maximum)


class Intersection(AbstractSdf):
    """Inside all of `shapes`; the distance is exact inside them."""

    shapes: tuple[AbstractSdf, ...] = eqx.field(converter=tuple)

    def __check_init__(self):
        _check_same_dim("Intersection", self.shapes)

    @property
    def dim(self) -> int:
        return self.shapes[0].dim

    @property
    def lipschitz(self) -> float:
        return max(shape.lipschitz for shape in self.shapes)

    def distance(self, *x):
        return functools.reduce(maximum, (shape.distance(*x) for shape in self.shapes))

    def bounding_box(self) -> Box:
        boxes = [shape.bounding_box() for shape in self.shapes]
        return _hull(boxes, jnp.maximum, jnp.minimum)


class Difference(AbstractSdf):
    """Inside `base` and outside `removed`."""

    base: AbstractSdf
    removed: AbstractSdf

    def __check_init__(self):
        _check_same_dim("Difference", (self.base, self.removed))

    @property
    def dim(self) -> int:
        return self.base.dim

    @property
    def lipschitz(self) -> float:
        return max(self.base.lipschitz, self.removed.lipschitz)

    def distance(self, *x):
        return maximum(self.base.distance(*x), -self.removed.distance(*x))

    def bounding_box(self) -> Box:
        return self.base.bounding_box()


class SmoothUnion(AbstractSdf):
    """Union with a fillet where the fields differ by less than `k` [m].

    Quadratic blend: continuous slope, deepest by k/4 where both fields are equal.
    """

    first: AbstractSdf
    second: AbstractSdf
    k: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        _check_same_dim("SmoothUnion", (self.first, self.second))
        _check.positive("SmoothUnion", "k", self.k, "m", "Use `|` for a sharp union.")

    @property
    def dim(self) -> int:
        return self.first.dim

    @property
    def lipschitz(self) -> float:
        return max(self.first.lipschitz, self.second.lipschitz)

    def distance(self, *x):
        a, b = self.first.distance(*x), self.second.distance(*x)
        h = positive_part(self.k - absolute(a - b))
        return minimum(a, b) - h * h / (4 * self.k)

    def bounding_box(self) -> Box:
        boxes: list[Box] = [self.first.bounding_box(), self.second.bounding_box()]
        lower, upper = _hull(boxes, jnp.minimum, jnp.maximum)
        return lower - self.k / 4, upper + self.k / 4


def union(*shapes: AbstractSdf) -> Union:
    """One flat `Union` of `shapes`, so that long sums do not nest."""
    flat = (s.shapes if isinstance(s, Union) else (s,) for s in shapes)
    return Union(sum(flat, start=()))


def intersection(*shapes: AbstractSdf) -> Intersection:
    """One flat `Intersection` of `shapes`."""
    flat = (s.shapes if isinstance(s, Intersection) else (s,) for s in shapes)
    return Intersection(sum(flat, start=()))
