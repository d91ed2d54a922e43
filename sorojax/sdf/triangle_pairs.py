"""Triangles that pass through each other, and the walls between triangles that face away."""

import numpy as np

from sorojax.math.spatial import KDTree

_MOST = 1000  # pairs that are listed
_SAMPLES = 4000  # triangles whose wall is measured
_PIECE = 20_000
_SMOOTH = 0.7  # cosine between neighbours below which an edge is sharp
_OPPOSITE = -0.9  # cosine between the normals of the two sides of a wall


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


def least_wall(vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Smallest diameter [m] of balls inside the surface that touch it at triangle centres.

    A ball shrinks until no other centre lies in it (Ma et al. 2012). At sharp edges the
    balls vanish: triangles that meet a neighbour there are not asked, unless all do, and
    only sides that face away from each other within 25 degrees make a wall. At most 4000
    triangles, spread over the list, are asked.
    """
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.sqrt((normal * normal).sum(axis=1))
    real = np.flatnonzero(length > 0)
    normal, centers = normal[real] / length[real, None], corners[real].mean(axis=1)
    if not len(real):
        return np.inf
    tree = KDTree(centers)
    flat = _away_from_edges(triangles[real], normal)
    asked = np.flatnonzero(flat)
    rows = asked[:: -(-len(asked) // _SAMPLES)]
    point, inward = centers[rows], -normal[rows]
    radius = np.full(len(rows), float(np.ptp(centers, axis=0).max()) + 1e-300)
    touched = rows.copy()
    active = np.arange(len(rows))
    for _ in range(30):
        at, r, into = point[active], radius[active], inward[active]
        distance, near = tree.query(at + r[:, None] * into)
        offset = centers[near] - at
        along = (offset * into).sum(axis=1)
        shrinks = (distance < r * (1 - 1e-6)) & (near != rows[active]) & (along > 0)
        active, near = active[shrinks], near[shrinks]
        if not len(active):
            break
        radius[active] = (offset**2).sum(axis=1)[shrinks] / (2 * along[shrinks])
        touched[active] = near
    opposite = (normal[touched] * normal[rows]).sum(axis=1) < _OPPOSITE
    opposite &= flat[touched]
    return float(2 * radius[opposite].min(initial=np.inf))


def _away_from_edges(triangles: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Triangles all of whose neighbours lie within 45 degrees; all of them if there is none."""
    half = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1), axis=-1)
    name = (half[..., 0] * (int(triangles.max()) + 1) + half[..., 1]).ravel()
    order = np.argsort(name, kind="stable")
    same = np.flatnonzero(name[order[1:]] == name[order[:-1]])
    a, b = order[same] // 3, order[same + 1] // 3
    bent = (normal[a] * normal[b]).sum(axis=1) < _SMOOTH
    flat = np.ones(len(triangles), bool)
    flat[a[bent]] = flat[b[bent]] = False
    return flat if flat.any() else ~flat
