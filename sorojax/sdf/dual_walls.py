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
from sorojax.sdf.blocks import LEAF, Grid
from sorojax.sdf.sample import values, values_and_gradients

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
    slopes = []
    for share in (deepest - reach, deepest + reach):
        at = start + share[:, None] * UNITS[axis]
        slope = values_and_gradients(shape, grid.points(at))[1]
        length = np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)
        slopes.append(slope / length)
    return (slopes[0] * slopes[1]).sum(axis=1) < _OPPOSED


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


def joined(parts: list[Lost]) -> Lost:
    """All of them."""
    return Lost(*(np.concatenate(column) for column in zip(*parts, strict=True)))
