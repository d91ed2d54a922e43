"""Nodes that count to the side of a wall or a gap, so that it stays whole."""

from typing import NamedTuple

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.blocks import LEAF, Grid
from sorojax.sdf.dual_walls import ALONG, UNITS, Lost, along_edges
from sorojax.sdf.sample import values, values_and_gradients

_MOST = 0.2  # lost edges for each crossed one that are no rim but a wall
_EVEN = 0.7  # of the greatest depth: edges as deep in the middle go through a wall, not a rim
_THIN = 0.1  # cells: walls less deep are kept whole
_PATCH = 10  # edges through a wall that are refused
_BEYOND = 0.3  # cosine between the slope at a node and the way to what it would grow onto
_SPECK = 14  # vertices of a shell around one node: of its 8 cells and its 6 edges
_BITS = np.array(list(np.ndindex(2, 2, 2)))


class Forced(NamedTuple):
    """Nodes whose side is chosen.

    Attributes:
        number: (n,) of `Grid.number`, ascending.
        inside: (n,) the side they count to.
    """

    number: np.ndarray
    inside: np.ndarray


NONE = Forced(np.zeros(0, np.int64), np.zeros(0, bool))


def forced_nodes(shape: AbstractSdf, grid: Grid, lost: Lost, crossed: int) -> Forced:
    """Nodes that count to the other side, so that no edge is lost.

    Args:
        shape: Solid.
        grid: Cells.
        lost: Edges.
        crossed: How many others meet the surface.

    Raises:
        ValueError: If they go through a wall of even thickness, or a wall is so near to the
            next one that it could only grow onto it.
    """
    evenly = np.median(lost.depth) > max(_EVEN * lost.depth.max(), _THIN)
    if len(lost.axis) > _MOST * crossed or (evenly and len(lost.axis) >= _PATCH):
        _refuse(grid, lost, np.ones(len(lost.axis), bool))
    ends = np.stack([lost.start, lost.start + UNITS[lost.axis]], axis=1)
    f, slope = values_and_gradients(shape, grid.points(ends.reshape(-1, 3)))
    slope = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)
    side = np.repeat(np.where(lost.inside, -1.0, 1.0), 2)
    touching = _grows_onto(shape, grid, ends.reshape(-1, 3), slope, side).reshape(-1, 2)
    cost = np.abs(f.reshape(-1, 2)) / grid.size + 10.0 * touching
    best = cost.argmin(axis=1)
    rows = np.arange(len(best))
    if touching[rows, best].any():
        _refuse(grid, lost, touching[rows, best])
    number = grid.number(ends[rows, best])
    first = np.unique(number, return_index=True)[1]
    slope = (slope * side[:, None]).reshape(-1, 2, 3)[rows, best]
    _check_apart(grid, lost, ends[rows, best][first], slope[first], first)
    return Forced(number[first], ~lost.inside[first])


def without_specks(
    grid: Grid, forced: Forced, vertices: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [cells] and triangles without the shells around single chosen nodes.

    A node that was chosen for a wall thinner than its neighbours see stays alone where the
    wall ends: a speck or a bubble smaller than a cell, that the shape does not have.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(forced.number):
        return vertices, triangles
    first, second = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    pairs = (np.ones(len(first), bool), (first, second))
    shape = (len(vertices), len(vertices))
    shells, shell = connected_components(coo_matrix(pairs, shape), directed=False)
    count = np.bincount(shell, minlength=shells)
    middle = [np.bincount(shell, axis, shells) / count for axis in vertices.T]
    node = np.rint(np.stack(middle, axis=1)).astype(int)
    speck = (count <= _SPECK) & (_chosen(grid, forced, node) >= 0)
    if not speck.any():
        return vertices, triangles
    kept = ~speck[shell]
    number = np.cumsum(kept) - 1
    return vertices[kept], number[triangles[kept[triangles[:, 0]]]].astype(triangles.dtype)


def _grows_onto(shape, grid, nodes, slope, side) -> np.ndarray:
    """Whether nodes have a neighbour of the other side beyond them."""
    found = np.zeros(len(nodes), bool)
    for way in np.concatenate([UNITS, -UNITS]):
        beyond = (slope * way).sum(axis=1) * side > _BEYOND
        rows = np.flatnonzero(beyond)
        f = values(shape, grid.points(nodes[rows] + way))
        found[rows] |= f * side[rows] < 0
    return found


def _check_apart(grid, lost, nodes, slope, first) -> None:
    """Raise if two chosen neighbours belong to walls that face each other."""
    number = grid.number(nodes)
    for way in UNITS:
        after = grid.number(nodes + way)
        row = np.minimum(np.searchsorted(number, after), len(number) - 1)
        facing = (slope @ way > _BEYOND) & (slope[row] @ way < -_BEYOND)
        pair = (number[row] == after) & facing
        pair &= lost.inside[first] == lost.inside[first[row]]
        if pair.any():
            which = np.zeros(len(lost.axis), bool)
            which[first[pair]] = True
            _refuse(grid, lost, which)


def _refuse(grid: Grid, lost: Lost, rows: np.ndarray) -> None:
    at = np.flatnonzero(rows)
    thick = 2 * float(np.median(lost.depth[at])) * grid.size
    what = "gap" if lost.inside[at[0]] else "wall"
    where = grid.points(lost.start[at[0]] + UNITS[lost.axis[at[0]]] / 2)
    raise ValueError(
        f"isosurface: a {what} about {thick:.2g} m thick near {np.round(where, 6)} m falls "
        f"between nodes {grid.size:.3g} m apart and would leave holes, need nodes at most "
        f"{thick:.2g} m apart. Use `size` <= {0.9 * thick:.2g} m, or thicken the {what}."
    )


def with_blocks_around(grid: Grid, blocks: np.ndarray, forced: Forced) -> np.ndarray:
    """`blocks` and those that hold a chosen node, in order."""
    nodes = grid.node(forced.number)
    more = (nodes[:, None] - _BITS).reshape(-1, 3) // LEAF * LEAF
    every = np.unique(np.concatenate([grid.number(blocks), grid.number(more)]))
    return grid.node(every)


def apply_forced(grid: Grid, forced: Forced, group: np.ndarray, field: np.ndarray) -> None:
    """Give chosen nodes a value of their side in `field` (n, 9, 9, 9)."""
    if not len(forced.number):
        return
    numbers = grid.number(group)
    nodes = grid.node(forced.number)
    for back in _BITS:
        block = (nodes - back) // LEAF * LEAF
        place = nodes - block
        wanted = grid.number(block)
        row = np.minimum(np.searchsorted(numbers, wanted), len(numbers) - 1)
        hit = np.flatnonzero((numbers[row] == wanted) & (place <= LEAF).all(axis=1))
        i, j, k = place[hit].T
        field[row[hit], i, j, k] = np.where(forced.inside[hit], -1e-3, 1e-3)


def _chosen(grid: Grid, forced: Forced, nodes: np.ndarray) -> np.ndarray:
    """Rows of `forced` that nodes (.., 3) have, or -1."""
    number = grid.number(nodes)
    row = np.minimum(np.searchsorted(forced.number, number), len(forced.number) - 1)
    return np.where(forced.number[row] == number, row, -1)


def ends_at(grid: Grid, forced: Forced, nodes: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Whether edges end at chosen nodes."""
    after = _chosen(grid, forced, nodes + UNITS[axis])
    return (_chosen(grid, forced, nodes) >= 0) | (after >= 0)


def keep_joined(
    grid: Grid, forced: Forced, nodes: np.ndarray, axis: np.ndarray, inner: np.ndarray
) -> np.ndarray:
    """`inner`, whether middles of faces lie inside, but the side of a chosen corner.

    Args:
        grid: Cells.
        forced: Chosen nodes.
        nodes: (n, 3) first corners of the faces.
        axis: (n,) axes across them.
        inner: (n,) what the field says.
    """
    if not len(forced.number):
        return inner
    first, second = UNITS[(axis + 1) % 3], UNITS[(axis + 2) % 3]
    for corner in (nodes, nodes + first, nodes + second, nodes + first + second):
        row = _chosen(grid, forced, corner)
        inner = np.where(row >= 0, forced.inside[row], inner)
    return inner


def forced_crossings(
    shape: AbstractSdf, grid: Grid, nodes: np.ndarray, axis: np.ndarray, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Crossings (n, 3) [cells] and normals (n, 3) of edges that end at chosen nodes.

    Args:
        shape: Solid.
        grid: Cells.
        nodes: (n, 3) where the edges begin.
        axis: (n,) axes they run along.
        inside: (n,) whether they count to begin inside.
    """
    along = np.concatenate([[0.0], ALONG, [1.0]])
    f = along_edges(shape, grid, nodes, axis, along)
    f = np.where(inside[:, None], f, f[:, ::-1])
    solid = f < 0
    chosen = ~solid[:, 0]
    solid[:, 0], solid[:, -1] = True, False
    leaves = solid[:, :-1] & ~solid[:, 1:]
    last = leaves.shape[1] - 1
    k = np.where(chosen, last - leaves[:, ::-1].argmax(axis=1), leaves.argmax(axis=1))
    rows = np.arange(len(f))
    a, b = f[rows, k], f[rows, k + 1]
    true = (a < 0) & (b >= 0)
    step = np.where(true, a / np.where(true, a - b, 1.0), np.where(b < 0, 1.0, 0.0))
    share = (k + step) / (len(along) - 1)
    share = np.where(inside, share, 1 - share)
    at = share[:, None] * UNITS[axis]
    f, slope = values_and_gradients(shape, grid.points(nodes + at))
    length = np.maximum(np.linalg.norm(slope, axis=1), 1e-12)
    normal = slope / length[:, None]
    move = np.clip(f / grid.size / length, -1.0, 1.0)
    return (at - move[:, None] * normal).astype(np.float32), normal.astype(np.float32)
