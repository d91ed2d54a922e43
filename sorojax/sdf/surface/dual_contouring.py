"""Dual contouring: one vertex per sheet and cell, at the point nearest to the planes of its
crossings, and triangles that do not cross each other.

The quadrilateral around a grid edge has one vertex in each of four cells. Together the four
tetrahedra between the edge and the sides of the quadrilateral are its envelope, and those of
two edges overlap nowhere as long as their vertices are shared: triangles inside their
envelopes do not cross. Two triangles are taken if they stay inside; else four around the
point where the edge meets the surface, which always do. Blocks are processed in groups, so
that only crossings and the result are in memory for all.

References:
    Ju et al., Dual contouring of Hermite data, SIGGRAPH 2002, for the vertices.
    Schaefer, Ju and Warren, Manifold dual contouring, IEEE TVCG 13, 2007, for the sheets.
    Ju and Udeshi, Intersection-free contouring on an octree grid, Pacific Graphics 2006.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import in_pieces, values
from sorojax.sdf.surface.blocks import Grid, leaf_fields
from sorojax.sdf.surface.sheets import (
    Crossings,
    Faces,
    blocks_before,
    cell_sheets,
    cells_before,
    corner,
    crossings,
    doubtful_faces,
)
from sorojax.sdf.surface.walls import (
    NO_EDGES,
    NONE,
    Forced,
    Lost,
    apply_forced,
    forced_nodes,
    keep_joined,
    lost_edges,
    with_blocks_around,
    without_specks,
)

MARGIN = 0.02  # cells: vertices stay off cell walls, so that none coincide in float32
_PULL = 0.02  # weight that holds a vertex at the mean crossing, against 1 per plane
_STEPS = 3
_PIECE = 1 << 13
_PAIRS = list(zip(*np.triu_indices(3), strict=True))
# By axis of a grid edge: the four cells around it, counter-clockwise, begin so far before it.
SHIFTS = np.array(
    [
        [np.roll([0, d, e], axis) for d, e in ((1, 1), (0, 1), (0, 0), (1, 0))]
        for axis in range(3)
    ],
    np.float32,
)
SUMS = 16  # 1, x, n, n (n . x), n n in six


def gathered(
    offset: np.ndarray, normal: np.ndarray, shift: np.ndarray, quads: np.ndarray, total
) -> None:
    """Add planes to the sums (vertices, 16) of the vertices they belong to.

    Args:
        offset: (n, 3) points of the planes [cells].
        normal: (n, 3) unit normals.
        shift: (n,) rows of `SHIFTS`: how far each of the four cells begins before there.
        quads: (n, 4) vertices in these cells.
        total: Sums as seen from the corners of the vertices' cells.
    """
    from scipy.sparse import csc_array

    for start in range(0, len(quads), _PIECE):
        piece = slice(start, start + _PIECE)
        q = quads[piece]
        # Neighbours in space are neighbours in number: a piece fills a short range.
        low, high = int(q.min()), int(q.max()) + 1
        (row,) = in_pieces(_features, _PIECE, offset[piece], normal[piece], shift[piece])
        ends = np.arange(q.size + 1, dtype=np.int32)
        data = (np.ones(q.size, np.float32), (q - low).ravel(), ends)
        total[low:high] += csc_array(data, shape=(high - low, q.size)) @ row.reshape(-1, SUMS)


@jax.jit
def _features(x, n, shift):
    """Rows (planes, 4, 16) of what is summed."""
    shift = jnp.asarray(SHIFTS)[shift]
    x = [x[:, None, i] + shift[:, :, i] for i in range(3)]
    n = [jnp.broadcast_to(n[:, None, i], x[0].shape) for i in range(3)]
    level = n[0] * x[0] + n[1] * x[1] + n[2] * x[2]
    columns = [jnp.ones_like(level), *x, *n, *(part * level for part in n)]
    return jnp.stack(columns + [n[i] * n[j] for i, j in _PAIRS], axis=2)


def place(total: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """Vertices (n, 3) in shares of their cells, nearest to the planes summed in `total`.

    Directions that no plane fixes keep the mean of the crossings. Repeated steps of a
    damped problem leave no trace of the damping where planes meet at an edge or corner.
    Vertices that are not `alone` in their cell stay at the mean, which keeps them apart.
    """
    if not len(total):
        return np.zeros((0, 3), np.float32)
    return in_pieces(_nearest, _PIECE, total, alone)[0]


@jax.jit
def _nearest(total, alone):
    """Minimum of the squared distances to the planes, by steps that damp ever less."""
    number, *columns = total.T
    columns = [column / number for column in columns]
    mean, right, square = columns[:3], columns[6:9], columns[9:]
    damped = [m + (_PULL if i in (0, 3, 5) else 0.0) for i, m in enumerate(square)]
    inverse = _inverse(*damped)
    x = mean
    for _ in range(_STEPS):
        rest = [r - s for r, s in zip(right, _times(square, x), strict=True)]
        x = [a + b for a, b in zip(x, _times(inverse, rest), strict=True)]
    found = [jnp.where(alone, a, b) for a, b in zip(x, mean, strict=True)]
    return jnp.clip(jnp.stack(found, axis=1), MARGIN, 1 - MARGIN)


def _times(m, x):
    """Symmetric matrix of six entries times a vector."""
    a, b, c = x
    return (
        m[0] * a + m[1] * b + m[2] * c,
        m[1] * a + m[3] * b + m[4] * c,
        m[2] * a + m[4] * b + m[5] * c,
    )


def _inverse(xx, xy, xz, yy, yz, zz):
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    adjugate = (a, b, c, xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy)
    determinant = xx * a + xy * b + xz * c
    return [entry / determinant for entry in adjugate]


# Triangles of dual contouring that cannot pass through each other


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
    (cut,) = in_pieces(_cut, _PIECE, ends.astype(np.float32), quads.normal, axis, share)
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


# Dual contouring: one vertex per sheet and cell, placed by the planes of its crossings


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
    return groups, Lost(*map(np.concatenate, zip(*lost, strict=True))) if lost else NO_EDGES


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
