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
from sorojax.sdf.dual_forced import (
    NONE,
    Forced,
    apply_forced,
    forced_nodes,
    keep_joined,
    with_blocks_around,
    without_specks,
)
from sorojax.sdf.dual_quads import Quads, split
from sorojax.sdf.dual_sheets import Faces, cell_sheets, doubtful_faces
from sorojax.sdf.dual_vertices import SHIFTS, SUMS, gathered, place
from sorojax.sdf.dual_walls import NO_EDGES, Lost, joined, lost_edges
from sorojax.sdf.sample import values

# By axis of a grid edge: the axes, as bits, to go back along to the four cells around it.
_AROUND = (SHIFTS @ np.array([1, 2, 4])).astype(int)
_NONE = Crossings(*np.zeros((2, 0)), [], *np.zeros((2, 0, 3)))
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
    groups, lost = _crossed(shape, grid, blocks, NONE)
    forced = NONE
    if len(lost.axis):
        forced = forced_nodes(shape, grid, lost, sum(len(group.offset) for group in groups))
        blocks = with_blocks_around(grid, blocks, forced)
        groups = _crossed(shape, grid, blocks, forced)[0]
    before = blocks_before(grid, blocks)
    cells = _numbered(shape, grid, blocks, before, groups, forced)
    vertices = np.empty((int(cells.first[-1]), 3))
    count = sum(len(group.offset) for group in groups)
    triangles, row = np.empty((2, count, 3), np.int32), 0
    more, added, total = [triangles[0, :0]], [vertices], len(vertices)
    for quads in _placed(blocks, before, groups, cells, vertices):
        pairs, rest, points = split(vertices, quads, total)
        triangles[:, row : row + pairs.shape[1]] = pairs
        row, total = row + pairs.shape[1], total + len(points)
        more.append(rest)
        added.append(points)
    if total > len(vertices):
        vertices = np.concatenate(added)
        triangles = np.concatenate([triangles.reshape(-1, 3), *more])
    vertices, triangles = without_specks(grid, forced, vertices, triangles.reshape(-1, 3))
    vertices *= grid.size
    vertices += grid.lower
    return vertices, triangles


def _crossed(shape, grid, blocks, forced: Forced) -> tuple[list[Crossings], Lost]:
    """Crossings of all groups, and the edges that lose a wall if no node is chosen yet."""
    groups, lost, done = [], [], 0
    for group, field in leaf_fields(shape, grid, blocks, _GROUP):
        if not len(forced.number):
            lost.append(lost_edges(shape, grid, group, field))
        apply_forced(grid, forced, group, field)
        groups.append(crossings(shape, grid, group, field, done, forced))
        done += len(group)
        del field
    return groups, joined(lost) if lost else NO_EDGES


def _numbered(shape, grid, blocks, before, groups: list[Crossings], forced: Forced) -> Cells:
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
    node = corner(blocks, name[faces.second])
    inner = values(shape, grid.points(node + (1 - np.eye(3)[axis]) / 2)) < 0
    sheets = cell_sheets(code, faces, keep_joined(grid, forced, node, axis, inner))
    ends = np.zeros(len(name) + 1, np.int32)
    np.cumsum(sheets.number[sheets.kind], out=ends[1:])
    return Cells(name, code, sheets.kind, sheets.edges, ends)


def _placed(
    blocks, before, groups: list[Crossings], cells: Cells, vertices: np.ndarray
) -> Iterator[Quads]:
    """Quadrilaterals of each group, once their vertices are placed.

    A group's vertices are placed when the next group, which shares cell walls with its last
    layer, has added its planes.
    """
    ends = np.concatenate([[0], np.cumsum([len(group.cells) for group in groups])])
    total, held = np.zeros((0, SUMS), np.float32), None
    for g in range(len(groups)):
        low, now, high = ends[max(g - 1, 0)], ends[g], ends[g + 1]
        # Taken off the list, so that memory falls as the result grows.
        group, groups[g] = groups[g], _NONE
        total = np.concatenate(
            [total, np.zeros((cells.first[high] - cells.first[now], SUMS), np.float32)]
        )
        rows = now + np.concatenate(group.edges)
        quads = quads_around(before, group.edges, cells, slice(low, high), now)
        axis = np.repeat(np.arange(3), [len(e) for e in group.edges])
        gathered(group.offset, group.normal, axis, quads - cells.first[low], total)
        if held is not None:
            _place(blocks, cells, slice(low, now), total, vertices)
            yield held
            total = total[cells.first[now] - cells.first[low] :].copy()
        start = corner(blocks, cells.name[rows])
        facing = outward(quads, cells.code[rows])
        held = Quads(facing, start, axis, group.offset, group.normal)
    if held is not None:
        _place(blocks, cells, slice(ends[-2], ends[-1]), total, vertices)
        yield held


def _place(blocks, cells: Cells, rows: slice, total, vertices) -> None:
    """Put the vertices of the cells `rows`, whose sums come first in `total`."""
    ends = cells.first[rows.start : rows.stop + 1]
    number = np.diff(ends)
    owner = np.repeat(np.arange(rows.start, rows.stop), number)
    first = corner(blocks, cells.name[owner])
    alone = np.repeat(number == 1, number)
    vertices[ends[0] : ends[-1]] = first + place(total[: len(owner)], alone)


def quads_around(
    before: np.ndarray, edges: list[np.ndarray], cells: Cells, window: slice, now: int
) -> np.ndarray:
    """Vertices (n, 4) around crossed grid edges, counter-clockwise about their axis.

    Args:
        before: Of `blocks_before`.
        edges: By axis, the cells at which they begin, counted from row `now`.
        cells: All cells.
        window: Rows of the cells that may touch the edges.
        now: See above.
    """
    name = cells.name[window]
    if not len(name):
        return np.zeros((0, 4), np.int32)
    base = int(name[0])
    index = np.full(int(name[-1]) - base + 1, -1, np.int32)
    index[name - base] = np.arange(window.start, window.stop)
    quads, done = np.empty((sum(map(len, edges)), 4), np.int32), 0
    for axis, rows in enumerate(edges):
        part = quads[done : done + len(rows)]
        done += len(rows)
        start = cells.name[now + rows]
        for k, bits in enumerate(_AROUND[axis].tolist()):
            d, e = bits >> (axis + 1) % 3 & 1, bits >> (axis + 2) % 3 & 1
            at = cells_before(before, start, bits) - base
            cell = index.take(np.maximum(at, 0))
            if (at < 0).any() or (cell < 0).any():
                _raise_leaving()
            sheet = cells.edges[:, 4 * axis + d + 2 * e].take(cells.kind.take(cell))
            part[:, k] = cells.first.take(cell) + sheet
    return quads


def outward(quads: np.ndarray, code: np.ndarray) -> np.ndarray:
    """`quads` turned to be seen from outside, by the bits of the cells their edges begin at."""
    return np.where((code & 1 > 0)[:, None], quads, quads[:, ::-1])


def _raise_leaving() -> None:
    raise ValueError(
        "isosurface: the surface leaves the blocks that the shape's Lipschitz constant "
        "allows or its bounding box, need true bounds. Check `lipschitz` and "
        "`bounding_box` of the shapes you wrote."
    )
