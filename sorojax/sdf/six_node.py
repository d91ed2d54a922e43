"""Integrals over closed surfaces of six-node triangles, with their slope in the field.

Corners lie where grid edges meet the surface and middles of sides straight above the middle
of their two corners; so each node follows from the field on a line that stays where it is,
and the derivative is that of the integral itself.
"""

from typing import NamedTuple

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.blocks import Grid
from sorojax.sdf.cut_simplices import monomials
from sorojax.sdf.isosurface import Surface
from sorojax.sdf.sample import values_and_gradients

_LOW, _HIGH = (6 - 15**0.5) / 21, (6 + 15**0.5) / 21
_RULE = [
    (1 / 3, 1 / 3, 9 / 40),
    *(
        (s, t, weight)
        for q, weight in ((_LOW, (155 - 15**0.5) / 1200), (_HIGH, (155 + 15**0.5) / 1200))
        for s, t in ((q, q), (q, 1 - 2 * q), (1 - 2 * q, q))
    ),
]
_STEPS = 30
_ON_EDGE = 1e-6  # cells: a vertex of marching cubes this near to a grid plane lies in it


class Nodes(NamedTuple):
    """Points on a surface, each on a line of fixed direction.

    Attributes:
        points: (n, 3) [cells].
        direction: (n, 3) of the line.
        gradient: (n, 3) of the field there [1/cell].
    """

    points: np.ndarray
    direction: np.ndarray
    gradient: np.ndarray

    @property
    def pace(self) -> np.ndarray:
        """(n,) slope of the field along the line, kept off zero."""
        along = (self.direction * self.gradient).sum(axis=1)
        least = 1e-9 * np.sqrt((self.gradient**2).sum(axis=1)) + 1e-300
        return np.where(np.abs(along) < least, np.copysign(least, along), along)


def moments(
    shape: AbstractSdf,
    surface: Surface,
    grid: Grid,
    middle: np.ndarray,
    order: int,
    slope: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Moments (m,) of the inside, nodes (n, 3), slope (n, m) in the field at them.

    Args:
        shape: A smooth solid.
        surface: Its marching cubes on `grid`.
        grid: Cubic cells.
        middle: Where the moments are taken about [m]; lengths are in cells from there.
        order: Highest degree of a moment.
        slope: Whether the slope is asked for; else nodes and slope are empty.
    """
    shift = (grid.lower - middle) / grid.size

    def field(points):
        f, g = values_and_gradients(shape, middle + grid.size * points)
        return f / grid.size, g

    corners = _corners(field, (surface.vertices - grid.lower) / grid.size, shift)
    t = surface.triangles
    side = np.sort(np.stack([t, np.roll(t, -1, axis=1)], axis=-1), axis=-1)
    name = side[..., 0].astype(np.int64) * len(corners.points) + side[..., 1]
    _, first, which = np.unique(name, return_index=True, return_inverse=True)
    ends, which = side.reshape(-1, 2)[first], which.reshape(-1, 3)
    middles = _above(field, corners.points[ends].mean(axis=1))
    rows = [(corners, t[:, k]) for k in range(3)] + [(middles, which[:, k]) for k in range(3)]
    six = [nodes.points[row] for nodes, row in rows]
    total, pulls = _integrate(six, order, slope)
    if not slope:
        return total, np.zeros((0, 3)), np.zeros((0, len(total)))
    on_corners = _gathered(pulls[:3], t.T, len(corners.points))
    on_middles = _gathered(pulls[3:], which.T, len(ends))
    speed = np.einsum("nid,nd->ni", on_middles, middles.direction) / middles.pace[:, None]
    # A middle rides on its corners, less what leaves the surface.
    rest = (on_middles - speed[:, :, None] * middles.gradient[:, None]) / 2
    on_corners += _gathered([rest, rest], ends.T, len(corners.points))
    pace = np.einsum("nid,nd->ni", on_corners, corners.direction) / corners.pace[:, None]
    points = np.concatenate([corners.points, middles.points])
    # The field was divided by the cell to be in cells.
    return total, points, -np.concatenate([pace, speed]) / grid.size


def _corners(field, vertices: np.ndarray, shift: np.ndarray) -> Nodes:
    """Vertices [cells of the grid] put where their grid edges meet the surface."""
    off = np.abs(vertices - np.rint(vertices))
    axis = off.argmax(axis=1)
    rows = np.arange(len(vertices))
    inner = np.sort(off, axis=1)[:, 1] > _ON_EDGE
    direction = np.eye(3)[axis]
    start = vertices.copy()
    start[rows, axis] = np.floor(vertices[rows, axis])
    t = vertices[rows, axis] - start[rows, axis]
    # Marching cubes puts a few vertices inside cells: those move along the slope.
    start[inner], t[inner] = vertices[inner], 0.0
    slope = field(vertices[inner] + shift)[1]
    direction[inner] = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)
    low, high = np.where(inner, -1.0, 0.0), np.ones(len(t))
    return _roots(field, start + shift, direction, low, high, t)


def _above(field, points: np.ndarray) -> Nodes:
    """Where lines through `points` along the slope there meet the surface."""
    slope = field(points)[1]
    direction = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)
    reach = np.ones(len(points))
    return _roots(field, points, direction, -reach, reach, 0 * reach)


def _roots(field, start, direction, low, high, t) -> Nodes:
    """Zeros of `field` on start + t direction between `low` and `high`: guarded Newton."""
    rising = field(start + high[:, None] * direction)[0] >= 0
    active = np.arange(len(t))
    gradient = np.zeros_like(start)
    for _ in range(_STEPS):
        line = direction[active]
        f, g = field(start[active] + t[active, None] * line)
        gradient[active] = g
        above = (f >= 0) == rising[active]
        high[active] = np.where(above, t[active], high[active])
        low[active] = np.where(above, low[active], t[active])
        along = (g * line).sum(axis=1)
        new = t[active] - f / np.where(along == 0, 1.0, along)
        a, b = low[active], high[active]
        outside = ~((new >= a) & (new <= b)) | (along == 0)
        new = np.where(outside, (a + b) / 2, new)
        moved = np.abs(new - t[active]) > 1e-14 * (1 + np.abs(start[active]).max(initial=0))
        t[active] = new
        active = active[moved]
        if not len(active):
            break
    return Nodes(start + t[:, None] * direction, direction, gradient)


def _integrate(six: list[np.ndarray], order: int, slope: bool):
    """Moments by the divergence theorem; their pull (n, m, 3) on each of the six nodes.

    For a monomial g of degree k, div(g x) = (k + 3) g. A closed surface that moves by v
    changes the integral of g by that of g v over it.
    """
    ones = monomials(np.ones((1, 3)), order).size
    degree = np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])[:ones]
    total = np.zeros(ones)
    pulls = [np.zeros((len(six[0]) if slope else 0, ones, 3)) for _ in six]
    for s, t, weight in _RULE:
        r = 1 - s - t
        value = (
            r * (2 * r - 1), s * (2 * s - 1), t * (2 * t - 1), 4 * r * s, 4 * s * t, 4 * t * r,
        )  # fmt: skip
        along_s = (1 - 4 * r, 4 * s - 1, 0.0, 4 * (r - s), 4 * t, -4 * t)
        along_t = (1 - 4 * r, 0.0, 4 * t - 1, -4 * s, 4 * s, 4 * (r - t))
        x, xs, xt = (_blend(row, six) for row in (value, along_s, along_t))
        vector = weight / 2 * np.cross(xs, xt)
        g = monomials(x, order)
        total += (x * vector).sum(axis=1) @ g / (degree + 3)
        if slope:
            push = g[:, :, None] * vector[:, None]
            for pull, share in zip(pulls, value, strict=True):
                pull += share * push
    return total, pulls


def _blend(weights, six: list[np.ndarray]) -> np.ndarray:
    found = weights[0] * six[0]
    for weight, node in zip(weights[1:], six[1:], strict=True):
        found = found + weight * node
    return found


def _gathered(pulls, rows, count: int) -> np.ndarray:
    """Pulls (n, m, 3) on corners of triangles summed over the nodes that they are."""
    flat = np.concatenate(list(rows))
    stacked = np.concatenate(pulls)
    found = np.empty((count, *stacked.shape[1:]))
    for index in np.ndindex(stacked.shape[1:]):
        found[(slice(None), *index)] = np.bincount(flat, stacked[(slice(None), *index)], count)
    return found
