"""Sharp edges and corners of a solid in its tetrahedra: surface nodes are moved onto the ridge
wherever an edge of the surface mesh would cut it off.
"""

import itertools
from typing import NamedTuple

import numpy as np

from sorojax.mesh.elements.simplex import Tet4
from sorojax.mesh.motion.boundary import (
    SETTLE_ZOOMS as ZOOMS,
    Sides,
    joined,
    no_sides,
    normals_near,
    settle,
)
from sorojax.mesh.sizes import Sizes
from sorojax.mesh.solid.lattice import badness, signed_volumes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import normals, values

_TURN = np.cos(np.deg2rad(20.0))  # of the normal that makes a ridge
_TOUCH = 0.02  # of the way to the next triangle: nodes that near to a ridge are on it
_SOLID = 0.05  # least volume of three unit normals that make a corner
_LEFT = 0.1  # of its volume that a cell inside keeps where another end can be moved
_FLAT = 1e-3  # of a cube: volume below zero of cells of the surface that count as flat
_SLIM = 0.12  # least height of a triangle of ridge nodes over its longest side


def boundary_triangles(cells: np.ndarray) -> np.ndarray:
    """Faces of one tetrahedron only, counter-clockwise from outside."""
    faces = np.concatenate([cells[:, list(f)] for f in Tet4.facets])
    rows = np.sort(faces, axis=1).astype(np.int64)
    n = rows.max(initial=0) + 1
    keys = np.unique(rows[:, 0] * n + rows[:, 1], return_inverse=True)[1] * n + rows[:, 2]
    _, first, count = np.unique(keys, return_index=True, return_counts=True)
    return faces[first[count == 1]]


class Around:
    """Rows of a table of nodes that hold a node."""

    def __init__(self, table: np.ndarray, count: int):
        order = np.argsort(table.ravel(), kind="stable")
        self.table, self.rows = table, order // table.shape[1]
        self.start = np.searchsorted(table.ravel()[order], np.arange(count + 1))

    def rows_of(self, node: int) -> np.ndarray:
        return self.rows[self.start[node] : self.start[node + 1]]

    def __call__(self, node: int) -> np.ndarray:
        return self.table[self.rows_of(node)]


def _meeting(shape: AbstractSdf, seen: np.ndarray, start: np.ndarray, pitch: np.ndarray):
    """Where the sides seen at the places `seen` (groups, sides, 3) meet, their normals there,
    and whether they do meet; `pitch` (groups,) is the size of the cells there [m].

    A rounded edge looks smooth from near, a ridge does not.
    """
    groups, count = seen.shape[:2]
    owner = np.repeat(np.arange(groups), count)
    x, flat = start.copy(), seen.reshape(-1, 3)
    sides = Sides(owner, np.zeros(len(owner), int), np.zeros_like(flat))
    for zoom in (1.0, *ZOOMS[:-1]):
        sides = sides._replace(along=flat - x[owner])
        gap = settle((shape,), x, sides, (zoom,)) - start
        far = np.maximum(np.linalg.norm(gap, axis=1), 1e-300)
        x = start + gap * np.minimum(1, 1.5 * pitch / far)[:, None]
    n = normals_near((shape,), x, sides, 1e-3)[0].reshape(-1, count, 3)
    cosine = np.max(
        [(n[:, i] * n[:, j]).sum(axis=1) for i in range(count) for j in range(i)], axis=0
    )
    near = np.linalg.norm(x - start, axis=1) < 1.2 * pitch
    good = (cosine < _TURN) & near & (np.abs(values(shape, x)) < 1e-4 * pitch)
    if count == 3:
        good &= np.abs(np.linalg.det(n)) > _SOLID
    return x, n, good


def _independent(normals: np.ndarray) -> list[int]:
    """One normal, two that differ, or three that make a corner."""
    cosine = normals @ normals[0]
    second = int(np.argmin(cosine))
    if cosine[second] > _TURN:
        return [0]
    solid = np.abs(normals @ np.cross(normals[0], normals[second]))
    third = int(np.argmax(solid))
    return [0, second, third] if solid[third] > _SOLID else [0, second]


class Snapper:
    """Host state while nodes are put on ridges one after the other.

    `seen` holds up to three places per node from which its sides are seen, `normal` the
    normals there; a node off the ridges has one, repeated.
    """

    def __init__(self, shape, points, cells, size: Sizes):
        triangles = boundary_triangles(cells)
        self.shape, self.points, self.pitch = shape, points.copy(), size(points)
        self.triangles = triangles
        self.ridge, self.corner = np.zeros(len(points), bool), np.zeros(len(points), bool)
        self.parts: dict[int, Sides] = {}
        self.around = Around(triangles, len(points))
        self.cells_around = Around(cells, len(points))
        self.seen = np.repeat(points[:, None], 3, axis=1)
        self.normal = np.zeros_like(self.seen)
        nodes = np.unique(triangles)
        self.skin = np.zeros(len(points), bool)
        self.skin[nodes] = True
        self.normal[nodes] = normals(shape, points[nodes])[:, None]
        a, b = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
        edges = np.stack([a, b], axis=1)[a < b]
        n = self.normal[edges, 0]
        self.edges = edges[(n[:, 0] * n[:, 1]).sum(axis=1) < _TURN]

    def snap_touching(self) -> None:
        """Nodes that lie on a ridge already have more sides than their own normal tells."""
        nodes = np.unique(self.edges)
        rings = [self.around(node) for node in nodes]
        middle = [self.points[ring].mean(axis=1) for ring in rings]
        if not rings:
            return
        near = [
            self.points[node] + _TOUCH * (m - self.points[node])
            for node, m in zip(nodes, middle, strict=True)
        ]
        every = normals(self.shape, np.concatenate(near))
        ways = np.split(every, np.cumsum([len(m) for m in middle])[:-1])
        found = []
        for node, m, n in zip(nodes, middle, ways, strict=True):
            picked = _independent(n)
            if len(picked) > 1:
                rows = [*picked, *picked][:3]
                self.seen[node], self.normal[node] = m[rows], n[rows]
                found.append((node, len(picked)))
        for count in (3, 2):
            own = np.array([node for node, sides in found if sides == count], dtype=int)
            if not len(own):
                continue
            seen = self.seen[own, :count]
            x, n, good = _meeting(self.shape, seen, self.points[own], self.pitch[own])
            good &= np.linalg.norm(x - self.points[own], axis=1) < 3 * _TOUCH * self.pitch[own]
            for node, *rest in zip(own[good], x[good], seen[good], n[good], strict=True):
                self._put(node, *rest)
                self.corner[node] = count == 3

    def snap_corners(self) -> None:
        rows = np.isin(self.triangles, np.unique(self.edges)).all(axis=1)
        triangles = self.triangles[rows & ~self.corner[self.triangles].any(axis=1)]
        n = self.normal[triangles].reshape(-1, 9, 3)
        triples = list(itertools.combinations(range(9), 3))
        solid = [np.abs(np.linalg.det(n[:, list(t)])) for t in triples]
        best = np.argmax(solid, axis=0) if len(triangles) else np.zeros(0, int)
        keep = np.max(solid, axis=0) > _SOLID if len(triangles) else np.zeros(0, bool)
        triangles = triangles[keep]
        if not len(triangles):
            return
        pick = np.array(triples)[best[keep]]
        seen = self.seen[triangles].reshape(-1, 9, 3)
        seen = np.take_along_axis(seen, pick[:, :, None], axis=1)
        start = self.points[triangles].mean(axis=1)
        pitch = self.pitch[triangles].max(axis=1)
        x, n, good = _meeting(self.shape, seen, start, pitch)
        done = self.points[self.corner]
        parts = (x[good], triangles[good], seen[good], n[good], pitch[good])
        for place, group, sides, ways, near in zip(*parts, strict=True):
            if len(done) and np.linalg.norm(done - place, axis=1).min() < 1e-3 * near:
                continue
            done = np.concatenate([done, place[None]])
            gap = np.linalg.norm(self.points[group] - place, axis=1)
            free = np.array([self._allowed(node, place) for node in group])
            free &= ~self.corner[group]
            if free.any():
                node = group[np.argmin(np.where(free, gap, np.inf))]
                self._put(node, place, sides, ways)
                self.corner[node] = True

    def snap_ridges(self) -> None:
        for _ in range(3):
            edges, x, seen, n = self._crossings()
            gap = np.linalg.norm(self.points[edges] - x[:, None], axis=2)
            moved = False
            for k in np.argsort(gap, axis=None, kind="stable"):
                row, end = divmod(int(k), 2)
                node = edges[row, end]
                if self.ridge[node] or not self._cut(edges[row][None])[0]:
                    continue
                if self._allowed(node, x[row]):
                    self._put(node, x[row], seen[row], n[row])
                    moved = True
            if not moved:
                return

    def left(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges that still cut a ridge off, and where they should meet it."""
        edges, x, _, _ = self._crossings()
        if not len(edges):
            return edges, x
        first = np.unique(edges, axis=0, return_index=True)[1]
        return edges[first], x[first]

    def _crossings(self):
        """Edges whose ends have no side in common, where a side of each meet, and places
        from which these are seen, and their normals."""
        edges = self.edges[self._cut(self.edges)]
        if not len(edges):
            return edges, np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros((0, 2, 3))
        rows, seen = self._side_pairs(edges)
        middle = self.points[edges].mean(axis=1)[rows]
        pitch = self.pitch[edges].max(axis=1)[rows]
        x, n, good = _meeting(self.shape, seen, middle, pitch)
        alive = np.array(self.ridge[edges].any(axis=1))
        alive[rows[good]] = True
        self.edges = edges[alive]  # the others are smooth
        return edges[rows[good]], x[good], seen[good], n[good]

    def _cut(self, edges: np.ndarray) -> np.ndarray:
        """Whether the ends of an edge have no side in common."""
        cosine = np.einsum("eik,ejk->eij", self.normal[edges[:, 0]], self.normal[edges[:, 1]])
        return cosine.max(axis=(1, 2)) < _TURN

    def _side_pairs(self, edges: np.ndarray):
        """Rows of `edges` and the places from which one side of each end is seen."""
        rows, seen = [], []
        for i, j in itertools.product(range(3), range(3)):
            # Off a ridge the three places are one.
            fresh = (i == 0) | self.ridge[edges[:, 0]]
            fresh &= (j == 0) | self.ridge[edges[:, 1]]
            rows.append(np.flatnonzero(fresh))
            pair = [self.seen[edges[fresh, 0], i], self.seen[edges[fresh, 1], j]]
            seen.append(np.stack(pair, axis=1))
        return np.concatenate(rows), np.concatenate(seen)

    def _allowed(self, node: int, place: np.ndarray) -> bool:
        """Whether no triangle of three ridge nodes becomes flat, and no cell inverted."""
        mine = self.around(node)
        mine = mine[(self.ridge[mine] | (mine == node)).all(axis=1)]
        if len(mine):
            x = np.where((mine == node)[..., None], place, self.points[mine])
            side = np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(axis=1)
            area = np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1)
            if not (area > _SLIM * side**2).all():
                return False
        cells = self.cells_around(node)
        x = self.points[cells]
        old = 6 * signed_volumes(x)
        new = 6 * signed_volumes(np.where((cells == node)[..., None], place, x))
        # A cell of the surface alone may become flat: it is taken away.
        flat = self.skin[cells].all(axis=1) & (new > -_FLAT * self.pitch[node] ** 3)
        return bool((flat | (new > _LEFT * old)).all())

    def _put(self, node: int, place, seen: np.ndarray, ways: np.ndarray) -> None:
        count = len(seen)
        self.parts[int(node)] = Sides(np.full(count, node), np.zeros(count, int), seen - place)
        self.points[node], self.ridge[node] = place, True
        self.seen[node] = seen[[0, 1, -1]]
        self.normal[node] = ways[[0, 1, -1]]

    def sides(self) -> Sides:
        """The sides of all nodes on ridges."""
        return joined(*self.parts.values()) if self.parts else no_sides()


# Sharp edges and corners of a solid in its tetrahedra


_TURNS = 2  # rounds of splitting
_THIN = np.cos(np.deg2rad(12.0))  # poorest dihedral angle that a split may make


class Features(NamedTuple):
    """The nodes on ridges.

    Attributes:
        sides: The two sides of every ridge node, three or more of every corner.
        ridge: (nodes,) whether a node lies on a ridge.
        corner: (nodes,) whether it is a corner and may not move.
        before: (nodes, 3) where the nodes were before they were put on ridges [m].
    """

    sides: Sides
    ridge: np.ndarray
    corner: np.ndarray
    before: np.ndarray

    def without(self, nodes: np.ndarray) -> "Features":
        """The same with `nodes` no longer on ridges."""
        ridge, corner = self.ridge.copy(), self.corner.copy()
        ridge[nodes], corner[nodes] = False, False
        keep = ridge[self.sides.point]
        return Features(Sides(*(part[keep] for part in self.sides)), ridge, corner, self.before)


def sharpen(shape: AbstractSdf, points, cells, skin, size: Sizes):
    """`(points, cells, skin, features)` without surface edges that cut a ridge off: a node
    is moved where its cells allow it, else the edge is split."""
    before = points
    for turn in range(_TURNS + 1):
        found = Snapper(shape, points, cells, size)
        found.snap_touching()
        found.snap_corners()
        found.snap_ridges()
        edges, places = found.left() if turn < _TURNS else ([], [])
        points, cells = split_edges(found.points, cells, edges, places)
        if len(points) == len(skin):
            features = Features(found.sides(), found.ridge, found.corner, before)
            return points, cells, skin, features
        fresh = points[len(skin) :]
        skin = np.concatenate([skin, np.ones(len(fresh), bool)])
        before = np.concatenate([before, fresh])
    raise AssertionError("unreachable")


def split_edges(points, cells, edges, places) -> tuple[np.ndarray, np.ndarray]:
    """A new node at `places` on each edge; every cell of the edge becomes two."""
    around = Around(cells, len(points))
    taken = np.zeros(len(cells), bool)
    halves, fresh = [], []
    for (a, b), place in zip(edges, places, strict=True):
        rows = np.intersect1d(around.rows_of(a), around.rows_of(b))
        x = points[cells[rows]]
        parts = [np.where((cells[rows] == old)[..., None], place, x) for old in (a, b)]
        if taken[rows].any() or badness(np.concatenate(parts)).max() > _THIN:
            continue  # its turn comes in the next round, or the ridge is cut off there
        taken[rows] = True
        node = len(points) + len(fresh)
        fresh.append(place)
        for old in (a, b):
            halves.append(np.where(cells[rows] == old, node, cells[rows]))
    cells = np.concatenate([cells[~taken], *halves])
    return np.concatenate([points, np.reshape(fresh, (-1, 3))]), cells
