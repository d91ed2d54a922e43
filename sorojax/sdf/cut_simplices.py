"""Moments of the inside of simplices cut by a linear field, and their slope in its values.

The derivative of an integral over the inside is minus that over the cut facet of the
moved level, divided by the slope: with nodal values f_i, of the shape function of node i.
"""

import itertools

import numpy as np

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
    for row in ((near[0], near[1], near[2], far[2]), (near[0], near[1], far[1], far[2]),
                (near[0], far[0], far[1], far[2])):  # fmt: skip
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
