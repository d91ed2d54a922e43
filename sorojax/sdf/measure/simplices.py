"""Moments of the inside of simplices cut by a linear field, and of closed surfaces of six-node
triangles, with their derivative in the nodal values of the field.

The derivative of an integral over the inside is minus that over the cut facet of the moved
level, divided by the gradient. Corners of six-node triangles lie where grid edges meet the
surface, mid-side nodes straight above the middle of their two corners: each node follows from
the field on a line that stays where it is, and the derivative is that of the integral itself.
"""

import itertools
from typing import NamedTuple

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import unit, values_and_gradients
from sorojax.sdf.surface.blocks import Grid
from sorojax.sdf.surface.marching import Surface

# Degree 3 on segments and on triangles, as corner weights and their share of the whole.
_GAUSS = 0.5 - 0.5 / 3**0.5
_RULES = {
    2: ([(_GAUSS, 1 - _GAUSS), (1 - _GAUSS, _GAUSS)], [0.5, 0.5]),
    3: (
        [(1 / 3, 1 / 3, 1 / 3), (0.6, 0.2, 0.2), (0.2, 0.6, 0.2), (0.2, 0.2, 0.6)],
        [-27 / 48, 25 / 48, 25 / 48, 25 / 48],
    ),
}


def pairs(dim: int) -> list[tuple[int, int]]:
    """Second moments in their order: xx, yy[, zz], xy[, yz, zx]."""
    squares = [(i, i) for i in range(dim)]
    return squares + ([(0, 1)] if dim == 2 else [(0, 1), (1, 2), (2, 0)])


def count(dim: int, order: int) -> int:
    """Number of moments up to degree `order`."""
    return (1, 1 + dim, 1 + dim + len(pairs(dim)))[order]


def monomials(points: np.ndarray, order: int) -> np.ndarray:
    """1, x, y[, z], then the second ones of `pairs`, at points (n, dim): (n, moments)."""
    dim = points.shape[1]
    columns = [
        np.ones(len(points)),
        *points.T,
        *(points[:, i] * points[:, j] for i, j in pairs(dim)),
    ]
    return np.stack(columns[: count(dim, order)], axis=1)


def turned(turn: np.ndarray, order: int) -> np.ndarray:
    """Matrix that takes the `monomials` of p to those of `turn` p."""
    dim = len(turn)
    second = pairs(dim)
    matrix = np.zeros((1 + dim + len(second),) * 2)
    matrix[0, 0], matrix[1 : 1 + dim, 1 : 1 + dim] = 1.0, turn
    for k, (i, j) in enumerate(second):
        for m, (a, b) in enumerate(second):
            both = turn[i, a] * turn[j, b] + (a != b) * turn[i, b] * turn[j, a]
            matrix[1 + dim + k, 1 + dim + m] = both
    return matrix[: count(dim, order), : count(dim, order)]


def box_moments(centers: np.ndarray, edge: float, order: int) -> np.ndarray:
    """Moments (n, moments) of cubes."""
    dim = centers.shape[1]
    own = np.zeros(count(dim, order))
    if order == 2:
        own[1 + dim : 1 + 2 * dim] = edge**2 / 12
    return edge**dim * (monomials(centers, order) + own)


def kuhn(dim: int) -> np.ndarray:
    """Simplices of a cube along its diagonal, (dim!, dim + 1) of corners in `ndindex` order."""
    rows = []
    for axes in itertools.permutations(range(dim)):
        corner, row = 0, [0]
        for axis in axes:
            corner += 1 << (dim - 1 - axis)
            row.append(corner)
        rows.append(row)
    return np.array(rows)


def simplex_moments(x: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Volumes (n,) and moments (n, moments) of simplices with corners `x` (n, dim + 1, dim)."""
    dim = x.shape[2]
    e = x[:, 1:] - x[:, :1]
    if dim == 2:
        whole = np.abs(e[:, 0, 0] * e[:, 1, 1] - e[:, 0, 1] * e[:, 1, 0]) / 2
    else:
        a, b, c = e[:, 0], e[:, 1], e[:, 2]
        whole = (
            np.abs(
                a[:, 0] * (b[:, 1] * c[:, 2] - b[:, 2] * c[:, 1])
                + a[:, 1] * (b[:, 2] * c[:, 0] - b[:, 0] * c[:, 2])
                + a[:, 2] * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
            )
            / 6
        )
    moments = np.empty((len(x), count(dim, order)))
    moments[:, 0] = whole
    if order > 0:
        total = x.sum(axis=1)
        moments[:, 1 : 1 + dim] = whole[:, None] * total / (dim + 1)
    if order > 1:
        share = whole / ((dim + 1) * (dim + 2))
        for k, (i, j) in enumerate(pairs(dim)):
            square = (x[:, :, i] * x[:, :, j]).sum(axis=1) + total[:, i] * total[:, j]
            moments[:, 1 + dim + k] = share * square
    return whole, moments


def cut_moments(
    x: np.ndarray, f: np.ndarray, order: int, slope: bool
) -> tuple[np.ndarray, np.ndarray | None]:
    """Moments (n, moments) of the part f < 0 of simplices that have both signs.

    Args:
        x: (n, dim + 1, dim) corners.
        f: (n, dim + 1) values there.
        order: Highest degree of a moment.
        slope: Whether to return the derivative (n, dim + 1, moments) in `f` as well.
    """
    size, dim = f.shape[1], x.shape[2]
    rank = np.argsort(f, axis=1, kind="stable")
    rows = np.arange(len(f))[:, None]
    x, f = x[rows, rank], f[rows, rank]
    inside = (f < 0).sum(axis=1)
    moments = np.zeros((len(f), count(dim, order)))
    steep = np.zeros((len(f), size, moments.shape[1])) if slope else None
    for number in range(1, size):
        at = np.flatnonzero(inside == number)
        if not len(at):
            continue
        if number == 1:
            parts, sign = [(0, [(0, j) for j in range(1, size)])], 1.0
        elif number == size - 1:
            parts, sign = [(size - 1, [(size - 1, j) for j in range(size - 1)])], -1.0
            moments[at] = simplex_moments(x[at], order)[1]
        else:
            parts, sign = [], 1.0
            _wedges(x[at], f[at], order, at, moments, steep)
        for apex, ends in parts:
            shares = _shares(f[at], ends)
            corners = np.concatenate([x[at][:, apex, None], shares @ x[at]], axis=1)
            whole, found = simplex_moments(corners, order)
            moments[at] += sign * found
            if steep is not None:
                steep[at] -= _facet(x[at], shares, whole, f[at][:, apex], order)
    if steep is not None:
        back = np.empty_like(steep)
        back[rows, rank] = steep
        return moments, back
    return moments, None


def _shares(f, ends) -> np.ndarray:
    """Where the field vanishes on edges: shares (n, edges, corners) of the corners."""
    shares = np.zeros((len(f), len(ends), f.shape[1]))
    for k, (i, j) in enumerate(ends):
        t = f[:, i] / (f[:, i] - f[:, j])
        shares[:, k, i], shares[:, k, j] = 1 - t, t
    return shares


def _wedges(x, f, order, at, moments, steep) -> None:
    """Tetrahedra with two corners inside: a wedge (0, 02, 03)-(1, 12, 13) in three parts."""
    cut = _shares(f, [(0, 2), (0, 3), (1, 2), (1, 3)])
    one = np.zeros((2, len(f), 4))
    one[0, :, 0] = one[1, :, 1] = 1
    near, far = (one[0], cut[:, 0], cut[:, 1]), (one[1], cut[:, 2], cut[:, 3])
    for row in (
        (near[0], near[1], near[2], far[2]),
        (near[0], near[1], far[1], far[2]),
        (near[0], far[0], far[1], far[2]),
    ):
        corners = np.stack(row, axis=1)
        whole, found = simplex_moments(corners @ x, order)
        moments[at] += found
        if steep is not None and row[1] is near[1]:
            steep[at] -= _facet(x, corners[:, 1:], whole, f[:, 0], order)


def _facet(x, shares, whole, level, order) -> np.ndarray:
    """Integrals over cut facets of shape functions times monomials, over the slope.

    The simplex between a facet and a corner of value `level` gives area over slope: its
    volume is area * |level| / (slope * dim).
    """
    dim = x.shape[2]
    ratio = dim * whole / np.maximum(np.abs(level), 1e-300)
    corners, parts = _RULES[dim] if order else ([(1 / dim,) * dim], [1.0])
    total = 0.0
    for place, part in zip(corners, parts, strict=True):
        share = np.einsum("k,nks->ns", np.array(place), shares)
        point = np.einsum("ns,nsd->nd", share, x)
        total = total + part * share[:, :, None] * monomials(point, order)[:, None, :]
    return ratio[:, None, None] * total


# Integrals over closed surfaces of six-node triangles, with their slope in the field


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
    direction[inner] = unit(field(vertices[inner] + shift)[1])
    low, high = np.where(inner, -1.0, 0.0), np.ones(len(t))
    return _roots(field, start + shift, direction, low, high, t)


def _above(field, points: np.ndarray) -> Nodes:
    """Where lines through `points` along the slope there meet the surface."""
    reach = np.ones(len(points))
    return _roots(field, points, unit(field(points)[1]), -reach, reach, 0 * reach)


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
