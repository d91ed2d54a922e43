"""Dual contouring: one vertex per sheet and cell, placed by the planes of its crossings.

Ju et al. 2002 for the vertices; the sheets make the surface manifold (Schaefer et al. 2007).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.blocks import LEAF, Grid, leaf_fields
from sorojax.sdf.dual_sheets import cell_sheets
from sorojax.sdf.dual_vertices import place
from sorojax.sdf.query import value_and_gradient
from sorojax.sdf.sample import CHUNK

MARGIN = 0.02  # cells: vertices stay off cell walls, so that none coincide in float32
# Cells around a grid edge, counter-clockwise: offsets of the edge within them.
_AROUND = ((1, 1), (0, 1), (0, 0), (1, 0))
_PIECE = 1 << 16


class _Crossings(NamedTuple):
    """Cells that hold both signs, in order, and the grid edges that join both signs.

    `points` are in cells from the grid's corner; `start_inside` tells which end of the
    edge lies inside.
    """

    cell: np.ndarray
    code: np.ndarray
    start: np.ndarray
    axis: np.ndarray
    start_inside: np.ndarray
    points: np.ndarray
    normals: np.ndarray


def dual_contouring(
    shape: AbstractSdf, grid: Grid, blocks: np.ndarray, margin: float = MARGIN
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [m] at least `margin` cells inside their cells; outward triangles."""
    found = _crossings(shape, grid, blocks)
    quads, owner, alone = _quads(grid, found)
    vertices = place(found.points, found.normals, quads, alone)
    for start in range(0, len(owner), _PIECE):
        piece = slice(start, start + _PIECE)
        low = grid.node(owner[piece]) + margin
        vertices[piece] = np.clip(vertices[piece], low, low + (1 - 2 * margin))
    triangles = _triangles(vertices, quads, found)
    return grid.points(vertices), triangles


def _crossings(shape: AbstractSdf, grid: Grid, blocks: np.ndarray) -> _Crossings:
    cells, codes, edges = [], [], []
    for group, field in leaf_fields(shape, grid, blocks):
        sign = field < 0
        code = np.zeros((len(group), LEAF, LEAF, LEAF), np.uint8)
        for c in range(8):
            i, j, k = c & 1, c >> 1 & 1, c >> 2
            part = sign[:, i : i + LEAF, j : j + LEAF, k : k + LEAF]
            code |= part.astype(np.uint8) << np.uint8(c)
        block, *local = np.nonzero((code > 0) & (code < 255))
        cells.append(grid.number(group[block] + np.stack(local, axis=-1)))
        codes.append(code[(block, *local)])
        for axis in range(3):
            edges.append(_edges(shape, grid, group, field, sign, axis))
    cell, code = np.concatenate(cells), np.concatenate(codes)
    order = np.argsort(cell)
    return _Crossings(
        cell[order], code[order], *(np.concatenate(part) for part in zip(*edges, strict=True))
    )


def _edges(shape, grid, group, field, sign, axis):
    """The crossed grid edges along `axis` that begin in `group`, with planes there."""
    step = np.eye(3, dtype=int)[axis]
    ahead = tuple(slice(s, s + LEAF) for s in step)
    block, *local = np.nonzero(sign[:, :LEAF, :LEAF, :LEAF] != sign[(slice(None), *ahead)])
    beyond = tuple(at + s for at, s in zip(local, step, strict=True))
    a, b = field[(block, *local)].astype(float), field[(block, *beyond)].astype(float)
    nodes = group[block] + np.stack(local, axis=-1)
    points, normals = _hermite(shape, grid, nodes, step, a, b)
    number = grid.number(nodes)
    return number, np.full(len(number), axis, np.int8), a < 0, points, normals


def _hermite(shape, grid, nodes, step, a, b) -> tuple[np.ndarray, np.ndarray]:
    """Where grid edges meet the surface [cells], and the normals there."""
    points, normals = np.empty((len(nodes), 3)), np.empty((len(nodes), 3), np.float32)
    dtype = jnp.result_type(float)
    ahead, size = jnp.asarray(step, dtype=dtype), jnp.asarray(grid.size, dtype=dtype)
    for start in range(0, len(nodes), CHUNK):
        piece = slice(start, start + CHUNK)
        rows = grid.points(nodes[piece]), a[piece], b[piece]
        pad = CHUNK - len(rows[0])
        if pad:
            rows = (np.concatenate([r, np.repeat(r[-1:], pad, axis=0)]) for r in rows)
        found = _cross(shape, *(jnp.asarray(r, dtype=dtype) for r in rows), ahead, size)
        t, f, slope = (np.asarray(part)[: CHUNK - pad] for part in found)
        length = np.maximum(np.sqrt((slope * slope).sum(axis=1, keepdims=True)), 1e-12)
        normal = slope / length
        # What regula falsi leaves, where the field has a kink on the edge, Newton takes away.
        move = np.minimum(np.abs(f[:, None]) / length, 0.5)
        points[piece] = (
            nodes[piece] + t[:, None] * step - np.copysign(move, f[:, None]) * normal
        )
        normals[piece] = normal
    return points, normals


@eqx.filter_jit
def _cross(shape, start, a, b, step, size):
    """Share of the way from `start` along grid edges to the zero, field [cells], slope."""
    start_inside = a < 0

    def at(t):
        return start + (size * t)[:, None] * step[None]

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
    return t, f / size, slope


def _quads(grid: Grid, found: _Crossings) -> tuple[np.ndarray, ...]:
    """Vertices (n, 4) around every crossed edge, seen from outside.

    Also the cell of each vertex, and whether that cell has no other one.
    """
    wide = grid.counts + 1
    stride = np.array([wide[1] * wide[2], wide[2], 1])
    sheet = cell_sheets(found.code, found.cell, stride)
    number = sheet.max(axis=1, initial=-1).astype(np.int64) + 1
    first = np.cumsum(number) - number
    along_u, along_w = stride[(found.axis + 1) % 3], stride[(found.axis + 2) % 3]
    quads = np.zeros((len(found.start), 4), np.int32)
    for k, (d, e) in enumerate(_AROUND):
        name = found.start - d * along_u - e * along_w
        cell = np.minimum(np.searchsorted(found.cell, name), len(found.cell) - 1)
        if not np.array_equal(found.cell[cell], name):
            raise ValueError(
                "isosurface: the surface leaves the blocks that the shape's Lipschitz constant "
                "allows or its bounding box, need true bounds. Check `lipschitz` and "
                "`bounding_box` of the shapes you wrote."
            )
        edge = 4 * found.axis + np.int8(d + 2 * e)
        column = np.where(found.start_inside, k, 3 - k)
        quads[np.arange(len(quads)), column] = first[cell] + sheet[cell, edge]
    return quads, np.repeat(found.cell, number), np.repeat(number == 1, number)


def _triangles(vertices, quads, found) -> np.ndarray:
    """Quadrilaterals cut along the diagonal that lies nearer to the surface."""
    triangles = np.empty((2, len(quads), 3), np.int32)
    for start in range(0, len(quads), _PIECE):
        piece = slice(start, start + _PIECE)
        q, point, normal = quads[piece], found.points[piece], found.normals[piece]

        def cost(i, j, q=q, point=point, normal=normal):
            a, b = vertices[q[:, i]], vertices[q[:, j]]
            off = np.abs((((a + b) / 2 - point) * normal).sum(axis=1))
            return off + 1e-3 * np.sqrt(((a - b) ** 2).sum(axis=1))

        first = (cost(0, 2) <= cost(1, 3))[:, None]
        triangles[0, piece] = np.where(first, q[:, [0, 1, 2]], q[:, [0, 1, 3]])
        triangles[1, piece] = np.where(first, q[:, [0, 2, 3]], q[:, [1, 2, 3]])
    return triangles.reshape(-1, 3)
