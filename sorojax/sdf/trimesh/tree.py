"""The nearest of many triangles by a tree of boxes, and the side of it a point is on."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax.sdf.shapes.curves import take
from sorojax.sdf.trimesh.cells import (
    MOST,
    TriangleCells,
    Vector,
    dot,
    foot,
    minus,
    triangle_cells,
    triangle_square,
)

LEAF = 4  # triangles in the smallest box
GROUP = 512  # points that are searched for side by side
_STEPS = 6  # boxes looked at between two looks at triangles


class TriangleTree(eqx.Module):
    """Which triangles of a watertight mesh share a box, an edge or a corner.

    Boxes and normals follow from the vertices of the day. Far from those it was built for
    the tree is slow, and right. For exactly those `cells` list what may be closest.
    """

    order: Int[Array, " slots"]
    corner: Int[Array, "faces 3"]
    edge: Int[Array, "faces 3"]
    cells: TriangleCells | None
    corners: int = eqx.field(static=True)
    edges: int = eqx.field(static=True)

    def nearest(
        self, vertices: Float[Array, "vertices 3"], faces: Int[Array, "faces 3"], p: Vector
    ) -> Int[Array, " points"]:
        """Number of the face closest to each point p [m]."""
        triangles = vertices[faces[self.order]]
        boxes = _boxes(triangles)
        count = len(p[0])
        size = min(GROUP, max(count, 1))
        lists = None if self.cells is None else self.cells.look_up(vertices, p)
        rows, back = (p, lists), None
        if lists is not None and count > size:
            # A group goes on until its last point is done: it holds points of equal work.
            work = lists[1] + jnp.where(lists[2], 0, MOST)
            back = jnp.argsort(work)
            rows = jax.tree.map(lambda a: a[back], rows)
        groups = jax.tree.map(lambda a: _grouped(a, size), rows)
        slot = jax.lax.map(lambda row: self._search(triangles, boxes, *row), groups)
        slot = slot.reshape(-1)[:count]
        if back is not None:
            slot = jnp.zeros_like(slot).at[back].set(slot)
        return self.order[slot]

    def _search(self, triangles: Float[Array, "slots 3 3"], boxes: tuple, p: Vector, lists):
        """Slot of the triangle closest to each point of a group."""
        best, slot = jnp.full_like(p[0], jnp.inf), jnp.zeros(p[0].shape, jnp.int32)
        if self.cells is None:
            return _walk(triangles, boxes, p, best, slot, slot == 0)
        held, parts = self.cells.slots, tuple(triangles[:, i] for i in range(3))
        first, length, whole = lists

        def compare(k, state):
            best, slot = state
            at = held[first + jnp.minimum(jnp.asarray(k, jnp.int32), length - 1)]
            square = triangle_square(p, *take(parts, at))
            return jnp.where(square < best, square, best), jnp.where(square < best, at, slot)

        best, slot = jax.lax.fori_loop(0, jnp.max(length), compare, (best, slot))
        return _walk(triangles, boxes, p, best, slot, ~whole)

    def inside(
        self, vertices: Float[Array, "vertices 3"], faces: Int[Array, "faces 3"],
        index: Int[Array, " points"], p: Vector,
    ) -> Bool[Array, " points"]:  # fmt: skip
        """Whether p lies behind the normal at the closest point of the face `index`."""
        triangles = vertices[faces]
        face, edge, corner = self._normals(triangles)
        a, b, c = take(tuple(triangles[:, i] for i in range(3)), index)
        closest, on_edge, on_corner = foot(p, a, b, c)
        (normal,) = take((face,), index)
        for table, member, on in ((edge, self.edge, on_edge), (corner, self.corner, on_corner)):
            for k in range(3):
                (there,) = take((table,), member[index, k])
                pairs = zip(there, normal, strict=True)
                normal = tuple(jnp.where(on == k, new, old) for new, old in pairs)
        behind = dot(minus(p, closest), normal) < 0
        # A mesh with its faces turned inwards has a negative volume.
        volume = jnp.sum(triangles[:, 0] * jnp.cross(triangles[:, 1], triangles[:, 2]))
        return behind == (volume > 0)

    def _normals(self, triangles: Float[Array, "faces 3 3"]):
        """Normals of faces, edges and corners; those of corners weighted by angle."""
        sides = jnp.roll(triangles, -1, axis=1) - triangles
        face = _normalised(jnp.cross(sides[:, 0], sides[:, 1]))
        edge = jnp.zeros((self.edges, 3), face.dtype)
        corner = jnp.zeros((self.corners, 3), face.dtype)
        ways = _normalised(sides)
        for k in range(3):
            edge = edge.at[self.edge[:, k]].add(face)
            cosine = -jnp.sum(ways[:, k] * ways[:, k - 1], axis=1)
            angle = jnp.arccos(jnp.clip(cosine, -1, 1))
            corner = corner.at[self.corner[:, k]].add(angle[:, None] * face)
        return face, edge, corner


def _grouped(a: Array, size: int) -> Array:
    return jnp.pad(a, (0, -len(a) % size)).reshape(-1, size)


def _walk(triangles: Float[Array, "slots 3 3"], boxes: tuple, p: Vector, best, slot, open_):
    """Slot of the closest triangle, where that is `open_`: the squared distance `best` of
    `slot` bounds the search, or a near leaf if there is none."""
    leaves = len(triangles) // LEAF
    parts = tuple(triangles[:, i] for i in range(3))

    def gap(node):
        """Square of the distance to a box [m^2]."""
        lower, upper = take(boxes, node)
        out = (_beyond(c, a, b) for c, a, b in zip(p, lower, upper, strict=True))
        return sum((d * d for d in out), start=jnp.zeros_like(p[0]))

    def look(node, best, slot):
        """The triangles of the leaf `node`, where it is one."""
        first = LEAF * jnp.maximum(node - leaves, 0)

        def compare(k, state):
            best, slot = state
            at = first + jnp.asarray(k, jnp.int32)
            square = triangle_square(p, *take(parts, at))
            closer = (node >= leaves) & (square < best)
            return jnp.where(closer, square, best), jnp.where(closer, at, slot)

        return jax.lax.fori_loop(0, LEAF, compare, (best, slot))

    def descend(_, node):
        return 2 * node + (gap(2 * node) > gap(2 * node + 1)).astype(jnp.int32)

    def visit(state):
        node, best, slot = state

        def step(_, node):
            near = gap(node) < best
            ahead = jnp.where(near, 2 * node, _next(node))
            # A leaf that is near waits for the look at its triangles.
            return jnp.where((node == 1) | near & (node >= leaves), node, ahead)

        # Loops of their own: in one, each step would repeat all those before it.
        node = jax.lax.fori_loop(0, _STEPS, step, node)
        best, slot = look(node, best, slot)
        return jnp.where(node >= leaves, _next(node), node), best, slot

    root = jnp.ones(p[0].shape, jnp.int32)
    if leaves == 1:
        return look(root, best, slot)[1]
    blind = jnp.any(open_ & jnp.isinf(best))
    steps = jnp.where(blind, leaves.bit_length() - 1, 0)
    closest = jax.lax.fori_loop(0, steps, descend, root)
    best, slot = look(closest, best, slot)
    start = (jnp.where(open_, 2 * root, root), best, slot)
    _, _, slot = jax.lax.while_loop(lambda state: jnp.any(state[0] != 1), visit, start)
    return slot


def _normalised(a: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    length = jnp.sqrt(jnp.sum(a * a, axis=-1, keepdims=True))
    return a / jnp.where(length > 0, length, jnp.ones_like(length))


def _beyond(c: Array, lower: Array, upper: Array) -> Array:
    return jnp.maximum(jnp.maximum(lower - c, c - upper), 0)


def _next(node: Int[Array, " points"]) -> Int[Array, " points"]:
    """The node after all below `node`, depth first; the root when nothing is left."""
    after = node + 1
    return after >> jax.lax.population_count((after & -after) - 1)


def _boxes(triangles: Float[Array, "slots 3 3"]) -> tuple[Array, Array]:
    """Corners of the boxes of all nodes: the root is row 1, row i holds 2 i and 2 i + 1."""
    lower = jnp.min(triangles.reshape(-1, 3 * LEAF, 3), axis=1)
    upper = jnp.max(triangles.reshape(-1, 3 * LEAF, 3), axis=1)
    levels = [(lower, upper)]
    while len(lower) > 1:
        lower = jnp.min(lower.reshape(-1, 2, 3), axis=1)
        upper = jnp.max(upper.reshape(-1, 2, 3), axis=1)
        levels.insert(0, (lower, upper))
    levels.insert(0, levels[0])  # row 0 is no node
    lower, upper = zip(*levels, strict=True)
    return jnp.concatenate(lower), jnp.concatenate(upper)


def triangle_tree(
    vertices: np.ndarray, faces: np.ndarray, lists: bool = False
) -> TriangleTree | None:
    """The tree of a mesh; None unless every edge joins two faces of the same sense.

    Corners at the same place count as one, as files of loose triangles need it.
    """
    _, weld = np.unique(vertices, axis=0, return_inverse=True)
    corner = weld.reshape(-1)[faces]
    start, end = corner.reshape(-1), np.roll(corner, -1, axis=1).reshape(-1)
    ways = np.stack([start, end], axis=1)
    pairs, edge, uses = np.unique(
        np.sort(ways, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    if (uses != 2).any() or len(np.unique(ways, axis=0)) != len(ways):
        return None
    triangles = vertices[faces]
    order = order_by_halving(triangles.mean(axis=1))
    cells = None
    if lists:
        slots = np.zeros(len(faces), np.int64)
        slots[order[::-1]] = np.arange(len(order))[::-1]
        cells = triangle_cells(jnp.asarray(vertices), triangles, slots)
    return TriangleTree(
        order=jnp.asarray(order, jnp.int32),
        cells=cells,
        corner=jnp.asarray(corner, jnp.int32),
        edge=jnp.asarray(edge.reshape(-1, 3), jnp.int32),
        corners=int(corner.max()) + 1,
        edges=len(pairs),
    )


def order_by_halving(centres: np.ndarray) -> np.ndarray:
    """Rows of `centres` halved again and again across their longest side, padded."""
    count = len(centres)
    leaves = 1 << max(0, -(-count // LEAF) - 1).bit_length()
    order = np.minimum(np.arange(leaves * LEAF), count - 1)[None]
    while order.shape[1] > LEAF:
        at = centres[order]
        axis = np.argmax(np.ptp(at, axis=1), axis=1)
        along = np.take_along_axis(at, axis[:, None, None], axis=2)[..., 0]
        ranks = np.argsort(along, axis=1, kind="stable")
        order = np.take_along_axis(order, ranks, axis=1).reshape(2 * len(order), -1)
    return order.reshape(-1)
