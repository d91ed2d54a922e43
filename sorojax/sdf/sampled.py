"""Shapes from arrays: images, distances on a grid, height maps."""

import functools
import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.sdf.base import AbstractSdf, Box, Number, number, steepest
from sorojax.sdf.scalar import clip, norm


def interpolate(values: Array, place: tuple[Array, ...]) -> Array:
    """Multilinear interpolation of `values` at `place` in cells, held at the edges."""
    corner, part = [], []
    for axis, c in enumerate(place):
        last = values.shape[axis] - 1
        low = jnp.clip(jnp.floor(jax.lax.stop_gradient(c)), 0, max(last - 1, 0))
        corner.append(low.astype(jnp.int32))
        part.append(clip(c, 0.0, float(last)) - low)
    total = jnp.zeros_like(place[0])
    for offset in itertools.product((0, 1), repeat=len(place)):
        weight = functools.reduce(
            lambda a, b: a * b, (p if o else 1 - p for o, p in zip(offset, part, strict=True))
        )
        index = tuple(i + o for i, o in zip(corner, offset, strict=True))
        total = total + weight * values[index]
    return total


class Sampled(AbstractSdf):
    """Distances `values` [m] on a grid, interpolated linearly; `origin` is node (0, 0).

    Beyond the grid the distance to it is added.
    """

    values: Float[Array, "*nodes"] = eqx.field(converter=real)
    origin: Float[Array, " dim"] = eqx.field(converter=real)
    spacing: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        size = jnp.shape(self.values)
        if len(size) not in (2, 3) or min(size) < 2:
            raise ValueError(
                f"Sampled: `values` has shape {size}, need a 2-D or 3-D grid with at least 2 "
                "nodes per axis. Index it by x first."
            )
        _check.shape("Sampled", "origin", self.origin, (len(size),), "One per axis.")
        _check.positive("Sampled", "spacing", self.spacing, "m", "Give the node distance.")

    @property
    def dim(self) -> int:
        return self.values.ndim

    @property
    def lipschitz(self) -> Number:
        steps = [
            jnp.max(jnp.abs(jnp.diff(self.values, axis=i))) / self.spacing
            for i in range(self.dim)
        ]
        steepness = jnp.sqrt(sum((s * s for s in steps), start=jnp.zeros_like(self.spacing)))
        # Beyond a corner of the grid only the distance to it varies.
        return number(jnp.sqrt(1 + steepness**2))

    def distance(self, *x):
        place = tuple((c - self.origin[i]) / self.spacing for i, c in enumerate(x))
        last = [float(n - 1) for n in jnp.shape(self.values)]
        held = (clip(c, 0.0, end) for c, end in zip(place, last, strict=True))
        beyond = norm(*(c - h for c, h in zip(place, held, strict=True)))
        return interpolate(self.values, place) + self.spacing * beyond

    def bounding_box(self) -> Box:
        return self.level_box(0.0)

    def level_box(self, level) -> Box:
        last = jnp.asarray(np.array(self.values.shape) - 1.0, self.origin.dtype)
        # Shapes that run over the edge of the grid go on beyond it.
        edges = [
            jnp.min(jnp.take(self.values, i, axis=axis))
            for axis in range(self.dim)
            for i in (0, -1)
        ]
        reach = jnp.maximum(level - functools.reduce(jnp.minimum, edges), 0)
        return self.origin - reach, self.origin + self.spacing * last + reach


def image(mask: Numbers, pixel: float, origin: Numbers | None = None) -> Sampled:
    """The shape of the true pixels (or voxels) of `mask`, by Euclidean distance transform.

    Args:
        mask: Array of booleans, rows from bottom to top: index (row, column) is (y, x) in
            the plane; volumes are indexed (x, y, z).
        pixel: Size of a pixel [m].
        origin: Centre of the first pixel [m].
    """
    from scipy.ndimage import distance_transform_edt

    mask = np.asarray(mask, dtype=bool)
    if mask.ndim not in (2, 3) or mask.all() or not mask.any():
        raise ValueError(
            f"image: got a mask of shape {mask.shape} with {int(mask.sum())} true pixels, need "
            "a 2-D or 3-D mask with both values. Choose another threshold."
        )
    mask = mask.T if mask.ndim == 2 else mask
    mask = np.pad(mask, 1)
    outside, inside = (np.asarray(distance_transform_edt(m)) for m in (~mask, mask))
    # Distances run from centre to centre: the boundary lies half a pixel before.
    field = np.where(mask, 0.5 - inside, outside - 0.5) * pixel
    start = np.zeros(mask.ndim) if origin is None else np.asarray(origin, dtype=float)
    return Sampled(field, start - pixel, pixel)


class HeightMap(AbstractSdf):
    """Everything below the surface z = `heights` [m] over a grid, held at its edges.

    The field is the height over the surface, with a Lipschitz constant above one.
    """

    heights: Float[Array, "x y"] = eqx.field(converter=real)
    origin: Float[Array, "2"] = eqx.field(converter=real)
    spacing: Float[Array, "2"] = eqx.field(converter=real)

    def __check_init__(self):
        _check.shape("HeightMap", "heights", self.heights, (None, None), "Index x first.")
        _check.shape("HeightMap", "origin", self.origin, (2,), "Give (x, y).")
        _check.shape("HeightMap", "spacing", self.spacing, (2,), "Give (x, y).")
        _check.positive("HeightMap", "spacing", self.spacing, "m", "Give node distances.")
        if min(self.heights.shape) < 2:
            raise ValueError(
                f"HeightMap: `heights` has shape {self.heights.shape}, need at least 2 nodes "
                "per axis. Use a HalfSpace for a level plane."
            )

    @property
    def dim(self) -> int:
        return 3

    @property
    def lipschitz(self) -> Number:
        slopes = [
            jnp.max(jnp.abs(jnp.diff(self.heights, axis=i))) / self.spacing[i] for i in (0, 1)
        ]
        return steepest(number(jnp.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)), 1.0)

    def distance(self, x, y, z):
        place = tuple((c - self.origin[i]) / self.spacing[i] for i, c in enumerate((x, y)))
        return z - interpolate(self.heights, place)

    def bounding_box(self) -> Box:
        return self.level_box(0.0)

    def level_box(self, level) -> Box:
        top = jnp.max(self.heights) + level
        infinity = jnp.full_like(top, math.inf)
        return (
            jnp.stack([-infinity, -infinity, -infinity]), jnp.stack([infinity, infinity, top])
        )  # fmt: skip
