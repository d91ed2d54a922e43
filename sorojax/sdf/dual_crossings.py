"""Cells that hold surface and where it meets grid edges, group by group of blocks.

A cell is named by 512 times its block's row plus its place in the block; a grid edge by the
cell at whose first corner it begins, and its axis. Corner i + 2j + 4k of a cell.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.blocks import LEAF, Grid
from sorojax.sdf.dual_forced import Forced, ends_at, forced_crossings
from sorojax.sdf.sample import value_and_gradient

_WIDE = LEAF + 1
_CELLS = LEAF**3
_PLACES = np.array(list(np.ndindex(LEAF, LEAF, LEAF)), np.int32)
_NODES = _PLACES @ np.array([_WIDE * _WIDE, _WIDE, 1])
_CHUNK = 1 << 13
_BITS = np.array([1, 2, 4], np.int32)
# By bits of the axes to go back along: bits of the block walls passed, place arrived at.
_BACK = [_PLACES - (bits & _BITS > 0) for bits in range(8)]
_PASSED = np.stack([(back < 0) @ _BITS for back in _BACK])
_ARRIVED = np.stack(
    [back % LEAF @ np.array([LEAF * LEAF, LEAF, 1], np.int32) for back in _BACK]
)


class Crossings(NamedTuple):
    """What a group of blocks contributes.

    Attributes:
        cells: (n,) names of the cells that hold both signs, ascending.
        code: (n,) bits of their inside corners.
        edges: By axis, (m,) rows of `cells` where crossed grid edges begin.
        offset: (all m, 3) the crossings seen from there [cells].
        normal: (all m, 3) outward unit normals at them.
    """

    cells: np.ndarray
    code: np.ndarray
    edges: list[np.ndarray]
    offset: np.ndarray
    normal: np.ndarray


def corner(blocks: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """First nodes (n, 3) of cells."""
    # `take` gathers rows several times faster than an index does.
    return blocks.take(cells >> 9, axis=0) + _PLACES.take(cells & (_CELLS - 1), axis=0)


def blocks_before(grid: Grid, blocks: np.ndarray) -> np.ndarray:
    """Rows (n, 8) of the blocks one back along the axes in the bits of the column; or -1."""
    numbers = grid.number(blocks)
    found = np.empty((len(blocks), 8), np.int32)
    for bits in range(8):
        wanted = grid.number(blocks - LEAF * (bits & _BITS > 0))
        row = np.minimum(np.searchsorted(numbers, wanted), len(numbers) - 1)
        found[:, bits] = np.where(numbers[row] == wanted, row, -1)
    return found


def cells_before(before: np.ndarray, cells: np.ndarray, bits: int) -> np.ndarray:
    """Cells one back along the axes of `bits`; below zero where no block holds them."""
    place = cells & (_CELLS - 1)
    row = before.take((cells >> 9) * 8 + _PASSED[bits].take(place))
    return _CELLS * row + _ARRIVED[bits].take(place)


def crossings(
    shape: AbstractSdf,
    grid: Grid,
    group: np.ndarray,
    field: np.ndarray,
    first: int,
    forced: Forced,
) -> Crossings:
    """Crossings of `group`, whose first block is number `first`, by `field` (n, 9, 9, 9)."""
    codes = _codes(field).ravel()
    at = np.flatnonzero(codes - np.uint8(1) < 254)
    code = codes[at]
    edges = [np.flatnonzero((code ^ code >> np.uint8(1 << a)) & 1) for a in range(3)]
    start = at[np.concatenate(edges)]
    axis = np.repeat(np.arange(3), [len(e) for e in edges])
    node = (start >> 9) * _WIDE**3 + _NODES[start & (_CELLS - 1)]
    flat = field.ravel()
    a, b = flat[node], flat[node + np.array([_WIDE * _WIDE, _WIDE, 1])[axis]]
    nodes = corner(group.astype(np.int32), start)
    offset, normal = _hermite(shape, grid, nodes, axis.astype(np.int8), a, b)
    if len(forced.number):
        rows = np.flatnonzero(ends_at(grid, forced, nodes, axis))
        found = forced_crossings(shape, grid, nodes[rows], axis[rows], a[rows] < 0)
        offset[rows], normal[rows] = found
    return Crossings((at + _CELLS * first).astype(np.int32), code, edges, offset, normal)


def _codes(field: np.ndarray) -> np.ndarray:
    """Bits of the inside corners of every cell (n, 8, 8, 8)."""
    code = (field < 0).view(np.uint8)
    code = code[:, :-1] | code[:, 1:] << np.uint8(1)
    code = code[:, :, :-1] | code[:, :, 1:] << np.uint8(2)
    return code[..., :-1] | code[..., 1:] << np.uint8(4)


def _hermite(shape, grid, nodes, axis, a, b) -> tuple[np.ndarray, np.ndarray]:
    """Crossings seen from `nodes` [cells], and the normals there."""
    offset, normal = (np.empty((len(nodes), 3), np.float32) for _ in range(2))
    dtype = jnp.result_type(float)
    lower, size = jnp.asarray(grid.lower, dtype=dtype), jnp.asarray(grid.size, dtype=dtype)
    for start in range(0, len(nodes), _CHUNK):
        piece = slice(start, start + _CHUNK)
        rows = nodes[piece], axis[piece], a[piece], b[piece]
        pad = _CHUNK - len(rows[0])
        if pad:
            rows = tuple(np.concatenate([r, np.repeat(r[-1:], pad, axis=0)]) for r in rows)
        found = _cross(shape, lower, size, *rows)
        offset[piece], normal[piece] = (np.asarray(f)[: _CHUNK - pad] for f in found)
    return offset, normal


@eqx.filter_jit
def _cross(shape, lower, size, nodes, axis, a, b):
    """As `_hermite`, of one chunk with field `a` at the nodes and `b` at the next ones."""
    start = lower[None] + size * nodes.astype(size.dtype)
    step = (axis[:, None] == jnp.arange(3, dtype=axis.dtype)[None]).astype(size.dtype)
    a, b = a.astype(size.dtype), b.astype(size.dtype)
    start_inside = a < 0

    def at(t):
        return start + (size * t)[:, None] * step

    def closer(_, state):  # regula falsi, Illinois variant
        t, low, high, a, b = state
        f = shape(at(t)) / size
        same = (f < 0) == start_inside
        low, high = jnp.where(same, t, low), jnp.where(same, high, t)
        a, b = jnp.where(same, f, a / 2), jnp.where(same, b / 2, f)
        share = low + (high - low) * a / jnp.where(a == b, 1.0, a - b)
        return jnp.clip(share, low, high), low, high, a, b

    state = (a / (a - b), jnp.zeros_like(a), jnp.ones_like(a), a, b)
    t = jax.lax.fori_loop(0, 3, closer, state)[0]
    f, slope = value_and_gradient(shape, at(t))
    length = jnp.maximum(jnp.sqrt((slope * slope).sum(axis=1)), 1e-12)
    normal = slope / length[:, None]
    # What regula falsi leaves, where the field has a kink on the edge, Newton takes away.
    move = jnp.clip(f / size / length, -0.5, 0.5)
    offset = t[:, None] * step - move[:, None] * normal
    return offset.astype(jnp.float32), normal.astype(jnp.float32)
