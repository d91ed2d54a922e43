"""Polygonal meshes: Voronoi cells evened out by Lloyd's method, cut at the boundary.

Reference: Talischi, Paulino, Pereira, Menezes, PolyMesher, SMO 45, 2012. There seeds are
mirrored at the boundary, which fails in walls thinner than a cell; here the cells are
cut by the boundary polygon, which is exact for every number of cells.
"""

from collections.abc import Callable

import jax
import numpy as np

from sorojax import _check
from sorojax._progress import report
from sorojax._types import real
from sorojax.math.spatial import KDTree
from sorojax.mesh.convex import convex_parts
from sorojax.mesh.elements import PolyN
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.voronoi import cut_cells, polygonise
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import finite_box, raise_empty, values

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
    """About `count` convex polygons that fill a plane shape.

    Cells of curved boundaries end in chords, one per cell; cells are split at re-entrant
    corners, at holes inside them, and where a thin gap divides them, so the mesh may
    have more than `count`. Node set "corners", facet set "boundary".

    Args:
        shape: A concrete, bounded plane shape.
        count: Number of Voronoi seeds.
        key: Random key of the first seeds.
        iterations: Most steps of Lloyd's method.
        on_step: Called with the number of each step and its Lloyd error: the shift of
            the seeds over the size of a cell, weighted by area.

    Raises:
        ValueError: If the shape is empty, unbounded or traced, or `count` is below 2.
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
    for _ in range(2):  # the first grid tells which part of the box is filled
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
    got = _shoelace(x, np.roll(x, -1, axis=1)).sum()
    want = _shoelace(border.points[border.edges[:, 0]], border.points[border.edges[:, 1]]).sum()
    if abs(got - want) > 1e-10 * want:
        raise ValueError(
            f"polymesher: the cells cover {got:.12g} m^2 of the {want:.12g} m^2 inside the "
            "boundary polygon: walls are far thinner than a cell. Raise `count`."
        )


def _shoelace(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]) / 2
