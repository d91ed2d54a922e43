"""Boolean combinations of shapes: bounds of the true distance, Lipschitz as their parts."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp

from sorojax.sdf.base import AbstractSdf, Box, Exactness, Number, steepest
from sorojax.sdf.scalar import maximum, minimum


def check_same_dim(where: str, shapes: tuple[AbstractSdf, ...]) -> None:
    if len({shape.dim for shape in shapes}) != 1:
        raise ValueError(
            f"{where}: got shapes of dimension {[shape.dim for shape in shapes]}, need at "
            "least one shape and one dimension. Combine plane with plane, solid with solid."
        )


def hull(boxes: list[Box], low: Callable, high: Callable) -> Box:
    lower = functools.reduce(low, (box[0] for box in boxes))
    return lower, functools.reduce(high, (box[1] for box in boxes))


class Union(AbstractSdf):
    """Inside any of `shapes`; the distance is exact outside them."""

    shapes: tuple[AbstractSdf, ...] = eqx.field(converter=tuple)

    def __check_init__(self):
        check_same_dim("Union", self.shapes)

    @property
    def dim(self) -> int:
        return self.shapes[0].dim

    @property
    def lipschitz(self) -> Number:
        return steepest(*(shape.lipschitz for shape in self.shapes))

    @property
    def exactness(self) -> Exactness:
        return Exactness(all(s.exactness.outside for s in self.shapes), False)

    def distance(self, *x):
        return functools.reduce(minimum, (shape.distance(*x) for shape in self.shapes))

    def bounding_box(self) -> Box:
        return self.level_box(0.0)

    def level_box(self, level) -> Box:
        boxes = [shape.level_box(level) for shape in self.shapes]
        return hull(boxes, jnp.minimum, jnp.maximum)


class Intersection(AbstractSdf):
    """Inside all of `shapes`; the distance is exact inside them."""

    shapes: tuple[AbstractSdf, ...] = eqx.field(converter=tuple)

    def __check_init__(self):
        check_same_dim("Intersection", self.shapes)

    @property
    def dim(self) -> int:
        return self.shapes[0].dim

    @property
    def lipschitz(self) -> Number:
        return steepest(*(shape.lipschitz for shape in self.shapes))

    @property
    def exactness(self) -> Exactness:
        return Exactness(False, all(s.exactness.inside for s in self.shapes))

    def distance(self, *x):
        return functools.reduce(maximum, (shape.distance(*x) for shape in self.shapes))

    def bounding_box(self) -> Box:
        return self.level_box(0.0)

    def level_box(self, level) -> Box:
        boxes = [shape.level_box(level) for shape in self.shapes]
        return hull(boxes, jnp.maximum, jnp.minimum)


class Difference(AbstractSdf):
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

    def bounding_box(self) -> Box:
        return self.base.bounding_box()

    def level_box(self, level) -> Box:
        return self.base.level_box(level)


def union(*shapes: AbstractSdf) -> Union:
    """One flat `Union` of `shapes`, so that long sums do not nest."""
    flat = (s.shapes if isinstance(s, Union) else (s,) for s in shapes)
    return Union(sum(flat, start=()))


def intersection(*shapes: AbstractSdf) -> Intersection:
    """One flat `Intersection` of `shapes`."""
    flat = (s.shapes if isinstance(s, Intersection) else (s,) for s in shapes)
    return Intersection(sum(flat, start=()))
