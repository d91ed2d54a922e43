"""Polygonal meshes: Voronoi cells made even by Lloyd's method and cut by the boundary polygon.

In PolyMesher seeds are mirrored at the boundary, which fails in walls thinner than a cell; a
cut is exact for every number of cells. Cells that are not convex are split without new
points: holes are joined to the outside, ears cut off, and triangles merged again.

References:
    Talischi, Paulino, Pereira and Menezes, PolyMesher, SMO 45, 2012.
    Hertel and Mehlhorn, Fast triangulation of simple polygons, LNCS 158, 1983.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from sorojax import _check
from sorojax._progress import report
from sorojax._types import real
from sorojax.math.host import KDTree, Voronoi
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.plane.triangulate import ring_area
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import finite_box, raise_empty, values
from sorojax.sdf.surface.marching import contour, cross

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
    ends = border.points[border.edges]
    inside = _inside(ends[:, 0], ends[:, 1], vertices)
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
        left, right = (a, b) if cross(along, seeds[a] - vertices[u]) > 0 else (b, a)
        for i in range(0 if inside[u] else 1, len(stops) - 1, 2):
            sides[left].append((stops[i], stops[i + 1]))
            sides[right].append((stops[i + 1], stops[i]))
    points = np.concatenate([border.points, vertices])
    return points, [face for own in sides for face in _faces(points, own)]


def _inside(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Whether points lie inside polygons with sides from a to b: counts those to the right."""
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
    areas = [ring_area(points[loop]) for loop in loops]
    faces = [[loop] for loop, area in zip(loops, areas, strict=True) if area > 0]
    for loop, area in zip(loops, areas, strict=True):
        if area < 0:
            rings = [points[face[0]] for face in faces]
            holds = [_inside(x, np.roll(x, -1, axis=0), points[loop[:1]])[0] for x in rings]
            faces[int(np.argmax(holds))].append(loop)
    return faces


def _pop(after: dict[int, list[int]], node: int) -> int:
    found = after[node].pop()
    if not after[node]:
        del after[node]
    return found


# Polygons with holes split into convex ones, without new points


_FLAT = 1e-12


def convex_parts(points: np.ndarray, loops: list[list[int]]) -> list[list[int]]:
    """Convex cells, counter-clockwise, of the piece inside `loops`, the outer one first."""
    if len(loops) == 1 and is_convex(points, loops[0]):
        return [loops[0]]
    ring = loops[0]
    for hole in sorted(loops[1:], key=lambda h: -points[h, 0].max()):
        ring = _bridged(points, ring, hole)
    return _merged(points, _ears(points, ring))


def is_convex(points: np.ndarray, ring: list[int]) -> bool:
    x = points[ring]
    into, out = x - np.roll(x, 1, axis=0), np.roll(x, -1, axis=0) - x
    return bool((cross(into, out) >= -_FLAT * np.ptp(x, axis=0).max() ** 2).all())


def _turn(points, a: int, b: int, c: int) -> float:
    return float(cross(points[b] - points[a], points[c] - points[a]))


def _bridged(points, ring: list[int], hole: list[int]) -> list[int]:
    """One ring that runs into the hole and back over the shortest free bridge."""
    pairs = [(i, j) for i in range(len(ring)) for j in range(len(hole))]
    pairs.sort(key=lambda ij: float(((points[ring[ij[0]]] - points[hole[ij[1]]]) ** 2).sum()))
    sides = [*zip(ring, ring[1:] + ring[:1], strict=True)]
    sides += [*zip(hole, hole[1:] + hole[:1], strict=True)]
    for i, j in pairs:
        a, b = ring[i], hole[j]
        if not any(_cross(points, a, b, c, d) for c, d in sides):
            return ring[: i + 1] + hole[j:] + hole[: j + 1] + ring[i:]
    return ring


def _cross(points, a: int, b: int, c: int, d: int) -> bool:
    if {a, b} & {c, d}:
        return False
    first = _turn(points, a, b, c) * _turn(points, a, b, d)
    return first < 0 and _turn(points, c, d, a) * _turn(points, c, d, b) < 0


def _ears(points, ring: list[int]) -> list[list[int]]:
    ring, triangles = list(ring), []
    least = _FLAT * float(np.ptp(points[ring], axis=0).max()) ** 2
    while len(ring) > 3:
        n, best = len(ring), None
        for i in range(n):
            a, b, c = ring[i - 1], ring[i], ring[(i + 1) % n]
            turn = _turn(points, a, b, c)
            if turn > least and not _blocked(points, ring, a, b, c):
                sides = points[[a, b, c]] - points[[b, c, a]]
                shape = turn / float((sides**2).sum())
                if best is None or shape > best[0]:
                    best = (shape, i)
        if best is None:
            break  # flat remains have no area
        i = best[1]
        triangles.append([ring[i - 1], ring[i], ring[(i + 1) % n]])
        del ring[i]
    if len(ring) == 3 and _turn(points, *ring) > least:
        triangles.append(ring)
    return triangles


def _blocked(points, ring, a: int, b: int, c: int) -> bool:
    p = points[[k for k in ring if k not in (a, b, c)]]
    inside = np.ones(len(p), bool)
    for u, v in ((a, b), (b, c), (c, a)):
        edge, to = points[v] - points[u], p - points[u]
        inside &= cross(edge, to) >= 0
    return bool(inside.any())


def _merged(points, parts: list[list[int]]) -> list[list[int]]:
    """Parts joined over common sides, longest first, while they stay convex."""
    owner = {}
    for k, part in enumerate(parts):
        for a, b in zip(part, part[1:] + part[:1], strict=True):
            owner[a, b] = k
    inner = [(a, b) for a, b in owner if a < b and (b, a) in owner]
    inner.sort(key=lambda e: -float(((points[e[0]] - points[e[1]]) ** 2).sum()))
    for a, b in inner:
        i, j = owner[a, b], owner[b, a]
        if i == j:
            continue
        one, two = parts[i], parts[j]
        p, q = one.index(b), two.index(a)
        joined = (one[p:] + one[:p]) + (two[q:] + two[:q])[1:-1]
        if len(set(joined)) == len(joined) and is_convex(points, joined):
            parts[i], parts[j] = joined, []
            for u, v in zip(joined, joined[1:] + joined[:1], strict=True):
                owner[u, v] = i
    return [part for part in parts if part]


# Polygonal meshes: Voronoi cells evened out by Lloyd's method, cut at the boundary


_SAMPLES = 250  # per cell: points that stand for its area in Lloyd's method
_EVEN = 5e-3  # Lloyd error that ends the iterations
_EXCHANGES = (8, 14, 20, 26, 32, 38)  # steps after which the largest cells are divided
_LARGE, _SMALL = 1.12, 0.92  # of the mean area
_UNEVEN, _PULLS = 0.1, 16  # deviation of areas over their mean that asks for evening; steps


def polymesher(
    shape: AbstractSdf,
    count: int,
    *,
    key: jax.Array,
    iterations: int = 60,
    on_step: Callable[[int, float], None] | None = None,
) -> Mesh:
    """About `count` convex polygons that fill a plane shape: an even Voronoi diagram.

    Lloyd's method moves seeds to the centroids of their cells. Cells of curved boundaries end
    in chords, one per cell; cells are split at re-entrant corners, at holes inside them, and
    where a thin gap divides them, so the mesh may have more than `count`. Node set "corners",
    facet set "boundary".

    Args:
        shape: A concrete, bounded plane shape.
        count: Number of Voronoi seeds, 2 or more.
        key: Random key of the first seeds.
        iterations: Most steps of Lloyd's method.
        on_step: Called with the number of each step and its Lloyd error: the shift of
            the seeds over the size of a cell, weighted by area. Nothing is called by default.

    Returns:
        The mesh, points [m].

    Raises:
        ValueError: If the shape is not plane, empty, unbounded or traced, or `count` is below
            2.

    Example:
        >>> plate = sdf.Rectangle([0, 0], [40 * mm, 10 * mm])
        >>> cells = mesh.polymesher(plate, 8, key=jax.random.key(0), iterations=5)
        >>> cells.num_cells
        8

    Reference:
        Talischi, Paulino, Pereira and Menezes, PolyMesher: a general-purpose mesh generator for
        polygonal elements written in Matlab, Struct. Multidisc. Optim. 45, 2012.
    """
    if count < 2:
        raise ValueError(f"polymesher: `count` is {count}, need at least 2 cells.")
    _check.float64("polymesher", real(0.0))
    lower, upper = finite_box("polymesher", shape, 2)
    cloud, area = _cloud(shape, lower, upper, count)
    picked = jax.random.choice(key, len(cloud), (count,), replace=False)
    seeds = _lloyd(shape, cloud, area, cloud[np.asarray(picked)], iterations, on_step)
    border = polygonise(shape, seeds, float(np.sqrt(area / count)))
    points, faces = cut_cells(seeds, border)
    cells = [part for loops in faces for part in convex_parts(points, loops)]
    mesh = _packed(points, cells)
    _check_area(mesh, border)
    corners = np.flatnonzero(border.corner)
    place = KDTree(np.asarray(mesh.points)).query(border.points[corners])[1]
    sets = {"boundary": boundary_facets(mesh)}
    return Mesh(mesh.points, mesh.cells, mesh.element, {"corners": np.unique(place)}, sets)


def _cloud(shape, lower, upper, count: int) -> tuple[np.ndarray, float]:
    """Points of a fine grid inside `shape`, and their area [m^2]."""
    pitch = float(np.sqrt((upper - lower).prod() / (count * _SAMPLES)))
    for _ in range(2):  # the first grid shows which part of the box is filled
        axes = [np.arange(lower[i] + pitch / 2, upper[i] + pitch / 2, pitch) for i in range(2)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        inside = grid[values(shape, grid) < 0]
        if len(inside) < count:
            raise_empty("polymesher", lower, upper, pitch)
        area = len(inside) * pitch**2
        pitch = float(np.sqrt(area / (count * _SAMPLES)))
    return inside, area


def _lloyd(shape, cloud, area: float, seeds, iterations: int, on_step) -> np.ndarray:
    n = len(seeds)
    for step in range(iterations):
        owner = KDTree(seeds).query(cloud)[1]
        centre, weight = _centres(cloud, owner, seeds)
        share = weight / len(cloud)
        shift = ((centre - seeds) ** 2).sum(axis=1)
        error = float(np.sqrt((share**2 * shift).sum()) * n / np.sqrt(area))
        # The centre of a cell across a gap lies in the gap: its seed stays.
        seeds = np.where((values(shape, centre) < 0)[:, None], centre, seeds)
        if step in _EXCHANGES and step < iterations - 10:
            seeds = _exchanged(seeds, weight)
        report("polymesher", step + 1, iterations, uneven=error)
        if on_step is not None:
            on_step(step, error)
        if error < _EVEN and (step > _EXCHANGES[-1] or iterations <= _EXCHANGES[-1]):
            break
    return _evened(shape, cloud, area, seeds) if iterations > _EXCHANGES[-1] else seeds


def _evened(shape, cloud, area: float, seeds: np.ndarray) -> np.ndarray:
    """Seeds drawn towards larger neighbours, as Lloyd's method makes small cells in cusps.

    The side between two cells is midway between their seeds: it follows into the larger.
    """
    n, pitch = len(seeds), np.sqrt(area / len(cloud))
    best, kept = np.inf, seeds
    for _ in range(_PULLS):
        distance, owner = KDTree(seeds).query(cloud, k=2)
        weight = np.bincount(owner[:, 0], minlength=n)
        uneven = weight.std() / weight.mean()
        if uneven < best:
            best, kept = uneven, seeds
        if best < _UNEVEN:
            break
        a, b = owner[distance[:, 1] - distance[:, 0] < pitch].T
        a, b = np.concatenate([a, b]), np.concatenate([b, a])
        pull = ((weight[b] - weight[a]) / weight.mean())[:, None] * (seeds[b] - seeds[a])
        sides = np.maximum(np.bincount(a, minlength=n), 1)
        drawn = np.stack([np.bincount(a, pull[:, k], n) / sides for k in (0, 1)], axis=1)
        moved = seeds + 0.5 * drawn + 0.3 * (_centres(cloud, owner[:, 0], seeds)[0] - seeds)
        seeds = np.where((values(shape, moved) < 0)[:, None], moved, seeds)
    return kept


def _centres(cloud, owner, seeds) -> tuple[np.ndarray, np.ndarray]:
    """Centre of each cell, its seed if that is empty, and its number of points."""
    n = len(seeds)
    weight = np.bincount(owner, minlength=n)
    total = np.stack([np.bincount(owner, cloud[:, k], n) for k in (0, 1)], axis=1)
    held = (weight > 0)[:, None]
    return np.where(held, total / np.maximum(weight, 1)[:, None], seeds), weight


def _exchanged(seeds: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Seeds of the smallest cells put beside those of the largest ones: Lloyd's method
    alone cannot move cells from a crowded part to an empty one."""
    order, mean = np.argsort(weight), weight.mean()
    count = max(1, len(seeds) // 50)
    small, large = order[:count], order[::-1][:count]
    worth = (weight[small] < _SMALL * mean) & (weight[large] > _LARGE * mean)
    nearest = KDTree(seeds).query(seeds[large], k=2)
    aside = 0.3 * (seeds[nearest[1][:, 1]] - seeds[large])
    seeds = seeds.copy()
    seeds[small[worth]] = seeds[large[worth]] + aside[worth]
    return seeds


def _packed(points: np.ndarray, cells: list[list[int]]) -> Mesh:
    most = max(len(cell) for cell in cells)
    table = np.array([cell + [cell[-1]] * (most - len(cell)) for cell in cells])
    used, number = np.unique(table, return_inverse=True)
    return Mesh(points[used], number.reshape(table.shape), PolyN(most))


def _check_area(mesh: Mesh, border) -> None:
    x = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    got = (cross(x, np.roll(x, -1, axis=1)) / 2).sum()
    want = (cross(*np.moveaxis(border.points[border.edges], 1, 0)) / 2).sum()
    if abs(got - want) > 1e-10 * want:
        raise ValueError(
            f"polymesher: the cells cover {got:.12g} m^2 of the {want:.12g} m^2 inside the "
            "boundary polygon: walls are far thinner than a cell. Raise `count`."
        )
