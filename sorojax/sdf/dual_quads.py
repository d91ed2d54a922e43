"""Triangles of dual contouring that cannot pass through each other.

The quadrilateral around a grid edge has one vertex in each of four cells. Together the four
tetrahedra between the edge and the sides of the quadrilateral are its envelope, and those of
two edges overlap nowhere as long as their vertices are shared: triangles inside their
envelopes do not cross (Ju and Udeshi 2006). Two triangles are taken if they stay inside; else
four around the point where the edge meets the surface, which always do.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sorojax.sdf.dual_vertices import MARGIN, padded

_PIECE = 1 << 13
_SPARE = 1e-4  # cells that two triangles keep from the walls of their envelope
_WORSE = 0.02  # cells that a diagonal may lie further from the surface than the other one


class Quads(NamedTuple):
    """Quadrilaterals around crossed grid edges, seen from outside.

    Attributes:
        vertices: (n, 4) rows of the vertices.
        start: (n, 3) nodes at which the edges begin.
        axis: (n,) axis they run along.
        offset: (n, 3) crossings, seen from there [cells].
        normal: (n, 3) outward unit normals at them.
    """

    vertices: np.ndarray
    start: np.ndarray
    axis: np.ndarray
    offset: np.ndarray
    normal: np.ndarray


def split(vertices: np.ndarray, quads: Quads, first: int) -> tuple[np.ndarray, ...]:
    """Two triangles (2, n, 3) for each quadrilateral, two more (m, 3) for some of them.

    Those have a vertex of their own on the grid edge: the last result (m / 2, 3), numbered
    from `first` on.

    Args:
        vertices: (.., 3) of all cells [cells].
        quads: Quadrilaterals.
        first: Number of the next vertex.
    """
    pairs, more, added = [np.zeros((2, 0, 3), np.int32)], [np.zeros((0, 3), np.int32)], []
    for begin in range(0, len(quads.axis), _PIECE):
        piece = Quads(*(column[begin : begin + _PIECE] for column in quads))
        found = _split_piece(vertices, piece, first + sum(map(len, added)))
        for whole, part in zip((pairs, more, added), found, strict=True):
            whole.append(part)
    return (
        np.concatenate(pairs, axis=1),
        np.concatenate(more),
        np.concatenate([np.zeros((0, 3)), *added]),
    )


def _split_piece(vertices, quads: Quads, first: int) -> tuple[np.ndarray, ...]:
    v = quads.vertices
    rows = np.arange(len(v))
    share = np.clip(quads.offset[rows, quads.axis], MARGIN, 1 - MARGIN)
    point = quads.start.astype(float)
    point[rows, quads.axis] += share
    ends = vertices.take(v, axis=0)
    ends -= point[:, None]
    axis = quads.axis.astype(np.int32)
    cut = padded(_cut, ends.astype(np.float32), quads.normal, axis, share)
    other, turned = np.flatnonzero(cut == 1), v.copy()
    turned[other] = np.roll(v[other], -1, axis=1)
    pair = np.empty((2, len(v), 3), v.dtype)
    pair[0], pair[1, :, 0], pair[1, :, 1:] = turned[:, :3], turned[:, 0], turned[:, 2:]
    fan = np.flatnonzero(cut == 2)
    hub = (first + np.arange(len(fan))).astype(v.dtype)
    a, b, c, d = ([hub, v[fan, k], v[fan, (k + 1) % 4]] for k in range(4))
    pair[0, fan], pair[1, fan] = np.stack(a, axis=1), np.stack(b, axis=1)
    return pair, np.concatenate([np.stack(c, axis=1), np.stack(d, axis=1)]), point[fan]


@jax.jit
def _cut(ends, normal, axis, share):
    """How to cut: 0 from the first to the third corner, 1 the other way, 2 in four.

    The diagonal that lies nearer to the surface is preferred, the shorter one on planes.

    Args:
        ends: (n, 4, 3) corners as seen from the point on the edge [cells].
        normal: (n, 3) unit normal there.
        axis: (n,) axis of the edge.
        share: (n,) place of the point along the edge.
    """
    corners = [_turned(ends[:, k], axis) for k in range(4)]
    # Seen along the edge the corners run round it; mirrored where they run the other way.
    back = _cross(corners[0], corners[1]) < 0
    a, b, c, d = ((jnp.where(back, y, x), jnp.where(back, x, y), z) for x, y, z in corners)
    low, high = -share, 1 - share
    one, two = _stays(a, b, c, d, low, high), _stays(b, c, d, a, low, high)
    off, other = _cost(ends, normal, 0, 2), _cost(ends, normal, 1, 3)
    one, two = one & (off <= other + _WORSE), two & (other <= off + _WORSE)
    return jnp.where(one & ((off <= other) | ~two), 0, jnp.where(two, 1, 2))


def _turned(p, axis):
    """Coordinates across the edge, right-handed, and along it."""
    x, y, z = p[:, 0], p[:, 1], p[:, 2]
    zero, one = axis == 0, axis == 1
    return (
        jnp.where(zero, y, jnp.where(one, z, x)),
        jnp.where(zero, z, jnp.where(one, x, y)),
        jnp.where(zero, x, jnp.where(one, y, z)),
    )


def _cross(a, b):
    return a[0] * b[1] - a[1] * b[0]


def _stays(a, b, c, d, low, high):
    """Whether triangles (a, b, c) and (a, c, d) lie in the envelope of an edge.

    The diagonal ac passes the edge on the side of b or of d. It must go through the triangle
    between the edge and that corner, and the edge through the triangle of the other one.
    """
    side = _cross(a, c)
    near = side > 0
    r = tuple(jnp.where(near, p, q) for p, q in zip(b, d, strict=True))
    far = tuple(jnp.where(near, q, p) for p, q in zip(b, d, strict=True))
    to, off = _cross(a, r), _cross(r, c)
    width = to + off  # of one sign: a, r and c lie in quadrants of their own
    along = side / width  # the diagonal, seen along the edge, on the way from it to r
    height = (off * a[2] + to * c[2]) / width
    level = height - along * r[2]
    rest = 1 - along
    inside = (rest > 0) & (level > low * rest + _SPARE) & (level < high * rest - _SPARE)
    weights = _cross(c, far), _cross(far, a), side
    total = weights[0] + weights[1] + weights[2]
    middle = (weights[0] * a[2] + weights[1] * c[2] + weights[2] * far[2]) / total
    return inside & (middle > low + _SPARE) & (middle < high - _SPARE)


def _cost(ends, normal, k, m):
    p, q = ([ends[:, i, j] for j in range(3)] for i in (k, m))
    off = sum((a + b) * normal[:, j] for j, (a, b) in enumerate(zip(p, q, strict=True)))
    square = sum((a - b) ** 2 for a, b in zip(p, q, strict=True))
    return jnp.abs(off) / 2 + 1e-3 * jnp.sqrt(square)
