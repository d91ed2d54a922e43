"""One triangle in space: distance, side and solid angle at separate coordinate arrays."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax.sdf.base import clip, minimum, quotient, root
from sorojax.sdf.sampling import in_pieces
from sorojax.sdf.shapes.bars import segment_square

Vector = tuple[Array, ...]  # x, y, z
_ON_EDGE = 1024  # of rounding, of a side: points that near to an edge are on it


def minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def dot(a: Vector, b: Vector) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def over(p: Vector, a: Vector, b: Vector, c: Vector, slack: float = 0.0) -> tuple[Array, Array]:
    """Height of p over the plane of a triangle, and whether its foot is on the triangle, or
    beside it by at most `slack` of its sides."""
    n = cross(minus(b, a), minus(c, a))
    square = dot(n, n)
    within = None
    for start, end in ((a, b), (b, c), (c, a)):
        e = minus(end, start)
        beyond = -slack * dot(e, e) * root(square) if slack else 0.0
        side = dot(cross(e, minus(p, start)), n) >= beyond
        within = side if within is None else within & side
    height = quotient(dot(n, minus(p, a)), root(square) + jnp.zeros_like(p[0]))
    return height, within & (square > 0)


def triangle_square(p: Vector, a: Vector, b: Vector, c: Vector) -> Array:
    """Square of the distance to a triangle [m^2]."""
    height, within = over(p, a, b, c)
    return jnp.where(within, height * height, _edge_square(p, a, b, c))


def _edge_square(p: Vector, a: Vector, b: Vector, c: Vector) -> Array:
    """Square of the distance to the edges of a triangle [m^2]."""
    edges = [segment_square(p, *ends) for ends in ((a, b), (b, c), (c, a))]
    return minimum(edges[0], minimum(edges[1], edges[2]))


def triangle_side(p: Vector, a: Vector, b: Vector, c: Vector, inside: Array) -> Array:
    """Signed distance to the nearest triangle; over its face it has a slope at zero too, and
    on an edge that of one of the faces beside it."""
    height, within = over(p, a, b, c, _ON_EDGE * float(jnp.finfo(p[0].dtype).eps))
    far = root(_edge_square(p, a, b, c))
    return jnp.where(within, height, jnp.where(inside, -far, far))


def foot(p: Vector, a: Vector, b: Vector, c: Vector) -> tuple[Vector, Array, Array]:
    """Closest point of a triangle, and the edge and the corner it lies on (or -1).

    Edge k runs from corner k to the next.
    """
    height, within = over(p, a, b, c)
    n = cross(minus(b, a), minus(c, a))
    up = quotient(height, root(dot(n, n)))
    best = tuple(x - up * k for x, k in zip(p, n, strict=True))
    square = jnp.where(within, height * height, jnp.full_like(height, jnp.inf))
    nowhere = jnp.full(height.shape, -1)
    edge = corner = nowhere
    for k, (start, end) in enumerate(((a, b), (b, c), (c, a))):
        e = minus(end, start)
        t = clip(quotient(dot(minus(p, start), e), dot(e, e)), 0.0, 1.0)
        at = tuple(s + t * d for s, d in zip(start, e, strict=True))
        gap = minus(p, at)
        closer = ~within & (dot(gap, gap) < square)
        square = jnp.where(closer, dot(gap, gap), square)
        best = tuple(jnp.where(closer, u, v) for u, v in zip(at, best, strict=True))
        at_end = jnp.where(t >= 1, (k + 1) % 3, nowhere)
        edge = jnp.where(closer, jnp.where((t > 0) & (t < 1), k, nowhere), edge)
        corner = jnp.where(closer, jnp.where(t <= 0, k, at_end), corner)
    return best, edge, corner


def solid_angle(p: Vector, a: Vector, b: Vector, c: Vector) -> Array:
    """Signed solid angle of a triangle seen from p [sr] (Van Oosterom and Strackee)."""
    a, b, c = minus(a, p), minus(b, p), minus(c, p)
    la, lb, lc = (root(dot(v, v)) for v in (a, b, c))
    triple = dot(a, cross(b, c))
    rest = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return 2 * jnp.arctan2(triple, rest)


# Which triangles can be the closest one within each cube of an octree


MOST = 128  # triangles in a list that is complete
_SPLIT = 64  # triangles in a list that asks for smaller cubes
_COARSE, _DEPTH = 3, 10  # halvings of the largest cube before a close look, and at all
_WORK = 400  # pairs of cube and triangle looked at, for each triangle of the mesh
_HELD = 1 << 21  # of those pairs at once, of some 100 bytes each
_REACH = 0.6  # half an edge of the largest cube over the longest side of the mesh
_PIECE = 1 << 14
_LATTICE = np.array([[i // 9, i // 3 % 3, i % 3] for i in range(27)])
_CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])

_EIGHTHS = (_CORNERS[:, None] + _CORNERS) @ np.array([9, 3, 1])


class TriangleCells(eqx.Module):
    """Lists of triangles by cubes, right for the vertices they were made from.

    Those are held as bit patterns: integers are no parameters of a shape.

    Attributes:
        child: First of the eight children of a node, or minus one less its list.
        start: First entry of each list in `slots`.
        whole: Whether a list holds all that may be closest.
        slots: Triangles of all lists.
        made: Bits of the vertices.
        depth: Halvings from the largest to the smallest cube.
    """

    child: Int[Array, " nodes"]
    start: Int[Array, " lists_and_end"]
    whole: Bool[Array, " lists"]
    slots: Int[Array, " entries"]
    made: Int[Array, "vertices 3"]
    depth: int = eqx.field(static=True)

    def look_up(
        self, vertices: Float[Array, "vertices 3"], p: Vector
    ) -> tuple[Int[Array, " points"], Int[Array, " points"], Bool[Array, " points"]]:
        """First entry and length of the list at p [m], and whether it holds the closest."""
        low, edge = _cube(vertices)
        steps, within = [], self._current(vertices)
        for k in range(3):
            t = (p[k] - low[k]) / edge
            within = within & (t >= 0) & (t < 1)
            # In floats first: a number far outside does not fit an integer.
            inner = jnp.clip(t * 2**self.depth, 0, 2**self.depth - 1)
            steps.append(inner.astype(jnp.int32))

        def descend(level, node):
            octant = jnp.zeros_like(node)
            for step in steps:
                octant = 2 * octant + (step >> (self.depth - 1 - level) & 1)
            first = self.child[node]
            return jnp.where(first < 0, node, first + octant)

        node = jax.lax.fori_loop(0, self.depth, descend, jnp.zeros(p[0].shape, jnp.int32))
        held = -1 - self.child[node]
        first = self.start[held]
        return first, self.start[held + 1] - first, within & self.whole[held]

    def _current(self, vertices: Float[Array, "vertices 3"]) -> Bool[Array, ""]:
        if vertices.dtype.itemsize != self.made.dtype.itemsize:
            return jnp.asarray(False)
        return jnp.all(jax.lax.bitcast_convert_type(vertices, self.made.dtype) == self.made)


def _cube(vertices) -> tuple[Array, Array]:
    """Lower corner and edge of the largest cube [m]."""
    lower, upper = jnp.min(vertices, axis=0), jnp.max(vertices, axis=0)
    half = _REACH * jnp.max(upper - lower)
    return (lower + upper) / 2 - half, 2 * half


def triangle_cells(
    vertices: Float[Array, "vertices 3"], triangles: np.ndarray, slots: np.ndarray
) -> TriangleCells:
    """Lists for `triangles` (n, 3, 3), which they name by `slots` (n,)."""
    low, edge = (np.asarray(a) for a in _cube(vertices))
    low, edge = low[None], float(edge)
    pairs = np.zeros(len(triangles), np.int64), np.arange(len(triangles))
    child, lists, left, depth = [np.zeros(1, np.int64)], [], _WORK * len(triangles), 0
    named, balls = 0, balls_around(triangles)
    finest = max(float(balls[1].mean()), edge / 2**_DEPTH)
    while True:
        owner, face, apart, gap = _close(low, edge, balls, *pairs)
        below = np.ones((len(face), 8), bool)
        if depth >= _COARSE:
            owner, face, apart, below = _possible(low, edge, triangles, owner, face)
        count = np.bincount(owner, minlength=len(low))
        split = np.flatnonzero(count > (_SPLIT if edge > finest else len(triangles)))
        # Near the surface lists get short, and most points are asked for there.
        split = split[np.argsort(gap[split], kind="stable")]
        split = np.sort(split[np.cumsum(count[split]) <= min(left, _HELD)])
        left -= int(count[split].sum())
        number = np.full(len(low), -1)
        number[split] = np.arange(len(split))
        ends = number < 0
        nodes = sum(len(c) for c in child)
        child[-1] = np.where(ends, -named - np.cumsum(ends), nodes + 8 * number)
        named += int(ends.sum())
        kept = ends[owner]
        lists.append(_shortened(count[ends], owner[kept], face[kept], apart[kept]))
        if not len(split):
            break
        edge, depth = edge / 2, depth + 1
        low = (low[split, None] + edge * _CORNERS).reshape(-1, 3).astype(low.dtype)
        pairs = _handed_down(number[owner[~kept]], face[~kept], below[~kept])
        child.append(np.zeros(len(low), np.int64))
    count, entries = (np.concatenate(column) for column in zip(*lists, strict=True))
    start = np.concatenate([[0], np.cumsum(np.minimum(count, MOST))])
    bits = {4: jnp.int32, 8: jnp.int64}[vertices.dtype.itemsize]
    return TriangleCells(
        child=jnp.asarray(np.concatenate(child), jnp.int32),
        start=jnp.asarray(start, jnp.int32),
        whole=jnp.asarray(count <= MOST),
        slots=jnp.asarray(slots[entries], jnp.int32),
        made=jax.lax.bitcast_convert_type(vertices, bits),
        depth=depth,
    )


def _handed_down(owner: np.ndarray, face: np.ndarray, below: np.ndarray):
    """Triangles of each cube for those of its eight children where they count, by child."""
    rows = [np.flatnonzero(below[:, k]) for k in range(8)]
    child = np.concatenate([8 * owner[row] + k for k, row in enumerate(rows)])
    order = np.argsort(child, kind="stable")
    return child[order], face[np.concatenate(rows)][order]


def _shortened(count, owner, face, apart) -> tuple[np.ndarray, np.ndarray]:
    """True lengths of lists, and their entries: of each the nearest, at most `MOST`."""
    order = np.lexsort((apart, owner))
    place = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    return count, face[order[place < MOST]]


def balls_around(triangles) -> tuple[np.ndarray, np.ndarray]:
    """Middles (3, n) and radii (n,) of balls that hold the triangles [m]."""
    middle = triangles.mean(axis=1)
    reach = np.sqrt(((triangles - middle[:, None]) ** 2).sum(axis=2)).max(axis=1)
    return np.ascontiguousarray(middle.T), reach


def _close(low, edge: float, balls, owner, face):
    """The pairs of cube and triangle that the balls about both do not rule out, how far
    apart their middles are [m], and how far each cube's middle is from all balls [m]."""
    square = np.zeros(len(face), low.dtype)
    for k in range(3):
        square += ((low[:, k] + edge / 2)[owner] - balls[0][k][face]) ** 2
    apart = np.sqrt(square)
    start = np.searchsorted(owner, np.arange(len(low)))
    least = apart - balls[1][face]
    kept = least <= (np.minimum.reduceat(apart, start) + 1.0001 * 3**0.5 * edge)[owner]
    gap = np.minimum.reduceat(least, start)
    return owner[kept], face[kept], apart[kept], gap


def _possible(low, edge: float, triangles, owner, face):
    """The pairs of cube and triangle where the triangle may be closest to a point of it,
    its distance from the middle [m], and in which eighths of the cube.

    A triangle is further away than a plane between it and the middle of the cube. The one
    nearest to the middle rules it out if it is below this plane at all corners: its
    distance is convex, so it is below in between as well.
    """
    middle = low + low.dtype.type(edge / 2)
    distance, way = in_pieces(lambda o, f: _seen(middle[o], triangles[f]), _PIECE, owner, face)
    nearest = np.minimum.reduceat(distance, np.searchsorted(owner, np.arange(len(low))))
    rival = np.zeros(len(low), np.int64)
    lead = np.flatnonzero(distance == nearest[owner])
    rival[owner[lead]] = face[lead]
    # A little more than the cube: where a point falls is found with rounding.
    slack = 64 * np.finfo(low.dtype).eps * (np.abs(low).max() + edge)
    offset = ((_LATTICE / 2 - 0.5) * (edge + slack)).astype(low.dtype)
    nodes = (middle[:, None] + offset).reshape(-1, 3)
    rivals = np.repeat(rival, 27)
    upper = in_pieces(lambda p, f: _seen(p, triangles[f]), _PIECE, nodes, rivals)[0]
    upper = upper.reshape(-1, 27)
    plane = np.concatenate([(distance - slack)[:, None], way], axis=1)
    sides = np.concatenate([np.ones((27, 1), low.dtype), offset], axis=1)
    (below,) = in_pieces(lambda p, o: _open(sides, p, upper[o]), _PIECE, plane, owner)
    kept = below.any(axis=1)
    return owner[kept], face[kept], distance[kept], below[kept]


@jax.jit
def _open(sides, plane, upper):
    """Whether `upper` is above the plane at any corner of the eighths."""
    above = upper >= plane @ sides.T
    return jnp.any(above[:, _EIGHTHS], axis=2)


@jax.jit
def _seen(p, triangle):
    """Distance of a triangle from p [m], and the way from it to p."""
    at = tuple(p[:, k] for k in range(3))
    a, b, c = (tuple(triangle[:, i, k] for k in range(3)) for i in range(3))
    away = jnp.stack(minus(at, foot(at, a, b, c)[0]), axis=1)
    distance = jnp.linalg.norm(away, axis=1)
    safe = jnp.where(distance > 0, distance, jnp.ones_like(distance))
    return distance, away / safe[:, None]
