"""Voronoi cells of seeds, cut by a polygon whose sides each lie within one cell."""

from typing import NamedTuple

import numpy as np

from sorojax.math.spatial import KDTree, Voronoi
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.surface import contour

_BENT = 1.08  # length of a piece of the boundary over its chord that asks for a point


class Border(NamedTuple):
    """The boundary polygon.

    Attributes:
        points: (n, 2) [m].
        edges: (n, 2) with the domain on the left.
        owner: (n,) seed in whose cell an edge lies.
        corner: (n,) whether a point is a corner of the shape.
        between: (n, 2) the two seeds a crossing is midway between, (-1, -1) elsewhere.
    """

    points: np.ndarray
    edges: np.ndarray
    owner: np.ndarray
    corner: np.ndarray
    between: np.ndarray


def polygonise(shape: AbstractSdf, seeds: np.ndarray, size: float) -> Border:
    """The boundary cut where cells meet: a chord per cell, corners kept."""
    tree = KDTree(seeds)
    points, edges, owner, corner, between, start = [], [], [], [], [], 0
    for curve in contour(shape, size / 10):
        loop = _labelled(curve.points, curve.corner, seeds, tree)
        loop = _thinned(*loop)
        n = len(loop[0])
        first = np.arange(n)
        edges.append(start + np.stack([first, (first + 1) % n], axis=1))
        for kept, part in zip((points, corner, owner, between), loop, strict=True):
            kept.append(part)
        start += n
    joined = (np.concatenate(part) for part in (points, edges, owner, corner, between))
    return Border(*joined)


def _labelled(p, corner, seeds, tree):
    """Points of a closed curve with all crossings put in, and the cell after each."""
    label = tree.query(p)[1]
    rows = []
    for i in range(len(p)):
        j = (i + 1) % len(p)
        rows.append((p[i], corner[i], label[i], (-1, -1)))
        for x, a, b in _crossings(p[i], p[j], label[i], label[j], seeds, tree):
            rows.append((x, False, b, (a, b)))
    columns = zip(*rows, strict=True)
    return tuple(np.array(column) for column in columns)


def _crossings(p, q, a: int, b: int, seeds, tree, depth: int = 12):
    """Where the straight line from `p` in cell `a` to `q` in cell `b` changes cells."""
    if a == b:
        return []
    normal = seeds[b] - seeds[a]
    level = (seeds[b] @ seeds[b] - seeds[a] @ seeds[a]) / 2
    slope = normal @ (q - p)
    t = (level - normal @ p) / slope if slope != 0 else 0.5
    x = p + np.clip(t, 0, 1) * (q - p)
    distance, c = tree.query(x)
    if depth == 0 or c in (a, b) or np.linalg.norm(x - seeds[a]) <= distance * (1 + 1e-9):
        return [(x, a, b)]
    before = _crossings(p, x, a, c, seeds, tree, depth - 1)
    return before + _crossings(x, q, c, b, seeds, tree, depth - 1)


def _thinned(p, corner, label, between):
    """Crossings and corners, and points between them where the curve bends too much."""
    fixed = np.flatnonzero(corner | (between[:, 0] >= 0))
    if len(fixed) < 3:
        even = np.linspace(0, len(p), max(3, 8 - len(fixed)) + 1)[:-1].astype(int)
        fixed = np.unique(np.concatenate([fixed, even]))
    keep = []
    ring = np.concatenate([p, p])
    for i, j in zip(fixed, np.r_[fixed[1:], fixed[0] + len(p)], strict=True):
        keep += [i, *_bends(ring, int(i), int(j))]
    keep = np.array(keep) % len(p)
    # Cells are those of the edges: between crossings the cell does not change.
    return p[keep], corner[keep], label[keep], between[keep]


def _bends(ring, i: int, j: int) -> list[int]:
    if j - i < 2:
        return []
    along = np.linalg.norm(np.diff(ring[i : j + 1], axis=0), axis=1).sum()
    if along <= _BENT * np.linalg.norm(ring[j] - ring[i]):
        return []
    middle = (i + j) // 2
    return [*_bends(ring, i, middle), middle, *_bends(ring, middle, j)]


def cut_cells(seeds: np.ndarray, border: Border) -> tuple[np.ndarray, list]:
    """All points, and for each connected piece of a cell its loops of point numbers.

    The first loop of a piece runs counter-clockwise, holes follow clockwise.
    """
    extent = np.ptp(border.points, axis=0).max()
    far = border.points.mean(axis=0) + 20 * extent * np.array(
        [[1, 0.1], [-0.1, 1], [-1, -0.1], [0.1, -1]]
    )
    diagram = Voronoi(np.concatenate([seeds, far]))
    vertices, offset = diagram.vertices, len(border.points)
    inside = _inside(border, vertices)
    crossings: dict[tuple[int, int], list[int]] = {}
    for k in np.flatnonzero(border.between[:, 0] >= 0):
        a, b = sorted(border.between[k].tolist())
        crossings.setdefault((a, b), []).append(int(k))
    sides: list[list[tuple[int, int]]] = [[] for _ in range(len(seeds))]
    for (a, b), owner in zip(border.edges.tolist(), border.owner.tolist(), strict=True):
        sides[owner].append((a, b))
    for (a, b), (u, v) in zip(diagram.ridge_points, diagram.ridge_vertices, strict=True):
        if u < 0 or max(a, b) >= len(seeds):
            continue
        found = crossings.get((min(a, b), max(a, b)), [])
        if not found and not inside[u]:
            continue
        along = vertices[v] - vertices[u]
        if len(found) > 1:
            place = (border.points[found] - vertices[u]) @ along
            found = [found[k] for k in np.argsort(place)]
        stops = [offset + u, *found, offset + v]
        turn = along[0] * (seeds[a] - vertices[u])[1] - along[1] * (seeds[a] - vertices[u])[0]
        left, right = (a, b) if turn > 0 else (b, a)
        for i in range(0 if inside[u] else 1, len(stops) - 1, 2):
            sides[left].append((stops[i], stops[i + 1]))
            sides[right].append((stops[i + 1], stops[i]))
    points = np.concatenate([border.points, vertices])
    return points, [face for own in sides for face in _faces(points, own)]


def _inside(border: Border, p: np.ndarray) -> np.ndarray:
    """Whether points lie inside the polygon, by counting sides to their right."""
    a, b = border.points[border.edges[:, 0]], border.points[border.edges[:, 1]]
    result = np.zeros(len(p), bool)
    for i in range(0, len(p), 1000):
        x, y = p[i : i + 1000, :1], p[i : i + 1000, 1:]
        spans = (a[:, 1] > y) != (b[:, 1] > y)
        rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
        at = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / rise
        result[i : i + 1000] = (spans & (x < at)).sum(axis=1) % 2 == 1
    return result


def _faces(points: np.ndarray, sides: list[tuple[int, int]]) -> list[list[list[int]]]:
    """Loops of one cell, holes put with the piece that surrounds them."""
    after: dict[int, list[int]] = {}
    for a, b in sides:
        after.setdefault(a, []).append(b)
    loops = []
    while after:
        start = next(iter(after))
        loop, here = [start], _pop(after, start)
        while here != start and here in after:
            loop.append(here)
            here = _pop(after, here)
        if len(loop) > 2:
            loops.append(loop)
    areas = [_area(points[loop]) for loop in loops]
    faces = [[loop] for loop, area in zip(loops, areas, strict=True) if area > 0]
    for loop, area in zip(loops, areas, strict=True):
        if area < 0:
            around = [f for f in faces if _holds(points[f[0]], points[loop[0]])]
            (around or faces)[0].append(loop)
    return faces


def _pop(after: dict[int, list[int]], node: int) -> int:
    found = after[node].pop()
    if not after[node]:
        del after[node]
    return found


def _area(x: np.ndarray) -> float:
    y = np.roll(x, -1, axis=0)
    return float((x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum() / 2)


def _holds(x: np.ndarray, p: np.ndarray) -> bool:
    y = np.roll(x, -1, axis=0)
    spans = (x[:, 1] > p[1]) != (y[:, 1] > p[1])
    x, y = x[spans], y[spans]
    at = x[:, 0] + (p[1] - x[:, 1]) * (y[:, 0] - x[:, 0]) / (y[:, 1] - x[:, 1])
    return bool((p[0] < at).sum() % 2)
