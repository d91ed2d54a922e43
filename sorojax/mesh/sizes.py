"""Wanted edge lengths: one number, or a field over the shape."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sorojax import _check
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import values

_SAMPLES = 64  # per axis of the box, to learn the range of a size field
_MOST_POINTS = 1e7

SizeFunction = Callable[[Float[np.ndarray, "points dim"]], Float[np.ndarray, " points"]]


class Sizes(NamedTuple):
    """Wanted edge length [m] as a function of points, and its range."""

    function: SizeFunction
    smallest: float
    largest: float

    def __call__(self, p: np.ndarray) -> np.ndarray:
        return np.clip(self.function(p), self.smallest, self.largest)

    def scaled(self, factor: float) -> "Sizes":
        """All lengths times `factor`."""
        return Sizes(lambda p: factor * self(p), factor * self.smallest, factor * self.largest)


def grade(shape: AbstractSdf, *, near: float, far: float, growth: float = 0.3) -> SizeFunction:
    """Edge lengths that grow away from the zero set of `shape`, for `size=`.

    Args:
        shape: Where the mesh shall be fine, for example the chambers.
        near: Length on the zero set [m].
        far: Largest length [m].
        growth: Growth of the length per distance; above 0.4 triangles get poor.

    Returns:
        A function of points, as `triangulate` takes it for `size`.
    """
    _check.positive("grade", "near", near, "m", "Give a length above zero.")
    _check.positive("grade", "far", far - near, "m", "`far` must be above `near`.")
    _check.between("grade", "growth", growth, 0.0, 2.0, "", "0.3 is a good start.")
    return lambda p: np.minimum(near + growth * np.abs(values(shape, p)), far)


def constant(length: float) -> Sizes:
    """The same edge length [m] everywhere."""
    return Sizes(lambda p: np.full(len(p), length), length, length)


def sizes(where: str, size: float | SizeFunction, lower, upper) -> Sizes:
    """`size` as a field, checked before any large array is made."""
    crowd = 1.0
    if callable(size):
        axes = [np.linspace(lower[i], upper[i], _SAMPLES) for i in range(len(lower))]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        grid = grid.reshape(-1, len(lower))
        found = np.asarray(size(grid), dtype=float)
        _check.shape(where, "size(points)", found, (len(grid),), "Return one length per point.")
        _check.positive(where, "size(points)", found, "m", "Lengths are above zero.")
        field = Sizes(size, float(found.min()), float(found.max()))
        crowd = float(np.mean((field.smallest / found) ** len(lower)))
    else:
        _check.positive(where, "size", size, "m", "Give the wanted length of a side.")
        field = constant(float(size))
    if field.smallest > 2 * (upper - lower).min():
        raise ValueError(
            f"{where}: edges of {field.smallest:g} m do not fit in a box of {upper - lower} m "
            f"about {(lower + upper) / 2} m: it is {(upper - lower).min():.2g} m thick, need "
            "half of `size`. Lower `size` (lengths are in metres: write 1 * mm)."
        )
    count = crowd * float(np.prod((upper - lower) / field.smallest))
    if count > _MOST_POINTS:
        raise ValueError(
            f"{where}: edges of {field.smallest:g} m over a box of {upper - lower} m take "
            f"about {count:.1g} points, at most {_MOST_POINTS:.0g} are allowed. Raise `size` "
            "(lengths are in metres: write 1 * mm)."
        )
    return field
