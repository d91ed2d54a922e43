"""Smooth implicit shapes from densities of cells: level, distance, spline.

Reference: Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal
Processing Magazine 16, 1999.
"""

import functools
import itertools
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.mesh.measure import cell_areas, cell_volumes
from sorojax.mesh.mesh import Mesh
from sorojax.sdf.base import AbstractSdf, Box, Number, clip, norm, number
from sorojax.sdf.shapes.bars import segment_square
from sorojax.sdf.trimesh.cells import triangle_square

_REACH = 1.0  # cells: radius of the means that fill the space between their centres
_NEAR = {2: 16, 3: 48}  # cells within that radius, with room for uneven ones
_CANDIDATES = 12  # pieces of the zero set, by their middles, among which the nearest is


class SplineField(AbstractSdf):
    """A cubic B-spline with `coefficients` [m] on a grid from `origin`, twice smooth.

    The coefficients of a distance give a field near that distance whose bends are rounded at
    the scale of `spacing`, so that meshers see no corners along grid lines. Beyond the grid
    the distance to it is added.
    """

    coefficients: Float[Array, "*nodes"] = eqx.field(converter=real)
    origin: Float[Array, " dim"] = eqx.field(converter=real)
    spacing: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        size = jnp.shape(self.coefficients)
        if len(size) not in (2, 3) or min(size) < 2:
            raise ValueError(
                f"SplineField: `coefficients` has shape {size}, need a 2-D or 3-D grid with at "
                "least 2 nodes per axis. Index it by x first."
            )
        _check.shape("SplineField", "origin", self.origin, (len(size),), "One per axis.")
        _check.positive("SplineField", "spacing", self.spacing, "m", "Give the node distance.")

    @property
    def dim(self) -> int:
        return self.coefficients.ndim

    @property
    def lipschitz(self) -> Number:
        steps = [
            jnp.max(jnp.abs(jnp.diff(self.coefficients, axis=i))) / self.spacing
            for i in range(self.dim)
        ]
        return number(jnp.sqrt(1 + sum((s * s for s in steps), start=0 * self.spacing)))

    def distance(self, *x):
        place = [(c - self.origin[i]) / self.spacing for i, c in enumerate(x)]
        held = [
            clip(c, 0.0, n - 1.0) for c, n in zip(place, self.coefficients.shape, strict=True)
        ]
        beyond = norm(*(c - h for c, h in zip(place, held, strict=True)))
        axes = [_taps(h, n) for h, n in zip(held, self.coefficients.shape, strict=True)]
        total = self.spacing * beyond
        for taps in itertools.product(*axes):
            weight = functools.reduce(lambda a, b: a * b, (w for _, w in taps))
            total = total + weight * self.coefficients[tuple(i for i, _ in taps)]
        return total

    def bounding_box(self) -> Box:
        return self.level_box(0.0)

    def level_box(self, level) -> Box:
        last = jnp.asarray(np.array(self.coefficients.shape) - 1.0, self.origin.dtype)
        edges = [
            jnp.min(jnp.take(self.coefficients, i, axis=axis))
            for axis in range(self.dim)
            for i in (0, -1)
        ]
        reach = jnp.maximum(level - functools.reduce(jnp.minimum, edges), 0)
        return self.origin - reach, self.origin + self.spacing * last + reach


def _taps(place: Array, count: int) -> list[tuple[Array, Array]]:
    """The four nodes beside a place in cells, and their weights."""
    low = jnp.clip(jnp.floor(jax.lax.stop_gradient(place)), 0, count - 2)
    t = place - low
    s = 1 - t
    weights = (
        s * s * s / 6,
        (4 - 6 * t * t + 3 * t * t * t) / 6,
        (4 - 6 * s * s + 3 * s * s * s) / 6,
        t * t * t / 6,
    )
    nodes = [jnp.clip(low + k, 0, count - 1).astype(jnp.int32) for k in (-1, 0, 1, 2)]
    return list(zip(nodes, weights, strict=True))


class Samples(NamedTuple):
    """Densities at the nodes of a grid from `origin` [m]."""

    density: Float[np.ndarray, "*nodes"]
    origin: Float[np.ndarray, " dim"]
    spacing: float

    @property
    def points(self) -> Float[np.ndarray, "*nodes dim"]:
        axes = [
            o + self.spacing * np.arange(n)
            for o, n in zip(self.origin, self.density.shape, strict=True)
        ]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def cell_sizes(mesh: Mesh) -> Float[np.ndarray, " cells"]:
    """Areas [m^2] of plane cells, volumes [m^3] of solid ones."""
    return np.asarray((cell_areas if mesh.element.dim == 2 else cell_volumes)(mesh))


def sampled(mesh: Mesh, density, lower, upper, spacing: float, fold) -> Samples:
    """Densities on a grid around the box from `lower` to `upper` [m].

    Between centres of cells they are means over the cells nearby; beyond the mesh those of
    its edge go on. `fold` takes points of the box into the mesh.
    """
    from sorojax.math.host import KDTree

    density = np.asarray(density, float)
    dim = mesh.element.dim
    start = np.asarray(lower) - 4 * spacing
    counts = np.ceil((np.asarray(upper) + 4 * spacing - start) / spacing - 1e-9).astype(int) + 1
    grid = Samples(np.zeros(counts), start, spacing)
    points = fold(np.clip(grid.points.reshape(-1, dim), lower, upper))
    corners = np.asarray(mesh.cells)[:, : mesh.element.num_corners]
    centres = np.asarray(mesh.points)[corners].mean(axis=1)
    radius = _REACH * np.mean(cell_sizes(mesh)) ** (1 / dim)
    near = min(_NEAR[dim], mesh.num_cells)
    distance, cell = KDTree(centres).query(points, k=near)
    distance, cell = distance.reshape(len(points), near), cell.reshape(len(points), near)
    weight = np.maximum(radius - distance, 0.0)
    weight[:, 0] += 1e-12 * radius  # where no centre is near, the nearest alone
    mean = np.sum(weight * density[cell], axis=1) / np.sum(weight, axis=1)
    return grid._replace(density=mean.reshape(counts))


def distance_field(grid: Samples, threshold: float) -> SplineField:
    """The smooth shape near the set where the density exceeds `threshold`."""
    level = threshold - grid.density
    # closed within the margin of the grid, which lies beyond the body
    inner = np.zeros(level.shape, bool)
    inner[(slice(1, -1),) * level.ndim] = True
    level = np.where(inner, level, np.maximum(level, 1e-3))
    level = np.where(np.abs(level) < 1e-9, 1e-9, level)
    if not (level < 0).any():
        raise ValueError(
            "part: no cell is denser than the threshold, need a body. Ask for more `volume`, "
            "or let the optimisation go on."
        )
    pieces = grid.origin + grid.spacing * _pieces(level)
    away = _distances(grid.points.reshape(-1, level.ndim), pieces).reshape(level.shape)
    return SplineField(np.where(level < 0, -away, away), grid.origin, grid.spacing)


def _pieces(level: np.ndarray) -> Float[np.ndarray, "pieces corners dim"]:
    """Segments, in space triangles, of the zero set in units of nodes."""
    if level.ndim == 2:
        from skimage.measure import find_contours

        lines = find_contours(level, 0.0)
        return np.concatenate([np.stack([c[:-1], c[1:]], axis=1) for c in lines])
    from skimage.measure import marching_cubes

    vertices, triangles, *_ = marching_cubes(level, 0.0)
    return vertices[triangles].astype(float)


def _distances(points: np.ndarray, pieces: np.ndarray) -> Float[np.ndarray, " points"]:
    """Distance of points to the nearest of many pieces of about one size."""
    from sorojax.math.host import KDTree

    near = min(_CANDIDATES, len(pieces))
    found = KDTree(pieces.mean(axis=1)).query(points, k=near)[1].reshape(len(points), near)
    square = segment_square if pieces.shape[1] == 2 else triangle_square
    least = np.full(len(points), np.inf)
    for column in found.T:
        corners = (tuple(corner.T) for corner in np.moveaxis(pieces[column], 1, 0))
        least = np.minimum(least, np.asarray(square(tuple(points.T), *corners)))
    return np.sqrt(least)


def joined(level: np.ndarray, keep: int | None, least: float) -> tuple[np.ndarray, float]:
    """Whether nodes belong to the body once islands and holes below `least` nodes are gone,
    and only the `keep` largest pieces stay; and the share of the nodes that was dropped."""
    from scipy.ndimage import label

    inside = level < 0
    pieces = np.asarray(label(inside)[0], dtype=np.int64)  # pyright: ignore[reportIndexIssue]
    sizes = np.bincount(pieces.ravel())[1:]
    count = len(sizes)
    order = np.argsort(-sizes, kind="stable")[: count if keep is None else keep]
    stays = np.zeros(count + 1, bool)
    stays[1 + order[sizes[order] >= least]] = True
    body = stays[pieces]
    holes = np.asarray(label(~body)[0], dtype=np.int64)  # pyright: ignore[reportIndexIssue]
    filled = (np.bincount(holes.ravel()) < least)[holes] & ~body
    dropped = float(np.sum(inside & ~body)) / max(int(inside.sum()), 1)
    return body | filled, dropped


def quantile(density: np.ndarray, share: float) -> float:
    """The value that the `share` of the entries exceeds."""
    if not 0 < share < 1:
        raise ValueError(
            f"part: the body fills {share:.3g} of its domain, need a share between 0 and 1. "
            "Check `volume`, or take the domain itself."
        )
    return float(np.quantile(density, 1 - share)) if math.isfinite(share) else math.nan
