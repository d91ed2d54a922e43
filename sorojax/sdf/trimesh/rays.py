"""Rays through triangles, on the host, and the thinnest wall between them."""

import numpy as np

from sorojax.math.host import KDTree

_LEAF = 4  # triangles in the smallest box
_RAYS = 4000  # that measure a wall
_FIRST, _PIECE = 32, 1024  # rays that are followed at once
_OPPOSITE = -0.9  # cosine between the normals of the two sides of a wall
_INWARD = 0.02  # of a triangle: the places asked stay that far from its sides
_FLAT = 1e-9  # height over longest side: below it a triangle has no normal


class TriangleBoxes:
    """Boxes around triangles (n, 3, 3), halved again and again."""

    def __init__(self, corners: np.ndarray):
        from sorojax.sdf.trimesh.tree import order_by_halving

        self.corners, self.order = corners, order_by_halving(corners.mean(axis=1))
        slots = corners[self.order].reshape(-1, 3 * _LEAF, 3)
        self.levels = [(slots.min(axis=1), slots.max(axis=1))]
        while len(self.levels[0][0]) > 1:
            lower, upper = (a.reshape(-1, 2, 3) for a in self.levels[0])
            self.levels.insert(0, (lower.min(axis=1), upper.max(axis=1)))

    def first_hits(self, start: np.ndarray, way: np.ndarray, least: float, most: float):
        """Distance [m] along unit vectors `way` from `start` (rays, 3) to the first triangle
        between `least` and `most`, infinite where there is none, and the triangle."""
        with np.errstate(divide="ignore"):
            inverse = 1 / way
        ray, box = np.arange(len(start)), np.zeros(len(start), int)
        for depth, (lower, upper) in enumerate(self.levels):
            if depth:
                ray, box = np.repeat(ray, 2), np.stack([2 * box, 2 * box + 1], 1).ravel()
            with np.errstate(invalid="ignore"):
                ends = [(side[box] - start[ray]) * inverse[ray] for side in (lower, upper)]
            # 0 * inf for a ray within the plane of a side, which does not bound it
            enter = np.nan_to_num(np.minimum(*ends), nan=-np.inf).max(axis=1)
            leave = np.nan_to_num(np.maximum(*ends), nan=np.inf).min(axis=1)
            slack = 1e-12 * np.abs(leave)
            through = (enter <= leave + slack) & (leave >= 0) & (enter <= most)
            ray, box = ray[through], box[through]
        ray = np.repeat(ray, _LEAF)
        triangle = self.order[(_LEAF * box[:, None] + np.arange(_LEAF)).ravel()]
        distance = _distances(start[ray], way[ray], self.corners[triangle])
        distance[~((distance > least) & (distance <= most))] = np.inf
        far, hit = np.full(len(start), np.inf), np.full(len(start), -1)
        order = np.lexsort((distance, ray))
        first = order[np.r_[True, np.diff(ray[order]) > 0]] if len(ray) else order
        far[ray[first]], hit[ray[first]] = distance[first], triangle[first]
        return far, hit


def _distances(start, way, corners) -> np.ndarray:
    """Along rays to triangles (n, 3, 3), NaN where they miss (Moeller and Trumbore 1997)."""
    a = corners[:, 0]
    u, v = corners[:, 1] - a, corners[:, 2] - a
    p = np.cross(way, v)
    gap = start - a
    q = np.cross(gap, u)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / (u * p).sum(axis=1)
        s, t = (gap * p).sum(axis=1) * scale, (way * q).sum(axis=1) * scale
        # Sides are part of both triangles: no ray slips through between them.
        inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
        return np.where(inside, (v * q).sum(axis=1) * scale, np.nan)


def least_wall(vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Smallest distance [m] through a closed surface along inward normals.

    Rays start from up to about 4000 places, spread over the area and towards the corners of
    large triangles. Only sides that face away from each other within 25 degrees make a wall:
    towards a sharp edge the distance goes to zero.
    """
    corners = vertices[triangles]
    sides = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(sides[:, 0], sides[:, 1])
    double = np.linalg.norm(normal, axis=1)
    longest = (sides**2).sum(axis=2).max(axis=1)
    real = np.flatnonzero(double > _FLAT * longest)
    if not len(real):
        return np.inf
    corners, normal = corners[real], normal[real] / double[real, None]
    number, places = _places(corners, double[real])
    extent = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    boxes = TriangleBoxes(corners)
    wall, done, count = np.inf, 0, _FIRST
    shuffled = np.random.default_rng(0).permutation(len(number))
    while done < len(number):
        rows = shuffled[done : done + count]
        most = min(wall, 2 * extent)  # what is farther does not matter any more
        far, hit = boxes.first_hits(places[rows], -normal[number[rows]], 1e-9 * extent, most)
        opposite = (normal[hit] * normal[number[rows]]).sum(axis=1) < _OPPOSITE
        wall = float(far[np.isfinite(far) & opposite].min(initial=wall))
        done, count = done + count, min(2 * count, _PIECE)
    return wall


def _places(corners: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles and places on them (n, 3): centres, and more on the larger ones."""
    rows = np.arange(0, len(corners), -(-len(corners) // _RAYS))
    # a triangle with a share of the area gets that share of the rays, as a grid
    share = area[rows] / area[rows].sum() * _RAYS
    side = np.where(share > 1.5, np.ceil(np.sqrt(share)), 0).astype(int)
    number, weights = [rows], [np.full((len(rows), 3), 1 / 3)]
    for n in np.unique(side[side > 0]):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        grid = np.stack([i, j, n - i - j], axis=-1).reshape(-1, 3)
        grid = grid[grid[:, 2] >= 0] / n
        grid = (1 - 3 * _INWARD) * grid + _INWARD
        mine = rows[side == n]
        number.append(np.repeat(mine, len(grid)))
        weights.append(np.tile(grid, (len(mine), 1)))
    number, weight = np.concatenate(number), np.concatenate(weights)
    return number, (weight[:, :, None] * corners[number]).sum(axis=1)


# Triangles that pass through each other


_MOST = 1000  # pairs that are listed
_PAIRS_AT_ONCE = 20_000


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
        for start in range(0, len(own), _PAIRS_AT_ONCE):
            rows = own[start : start + _PAIRS_AT_ONCE]
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
