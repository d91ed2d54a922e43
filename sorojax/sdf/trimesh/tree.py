"""The nearest of many triangles by a tree of boxes, and the side of it a point is on."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax.math.host import KDTree
from sorojax.sdf.shapes.curves import take
from sorojax.sdf.trimesh.cells import (
    MOST,
    TriangleCells,
    Vector,
    balls_around,
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
        self,
        vertices: Float[Array, "vertices 3"],
        faces: Int[Array, "faces 3"],
        index: Int[Array, " points"],
        p: Vector,
    ) -> Bool[Array, " points"]:
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
    `slot` and a near leaf bound the search."""
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
    # Also where a list was cut: its cube may be large, and what it holds far away.
    steps = jnp.where(jnp.any(open_), leaves.bit_length() - 1, 0)
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
    levels = _levels(triangles)
    lower, upper = zip(levels[0], *levels, strict=True)  # row 0 is no node
    return jnp.concatenate(lower), jnp.concatenate(upper)


def _levels(triangles) -> list[tuple[Any, Any]]:
    """Corners of the boxes of each level of the tree, the root first."""
    slots = triangles.reshape(-1, 3 * LEAF, 3)
    levels = [(slots.min(axis=1), slots.max(axis=1))]
    while len(levels[0][0]) > 1:
        lower, upper = (side.reshape(-1, 2, 3) for side in levels[0])
        levels.insert(0, (lower.min(axis=1), upper.max(axis=1)))
    return levels


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
    # Spread evenly: copies of one triangle would all be looked at by points close to it.
    order = (np.arange(leaves * LEAF) * count // (leaves * LEAF))[None]
    while order.shape[1] > LEAF:
        at = centres[order]
        axis = np.argmax(np.ptp(at, axis=1), axis=1)
        along = np.take_along_axis(at, axis[:, None, None], axis=2)[..., 0]
        ranks = np.argsort(along, axis=1, kind="stable")
        order = np.take_along_axis(order, ranks, axis=1).reshape(2 * len(order), -1)
    return order.reshape(-1)


# Rays through triangles, on the host, and the thinnest wall between them.


_RAYS = 4000  # that measure a wall
_FIRST, _PIECE = 32, 1024  # rays that are followed at once
_OPPOSITE = -0.9  # cosine between the normals of the two sides of a wall
_INWARD = 0.02  # of a triangle: the places asked stay that far from its sides
_FLAT = 1e-9  # height over longest side: below it a triangle has no normal


class TriangleBoxes:
    """Boxes around triangles (n, 3, 3), halved again and again."""

    def __init__(self, corners: np.ndarray):
        self.corners, self.order = corners, order_by_halving(corners.mean(axis=1))
        self.levels = _levels(corners[self.order])

    def first_hits(self, start: np.ndarray, way: np.ndarray, least: float, most: float):
        """Distance [m] along unit vectors `way` from `start` (rays, 3) to the first triangle
        between `least` and `most`, infinite where there is none, and the triangle."""
        with np.errstate(divide="ignore"):
            inverse = 1 / way
        ray, box = np.arange(len(start)), np.zeros(len(start), int)
        for depth, (lower, upper) in enumerate(self.levels):
            if depth:
                ray, box = np.repeat(ray, 2), np.stack([2 * box, 2 * box + 1], 1).ravel()
            with np.errstate(invalid="ignore"):
                ends = [(side[box] - start[ray]) * inverse[ray] for side in (lower, upper)]
            # 0 * inf for a ray within the plane of a side, which does not bound it
            enter = np.nan_to_num(np.minimum(*ends), nan=-np.inf).max(axis=1)
            leave = np.nan_to_num(np.maximum(*ends), nan=np.inf).min(axis=1)
            slack = 1e-12 * np.abs(leave)
            through = (enter <= leave + slack) & (leave >= 0) & (enter <= most)
            ray, box = ray[through], box[through]
        ray = np.repeat(ray, LEAF)
        triangle = self.order[(LEAF * box[:, None] + np.arange(LEAF)).ravel()]
        distance = _distances(start[ray], way[ray], self.corners[triangle])
        distance[~((distance > least) & (distance <= most))] = np.inf
        far, hit = np.full(len(start), np.inf), np.full(len(start), -1)
        order = np.lexsort((distance, ray))
        first = order[np.r_[True, np.diff(ray[order]) > 0]] if len(ray) else order
        far[ray[first]], hit[ray[first]] = distance[first], triangle[first]
        return far, hit


def _distances(start, way, corners) -> np.ndarray:
    """Along rays to triangles (n, 3, 3), NaN where they miss (Moeller and Trumbore 1997)."""
    a = corners[:, 0]
    u, v = corners[:, 1] - a, corners[:, 2] - a
    p = np.cross(way, v)
    gap = start - a
    q = np.cross(gap, u)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / (u * p).sum(axis=1)
        s, t = (gap * p).sum(axis=1) * scale, (way * q).sum(axis=1) * scale
        # Sides are part of both triangles: no ray slips through between them.
        inside = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
        return np.where(inside, (v * q).sum(axis=1) * scale, np.nan)


def least_wall(vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Smallest distance [m] through a closed surface along inward normals.

    Rays start from up to about 4000 places, spread over the area and towards the corners of
    large triangles. Only sides that face away from each other within 25 degrees make a wall:
    towards a sharp edge the distance goes to zero.
    """
    corners = vertices[triangles]
    sides = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(sides[:, 0], sides[:, 1])
    double = np.linalg.norm(normal, axis=1)
    longest = (sides**2).sum(axis=2).max(axis=1)
    real = np.flatnonzero(double > _FLAT * longest)
    if not len(real):
        return np.inf
    corners, normal = corners[real], normal[real] / double[real, None]
    number, places = _places(corners, double[real])
    extent = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    boxes = TriangleBoxes(corners)
    wall, done, count = np.inf, 0, _FIRST
    shuffled = np.random.default_rng(0).permutation(len(number))
    while done < len(number):
        rows = shuffled[done : done + count]
        most = min(wall, 2 * extent)  # what is farther does not matter any more
        far, hit = boxes.first_hits(places[rows], -normal[number[rows]], 1e-9 * extent, most)
        opposite = (normal[hit] * normal[number[rows]]).sum(axis=1) < _OPPOSITE
        wall = float(far[np.isfinite(far) & opposite].min(initial=wall))
        done, count = done + count, min(2 * count, _PIECE)
    return wall


def _places(corners: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles and places on them (n, 3): centres, and more on the larger ones."""
    rows = np.arange(0, len(corners), -(-len(corners) // _RAYS))
    # a triangle with a share of the area gets that share of the rays, as a grid
    share = area[rows] / area[rows].sum() * _RAYS
    side = np.where(share > 1.5, np.ceil(np.sqrt(share)), 0).astype(int)
    number, weights = [rows], [np.full((len(rows), 3), 1 / 3)]
    for n in np.unique(side[side > 0]):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        grid = np.stack([i, j, n - i - j], axis=-1).reshape(-1, 3)
        grid = grid[grid[:, 2] >= 0] / n
        grid = (1 - 3 * _INWARD) * grid + _INWARD
        mine = rows[side == n]
        number.append(np.repeat(mine, len(grid)))
        weights.append(np.tile(grid, (len(mine), 1)))
    number, weight = np.concatenate(number), np.concatenate(weights)
    return number, (weight[:, :, None] * corners[number]).sum(axis=1)


# Triangles that pass through each other


_MOST = 1000  # pairs that are listed
_PAIRS_AT_ONCE = 20_000


def crossing_triangles(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Pairs (n, 2) of triangles without a common vertex, an edge of one through the other.

    Coplanar overlaps are not found. At most 1000 pairs are returned.
    """
    if len(triangles) < 2:
        return np.zeros((0, 2), int)
    centers, reach = balls_around(vertices[triangles])
    centers = centers.T
    found, total = [np.zeros((0, 2), int)], 0
    # Triangles of one size together: a few large ones must not widen every search.
    rank = np.frexp(np.maximum(reach, 1e-300))[1]
    for size in np.unique(rank):
        own = np.flatnonzero(rank == size)
        small = np.flatnonzero(rank <= size)
        tree = KDTree(centers[small])
        for start in range(0, len(own), _PAIRS_AT_ONCE):
            rows = own[start : start + _PAIRS_AT_ONCE]
            lists = tree.query_ball_point(centers[rows], reach[rows] + 2.0 ** float(size))
            first = np.repeat(rows, [len(x) for x in lists])
            second = small[np.concatenate([np.asarray(x, int) for x in lists])]
            keep = (rank[second] < size) | (second > first)
            pairs = _crossing(vertices, triangles, first[keep], second[keep])
            found.append(pairs)
            total += len(pairs)
            if total >= _MOST:
                return np.concatenate(found)[:_MOST]
    return np.concatenate(found)


def _crossing(vertices, triangles, first, second) -> np.ndarray:
    a, b = triangles[first], triangles[second]
    apart = (a[:, :, None] != b[:, None, :]).all(axis=(1, 2))
    first, second = first[apart], second[apart]
    p, q = vertices[triangles[first]], vertices[triangles[second]]
    near = (p.min(axis=1) <= q.max(axis=1)).all(axis=1)
    near &= (q.min(axis=1) <= p.max(axis=1)).all(axis=1)
    first, second, p, q = first[near], second[near], p[near], q[near]
    hit = np.zeros(len(first), bool)
    both = np.concatenate([p, q], axis=1)
    reach = np.ptp(both, axis=1).max(axis=1, initial=0.0)
    # of a volume, from coordinates that are rounded: triangles in one plane are no crossing
    rounding = 16 * np.finfo(float).eps * np.abs(both).max(axis=(1, 2), initial=0.0) * reach**2
    for k in range(3):
        hit |= _pierces(p[:, k], p[:, (k + 1) % 3], q, rounding)
        hit |= _pierces(q[:, k], q[:, (k + 1) % 3], p, rounding)
    return np.sort(np.stack([first[hit], second[hit]], axis=1), axis=1)


def _volume(a, b, c, d) -> np.ndarray:
    """Six times the signed volume of tetrahedra."""
    return (np.cross(b - a, c - a) * (d - a)).sum(axis=1)


def _pierces(start, end, triangle, rounding) -> np.ndarray:
    """Whether segments pass through the inside of triangles (n, 3, 3)."""
    a, b, c = triangle[:, 0], triangle[:, 1], triangle[:, 2]
    ends = _volume(a, b, c, start), _volume(a, b, c, end)
    across = (np.minimum(*ends) < -rounding) & (np.maximum(*ends) > rounding)
    sides = [_volume(start, end, u, v) for u, v in ((a, b), (b, c), (c, a))]
    least, most = np.minimum.reduce(sides), np.maximum.reduce(sides)
    return across & ((least > rounding) | (most < -rounding))
