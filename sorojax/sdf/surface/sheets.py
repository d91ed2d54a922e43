"""Cells that hold surface, where it meets grid edges, and how many sheets of it pass through a
cell.

Around every face the crossings are joined in pairs; the loops that arise are the sheets.
On a face with four crossings the field in its middle decides whether the pairs separate the
inside corners or the outside ones. Where the two cells on both sides would each join the pairs
to one sheet, the face would make an edge of four triangles, so there the other pairs are
taken: that splits the sheet of either cell, and hence terminates.

Corner i + 2j + 4k of a cell; edge 4a + d + 2e runs along axis a at offsets d and e along
the axes a + 1 and a + 2; face 2f + s lies across axis f on side s. A cell is named by 512
times its block's row plus its place in the block; a grid edge by the cell at whose first
corner it begins, and its axis.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import in_pieces, value_and_gradient
from sorojax.sdf.surface.blocks import LEAF, Grid
from sorojax.sdf.surface.walls import Forced, ends_at, forced_crossings


class Sheets(NamedTuple):
    """Sheets of cells.

    Attributes:
        kind: (n,) rows of the tables.
        edges: (kinds, 12) sheet of every cell edge, -1 where it is not cut.
        number: (kinds,) sheets.
    """

    kind: np.ndarray
    edges: np.ndarray
    number: np.ndarray


class Faces(NamedTuple):
    """Faces with four crossings.

    Attributes:
        first: (n,) rows of the cells before them.
        second: (n,) rows of the cells after them.
        axis: (n,) axis they lie across.
    """

    first: np.ndarray
    second: np.ndarray
    axis: np.ndarray


def _corner(axis: int, along: int, d: int, e: int) -> int:
    """Number of the corner with given offsets along `axis` and the two axes after it."""
    return (along << axis) + (d << (axis + 1) % 3) + (e << (axis + 2) % 3)


def _face_corners(face: int) -> list[tuple[int, tuple[int, int]]]:
    """Corners of a face, each with the two edges of the face that end there."""
    f, side = divmod(face, 2)
    u, w = (f + 1) % 3, (f + 2) % 3
    return [
        (_corner(f, side, d, e), (4 * u + e + 2 * side, 4 * w + side + 2 * d))
        for d in (0, 1)
        for e in (0, 1)
    ]


@functools.cache
def sheets(code: int, flipped: int = 0) -> tuple[tuple[int, ...], int]:
    """Sheet of each of the 12 edges (-1: not cut) and the faces joined on one sheet.

    Args:
        code: Bit c is set where corner c lies inside.
        flipped: Bit f is set where face f parts the outside corners.
    """
    inside = [bool(code >> c & 1) for c in range(8)]
    cut = [
        inside[_corner(a, 0, d, e)] != inside[_corner(a, 1, d, e)]
        for a in range(3)
        for e in (0, 1)
        for d in (0, 1)
    ]
    label = list(range(12))
    crossings = []
    for face in range(6):
        corners = _face_corners(face)
        edges = sorted({e for _, pair in corners for e in pair if cut[e]})
        crossings.append(edges)
        if len(edges) == 4:
            parted = not flipped >> face & 1
            pairs = [pair for corner, pair in corners if inside[corner] == parted]
        else:
            pairs = [tuple(edges)] if edges else []
        for a, b in pairs:
            label = [label[a] if value == label[b] else value for value in label]
    found = sorted({label[e] for e in range(12) if cut[e]})
    number = tuple(found.index(label[e]) if cut[e] else -1 for e in range(12))
    joined = sum(
        1 << face
        for face, edges in enumerate(crossings)
        if len(edges) == 4 and len({label[e] for e in edges}) == 1
    )
    return number, joined


@functools.cache
def _table() -> np.ndarray:
    return np.array([sheets(code)[0] for code in range(256)], dtype=np.int8)


@functools.cache
def _doubtful() -> np.ndarray:
    """Bits of the first faces along the axes that have four crossings, by code."""
    codes = np.arange(256)
    bits = np.zeros(256, np.uint8)
    for f in range(3):
        a, b, c, d = (
            codes >> _corner(f, 0, *at) & 1 for at in ((0, 0), (0, 1), (1, 1), (1, 0))
        )
        bits |= ((a == c) & (b == d) & (a != b)).astype(np.uint8) << np.uint8(f)
    return bits


def doubtful_faces(code: np.ndarray) -> list[np.ndarray]:
    """By axis, the rows of cells whose first face along it has four crossings."""
    bits = _doubtful()[code]
    return [np.flatnonzero(bits >> np.uint8(f) & 1) for f in range(3)]


def cell_sheets(code: np.ndarray, faces: Faces, inside: np.ndarray) -> Sheets:
    """Sheets of cells with given bits of the inside corners.

    Args:
        code: (n,) bits of the inside corners.
        faces: All faces with four crossings.
        inside: Whether the middle of each face lies inside.
    """
    flipped: dict[int, int] = {}
    rows = [
        (a, b, 1 << 2 * f)
        for a, b, f in zip(*(column.tolist() for column in faces), strict=True)
    ]

    def turn(a, b, low):
        flipped[a] = flipped.get(a, 0) ^ low << 1
        flipped[b] = flipped.get(b, 0) ^ low

    for row, inner in zip(rows, inside.tolist(), strict=True):
        if inner:
            turn(*row)
    own = {row: int(code[row]) for a, b, _ in rows for row in (a, b)}
    changed = True
    while changed:
        changed = False
        for a, b, low in rows:
            one = sheets(own[a], flipped.get(a, 0))[1] & low << 1
            if one and sheets(own[b], flipped.get(b, 0))[1] & low:
                turn(a, b, low)
                changed = True
    return _tabulated(code, flipped)


def _tabulated(code: np.ndarray, flipped: dict[int, int]) -> Sheets:
    kind = code.astype(np.uint16)
    special: dict[tuple[int, int], int] = {}
    for cell, faces in flipped.items():
        if faces:
            kind[cell] = special.setdefault((int(code[cell]), faces), 256 + len(special))
    more = np.array([sheets(*key)[0] for key in special], np.int8).reshape(-1, 12)
    edges = np.concatenate([_table(), more])
    return Sheets(kind, edges, edges.max(axis=1) + np.int8(1))


# Cells that hold surface and where it meets grid edges, group by group of blocks


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
    """The contribution of a group of blocks.

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
    if not len(nodes):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    dtype = jnp.result_type(float)
    lower, size = jnp.asarray(grid.lower, dtype=dtype), jnp.asarray(grid.size, dtype=dtype)
    cross = functools.partial(_cross, shape, lower, size)
    offset, normal = in_pieces(cross, _CHUNK, nodes, axis, a, b)
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
    # Where the field has a kink on the edge, Newton removes the error of regula falsi.
    move = jnp.clip(f / size / length, -0.5, 0.5)
    offset = t[:, None] * step - move[:, None] * normal
    return offset.astype(jnp.float32), normal.astype(jnp.float32)
