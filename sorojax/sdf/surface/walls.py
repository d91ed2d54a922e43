"""Walls and gaps that pass between the nodes of a grid, and the nodes that keep them whole.

A grid edge that goes through a wall while both its ends lie outside would leave a hole. One
of its ends then counts as inside: the wall stays whole and grows by half a cell at most, its
planes are still the true ones. Gaps between two nodes inside are kept open in the same way.
So the thin rims stay whole at which sheets run out; walls of even thickness are refused.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import connected, normals, unit, values, values_and_gradients
from sorojax.sdf.surface.blocks import LEAF, Grid

_BATCH = 64
_WIDE = LEAF + 1
_NODES = _WIDE**3
_PLACES = np.array(list(np.ndindex(_WIDE, _WIDE, _WIDE)))
_STRIDES = np.array([_WIDE * _WIDE, _WIDE, 1])
_FEW = np.array([0.25, 0.5, 0.75])
ALONG = np.arange(1, 16) / 16
_ENDS = np.arange(17) / 16
_CLOSER = np.linspace(-1, 1, 9) / 16
_SHALLOW = 0.02  # cells: what is less deep is lost
_FLAT = 0.005  # cells: what rises less along an edge runs along the surface
_BENT = 0.03  # cells: by what the field turns at least between three nodes
_OPPOSED = -0.7  # cosine between the faces of a wall: wider wedges end within two cells
_ROUND = [(s * d, s * e) for s in (0.5, 1.0) for d in (-1, 0, 1) for e in (-1, 0, 1) if d or e]
UNITS = np.eye(3, dtype=int)


class Lost(NamedTuple):
    """Grid edges through a wall or a gap.

    Attributes:
        start: (n, 3) nodes at which they begin.
        axis: (n,) axes they run along.
        inside: (n,) whether their ends lie inside, so that they go through a gap.
        depth: (n,) how deep they go [cells].
    """

    start: np.ndarray
    axis: np.ndarray
    inside: np.ndarray
    depth: np.ndarray


NO_EDGES = Lost(np.zeros((0, 3), int), np.zeros(0, int), np.zeros(0, bool), np.zeros(0))


def lost_edges(shape: AbstractSdf, grid: Grid, group: np.ndarray, field: np.ndarray) -> Lost:
    """Edges of blocks with `field` (n, 9, 9, 9) that go through walls or gaps."""
    reach = jnp.asarray(float(shape.lipschitz), jnp.float32)
    spare = np.full((-len(field) % _BATCH + 1) * _NODES, np.float32(1e9))
    flat = np.concatenate([spare[: _STRIDES[0]], field.ravel(), spare])
    count, ways = _BATCH * _NODES, []
    for begin in range(0, field.size, count):
        piece = flat[begin : begin + count + 3 * _STRIDES[0]]
        ways.append(np.asarray(_valleys(piece, reach)))
    found = np.concatenate(ways)
    at = np.flatnonzero(found != 0)
    each = [at[found[at] >> np.uint8(a) & 1 > 0] for a in range(3)]
    node, axis = np.concatenate(each), np.repeat(np.arange(3), [len(e) for e in each])
    block, place = np.divmod(node, _NODES)
    start, first = group[block] + _PLACES[place], _STRIDES[0] + node
    ends = np.stack([flat[first], flat[first + _STRIDES[axis]]], axis=1).astype(float)
    rows = _turning(shape, grid, start, axis, _PLACES[place, axis], ends)
    return _through(shape, grid, start[rows], axis[rows], ends[rows])


@jax.jit
def _valleys(field, reach):
    """Bits of the axes along which the field may change sign twice on the way from a node.

    Blocks lie in line, with spare nodes at both ends; `_turning` looks beyond their walls.
    """
    count, spare = _BATCH * _NODES, int(_STRIDES[0])
    places = [jnp.tile(p, _BATCH) for p in _PLACES.T.astype(np.int8)]
    # Edges on the far walls of a block are those of the next one.
    own = (places[0] < LEAF) & (places[1] < LEAF) & (places[2] < LEAF)
    bits = jnp.zeros(count, jnp.uint8)
    for axis, (p, step) in enumerate(zip(places, _STRIDES.tolist(), strict=True)):
        before, low, high, after = (
            field[spare + k * step : spare + k * step + count] for k in (-1, 0, 1, 2)
        )
        near = (jnp.abs(low) + jnp.abs(high) < reach) & ((low < 0) == (high < 0)) & own
        found = near & (_turns(before, low, high) | (p == 0))
        found &= _turns(after, high, low) | (p == LEAF - 1)
        bits |= found.astype(jnp.uint8) << jnp.uint8(axis)
    return bits


def _turns(beyond, end, other):
    """Whether the field may go through zero twice between `end` and `other`, by what it is
    beyond `end`: on the other side, or rising as steeply as it fell from there to the wall."""
    level = abs(end)
    rise, across = abs(beyond) - level, (beyond < 0) != (end < 0)
    steep = (rise > _FLAT) & (level < 1.5 * rise + 0.02)
    return across | (steep & (rise + abs(other) - level > _BENT))


def _turning(shape, grid, start, axis, place, ends) -> np.ndarray:
    """Rows of edges that `_turns` lets pass at the walls of blocks as well."""
    wall = np.flatnonzero((place == 0) | (place == LEAF - 1))
    first = place[wall] == 0
    beyond = start[wall] + np.where(first, -1, 2)[:, None] * UNITS[axis[wall]]
    f = values(shape, grid.points(beyond)) / grid.size
    low, high = ends[wall].T
    kept = np.ones(len(axis), bool)
    kept[wall] = _turns(f, np.where(first, low, high), np.where(first, high, low))
    return np.flatnonzero(kept)


def along_edges(shape, grid, start, axis, along) -> np.ndarray:
    """Field [cells] at shares `along` of edges, (shares,) or (n, shares): (n, shares)."""
    points = start[:, None] + along[..., None] * UNITS[axis][:, None]
    f = values(shape, grid.points(points.reshape(-1, 3))).reshape(points.shape[:2])
    return f / grid.size


def _through(shape, grid, start, axis, ends) -> Lost:
    inside = ends[:, 0] < 0
    side = np.where(inside, -1.0, 1.0)[:, None]
    few = (along_edges(shape, grid, start, axis, _FEW) * side).min(axis=1, initial=np.inf)
    rows = np.flatnonzero(few < (ends * side).min(axis=1, initial=np.inf))
    f = along_edges(shape, grid, start[rows], axis[rows], ALONG) * side[rows]
    near = ALONG[f.argmin(axis=1)][:, None] + _CLOSER
    f = along_edges(shape, grid, start[rows], axis[rows], near) * side[rows]
    deepest, depth = near[np.arange(len(near)), f.argmin(axis=1)], -f.min(axis=1)
    kept = np.flatnonzero(depth > _SHALLOW)
    rows, deepest, depth = rows[kept], deepest[kept], depth[kept]
    kept = _opposed(shape, grid, start[rows], axis[rows], deepest, depth)
    bent = np.flatnonzero(~kept)
    kept[bent] = ~_way_round(shape, grid, start[rows[bent]], axis[rows[bent]], side[rows[bent]])
    rows, depth = rows[kept], depth[kept]
    return Lost(start[rows], axis[rows], inside[rows], depth)


def _opposed(shape, grid, start, axis, deepest, depth) -> np.ndarray:
    """Whether the faces that edges enter and leave by face away from each other."""
    reach = 0.75 * depth / float(shape.lipschitz)
    shares = (deepest - reach)[:, None], (deepest + reach)[:, None]
    faces = [normals(shape, grid.points(start + share * UNITS[axis])) for share in shares]
    return (faces[0] * faces[1]).sum(axis=1) < _OPPOSED


def _way_round(shape, grid, start, axis, side) -> np.ndarray:
    """Whether a way round within a cell joins the ends of edges, which then only cut a tip."""
    found = np.zeros(len(start), bool)
    for first, second in _ROUND:
        rows = np.flatnonzero(~found)
        one, shift = UNITS[axis[rows]][:, None], first * UNITS[(axis[rows] + 1) % 3]
        shift = (shift + second * UNITS[(axis[rows] + 2) % 3])[:, None]
        out, along = shift * ALONG[:, None], shift + one * _ENDS[:, None]
        points = start[rows][:, None] + np.concatenate([out, along, out + one], axis=1)
        f = values(shape, grid.points(points.reshape(-1, 3))).reshape(points.shape[:2])
        found[rows] = (f * side[rows] > 0).all(axis=1)
    return found


# Nodes that count to the side of a wall or a gap, so that it stays whole


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
    slope = unit(slope)
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
    if not len(forced.number):
        return vertices, triangles
    first, second = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    shell = connected(len(vertices), first, second)
    count = np.bincount(shell)
    middle = [np.bincount(shell, axis) / count for axis in vertices.T]
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
