"""Dual contouring: one vertex per sheet and cell, placed by the planes of its crossings.

Ju et al. 2002 for the vertices; the sheets make the surface manifold (Schaefer et al. 2007).
The blocks go through in groups, so that only crossings and the result are held for all.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.blocks import Grid, leaf_fields
from sorojax.sdf.dual_crossings import (
    Crossings,
    blocks_before,
    cells_before,
    corner,
    crossings,
)
from sorojax.sdf.dual_rims import refuse_lost_walls
from sorojax.sdf.dual_sheets import Faces, cell_sheets, doubtful_faces
from sorojax.sdf.dual_vertices import SUMS, gathered, place
from sorojax.sdf.sample import values

# Cells around a grid edge, counter-clockwise: how far they begin before it.
_AROUND = ((1, 1), (0, 1), (0, 0), (1, 0))
_PIECE = 1 << 13
_GROUP = 512  # blocks that go through together


class Cells(NamedTuple):
    """All cells that hold surface, in order, and the vertices they get.

    Attributes:
        name: (n,) as in `dual_crossings`.
        code: (n,) bits of the inside corners.
        kind: (n,) rows of `edges`.
        edges: (kinds, 12) which vertex of the cell lies on each cell edge.
        first: (n + 1,) number of the first vertex.
    """

    name: np.ndarray
    code: np.ndarray
    kind: np.ndarray
    edges: np.ndarray
    first: np.ndarray


def dual_contouring(
    shape: AbstractSdf, grid: Grid, blocks: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [m] inside their cells, and triangles that face outwards."""
    groups, done = [], 0
    for group, field in leaf_fields(shape, grid, blocks, _GROUP):
        groups.append(crossings(shape, grid, group, field, done))
        done += len(group)
        del field
    before = blocks_before(grid, blocks)
    cells = _numbered(shape, grid, blocks, before, groups)
    vertices = np.empty((int(cells.first[-1]), 3))
    count = sum(len(group.offset) for group in groups)
    triangles, row = np.empty((2, count, 3), np.int32), 0
    for quads, group, points in _placed(shape, grid, blocks, before, groups, cells, vertices):
        for start in range(0, len(quads), _PIECE):
            piece = slice(start, start + _PIECE)
            split = _split(vertices, quads[piece], points[piece], group.normal[piece])
            triangles[:, row : row + split.shape[1]] = split
            row += split.shape[1]
    vertices *= grid.size
    vertices += grid.lower
    return vertices, triangles.reshape(-1, 3)


def _numbered(shape, grid, blocks, before, groups: list[Crossings]) -> Cells:
    name = np.concatenate([group.cells for group in groups])
    code = np.concatenate([group.code for group in groups])
    second = doubtful_faces(code)
    axis = np.repeat(np.arange(3), [len(rows) for rows in second])
    names = np.concatenate(
        [cells_before(before, name[rows], 1 << f) for f, rows in enumerate(second)]
    )
    first = np.minimum(np.searchsorted(name, names), max(len(name) - 1, 0))
    if not np.array_equal(name[first], names):
        _raise_leaving()
    faces = Faces(first, np.concatenate(second), axis)
    middle = corner(blocks, name[faces.second]) + (1 - np.eye(3)[axis]) / 2
    sheets = cell_sheets(code, faces, values(shape, grid.points(middle)) < 0)
    ends = np.zeros(len(name) + 1, np.int32)
    np.cumsum(sheets.number[sheets.kind], out=ends[1:])
    return Cells(name, code, sheets.kind, sheets.edges, ends)


def _placed(
    shape, grid, blocks, before, groups: list[Crossings], cells: Cells, vertices: np.ndarray
) -> Iterator[tuple[np.ndarray, Crossings, np.ndarray]]:
    """Quadrilaterals of each group with its crossings, once all their vertices are placed.

    A group's vertices are placed when the next group, which shares cells walls with its
    last layer, has added its planes.
    """
    ends = np.concatenate([[0], np.cumsum([len(group.cells) for group in groups])])
    old = np.zeros((0, SUMS))
    held = None
    for g in range(len(groups) + 1):
        low, now = ends[max(g - 1, 0)], ends[min(g, len(groups))]
        if g < len(groups):
            total = np.zeros((cells.first[ends[g + 1]] - cells.first[low], SUMS))
            total[: len(old)] = old
            group = groups[g]
            # Given up here, so that memory falls as the result grows.
            groups[g] = groups[g]._replace(offset=None, normal=None)  # type: ignore
            quads = quads_around(before, group, cells, slice(low, ends[g + 1]), now)
            rows = now + np.concatenate(group.edges)
            points = corner(blocks, cells.name[rows]) + group.offset
            gathered(points, group.normal, quads - cells.first[low], total)
        if held is not None:
            own = slice(low, now)
            owner = np.repeat(np.arange(low, now), np.diff(cells.first[low : now + 1]))
            first = corner(blocks, cells.name[owner])
            alone = np.diff(cells.first)[owner] == 1
            done = total[: len(owner)]
            refuse_lost_walls(shape, grid, done, first, cells.code[owner])
            vertices[cells.first[own.start] : cells.first[own.stop]] = place(done, first, alone)
            yield held
        if g < len(groups):
            held = quads, group, points
            old = total[cells.first[now] - cells.first[low] :].copy()
            total = old


def quads_around(before, group: Crossings, cells: Cells, window: slice, now: int) -> np.ndarray:
    """Vertices (n, 4) around the crossed edges of `group`, seen from outside.

    Args:
        before: Of `blocks_before`.
        group: Crossings.
        cells: All cells; those of the group start at row `now`.
        window: Rows of the cells that may touch the edges.
        now: See above.
    """
    name = cells.name[window]
    base = int(name[0]) if len(name) else 0
    index = np.full(int(name[-1]) - base + 1 if len(name) else 0, -1, np.int32)
    index[name - base] = np.arange(window.start, window.stop)
    quads, done = np.empty((sum(map(len, group.edges)), 4), np.int32), 0
    for axis, edges in enumerate(group.edges):
        part = quads[done : done + len(edges)]
        done += len(edges)
        start = cells.name[now + edges]
        for k, (d, e) in enumerate(_AROUND):
            bits = d << (axis + 1) % 3 | e << (axis + 2) % 3
            at = cells_before(before, start, bits) - base
            cell = index[np.maximum(at, 0)]
            if (at < 0).any() or (cell < 0).any():
                _raise_leaving()
            part[:, k] = cells.first[cell] + cells.edges[cells.kind[cell], 4 * axis + d + 2 * e]
        turned = cells.code[now + edges] & 1 == 0
        part[turned] = part[turned, ::-1]
    return quads


def _raise_leaving() -> None:
    raise ValueError(
        "isosurface: the surface leaves the blocks that the shape's Lipschitz constant "
        "allows or its bounding box, need true bounds. Check `lipschitz` and "
        "`bounding_box` of the shapes you wrote."
    )


def _split(vertices, quads, points, normals) -> np.ndarray:
    """Quadrilaterals cut along the diagonal that lies nearer to the surface, (2, n, 3)."""
    ends = vertices[quads]
    height = np.einsum("nkj,nj->nk", ends - points[:, None], normals)

    def cost(i, j):
        along = ends[:, i] - ends[:, j]
        length = np.sqrt(np.einsum("nj,nj->n", along, along))
        return np.abs(height[:, i] + height[:, j]) / 2 + 1e-3 * length

    first = (cost(0, 2) <= cost(1, 3))[:, None]
    return np.stack(
        [
            np.where(first, quads[:, [0, 1, 2]], quads[:, [0, 1, 3]]),
            np.where(first, quads[:, [0, 2, 3]], quads[:, [1, 2, 3]]),
        ]
    )
