"""Triangles that pass through each other."""

import numpy as np

from sorojax.math.spatial import KDTree

_MOST = 1000  # pairs that are listed
_PIECE = 20_000


def _circles(vertices, triangles) -> tuple[np.ndarray, np.ndarray]:
    """Centres (n, 3) of triangles and the reach (n,) of their corners [m]."""
    corners = vertices[triangles]
    centers = corners.mean(axis=1)
    return centers, np.sqrt(((corners - centers[:, None]) ** 2).sum(axis=2)).max(axis=1)


def crossing_triangles(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Pairs (n, 2) of triangles without a common vertex, an edge of one through the other.

    Coplanar overlaps are not found. At most 1000 pairs are returned.
    """
    if len(triangles) < 2:
        return np.zeros((0, 2), int)
    centers, reach = _circles(vertices, triangles)
    found, total = [np.zeros((0, 2), int)], 0
    # Triangles of one size together: a few large ones must not widen every search.
    rank = np.frexp(np.maximum(reach, 1e-300))[1]
    for size in np.unique(rank):
        own = np.flatnonzero(rank == size)
        small = np.flatnonzero(rank <= size)
        tree = KDTree(centers[small])
        for start in range(0, len(own), _PIECE):
            rows = own[start : start + _PIECE]
            lists = tree.query_ball_point(centers[rows], reach[rows] + 2.0 ** float(size))
            first = np.repeat(rows, [len(x) for x in lists])
            second = small[np.concatenate([np.asarray(x, int) for x in lists])]
            keep = (rank[second] < size) | (second > first)
            pairs = _crossing(vertices, triangles, first[keep], second[keep])
            found.append(pairs)
            total += len(pairs)
            if total >= _MOST:
                return np.concatenate(found)[:_MOST]
    return np.concatenate(found)


def _crossing(vertices, triangles, first, second) -> np.ndarray:
    a, b = triangles[first], triangles[second]
    apart = (a[:, :, None] != b[:, None, :]).all(axis=(1, 2))
    first, second = first[apart], second[apart]
    p, q = vertices[triangles[first]], vertices[triangles[second]]
    near = (p.min(axis=1) <= q.max(axis=1)).all(axis=1)
    near &= (q.min(axis=1) <= p.max(axis=1)).all(axis=1)
    first, second, p, q = first[near], second[near], p[near], q[near]
    hit = np.zeros(len(first), bool)
    both = np.concatenate([p, q], axis=1)
    reach = np.ptp(both, axis=1).max(axis=1, initial=0.0)
    # of a volume, from coordinates that are rounded: triangles in one plane are no crossing
    rounding = 16 * np.finfo(float).eps * np.abs(both).max(axis=(1, 2), initial=0.0) * reach**2
    for k in range(3):
        hit |= _pierces(p[:, k], p[:, (k + 1) % 3], q, rounding)
        hit |= _pierces(q[:, k], q[:, (k + 1) % 3], p, rounding)
    return np.sort(np.stack([first[hit], second[hit]], axis=1), axis=1)


def _volume(a, b, c, d) -> np.ndarray:
    """Six times the signed volume of tetrahedra."""
    return (np.cross(b - a, c - a) * (d - a)).sum(axis=1)


def _pierces(start, end, triangle, rounding) -> np.ndarray:
    """Whether segments pass through the inside of triangles (n, 3, 3)."""
    a, b, c = triangle[:, 0], triangle[:, 1], triangle[:, 2]
    ends = _volume(a, b, c, start), _volume(a, b, c, end)
    across = (np.minimum(*ends) < -rounding) & (np.maximum(*ends) > rounding)
    sides = [_volume(start, end, u, v) for u, v in ((a, b), (b, c), (c, a))]
    least, most = np.minimum.reduce(sides), np.maximum.reduce(sides)
    return across & ((least > rounding) | (most < -rounding))
