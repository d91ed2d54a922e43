"""Zero sets of further shapes inside a solid mesh: nodes put on them, cells cut by them."""

from typing import NamedTuple

import numpy as np

from sorojax.mesh.motion.boundary import SETTLE_ZOOMS as ZOOMS, Sides, joined, settle
from sorojax.mesh.motion.plan import Sides as SurfaceSides, surface_sides
from sorojax.mesh.solid.lattice import (
    FACES,
    badness,
    inside_parts,
    signed_volumes,
    unique_edges,
)
from sorojax.mesh.solid.ridges import Around, Features, boundary_triangles
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import normals, values, values_and_gradients

_NEAR = 0.35  # of the shortest edge beside a node: nodes that near are put on the set
_DEEP = 0.1  # of an edge: what goes less deep through a layer is a bend, not a layer
_OPPOSED = -0.7  # cosine between the slopes on both sides of a layer
_THIN = np.cos(np.deg2rad(9.0))  # poorest dihedral angle that this may make


class Parts(NamedTuple):
    """A solid mesh that is cut into parts.

    Attributes:
        points: (nodes, 3) [m].
        cells: (cells, 4).
        owner: (nodes,) zero set that a smooth node lies on, -1 inside.
        features: Nodes on several sides: those of ridges and where sets cross.
        within: (cells, sets) whether a cell lies inside each further shape.
    """

    points: np.ndarray
    cells: np.ndarray
    owner: np.ndarray
    features: Features
    within: np.ndarray

    def facets(self, number: int) -> np.ndarray:
        """Triangles of zero set `number`; 0 is the boundary, the others seen from outside."""
        if number == 0:
            return boundary_triangles(self.cells)
        faces = np.concatenate([self.cells[:, list(f)] for f in FACES])
        keys = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)[1].ravel()
        flag = np.tile(self.within[:, number - 1], 4)
        inner, outer = np.zeros(keys.max() + 1, bool), np.zeros(keys.max() + 1, bool)
        inner[keys[flag]], outer[keys[~flag]] = True, True
        return faces[flag & (inner & outer)[keys]]

    def all_facets(self) -> tuple[np.ndarray, np.ndarray]:
        """Triangles of all sets and which one each belongs to."""
        groups = [self.facets(i) for i in range(1 + self.within.shape[1])]
        return np.concatenate(groups), np.repeat(np.arange(len(groups)), list(map(len, groups)))


def insert(fields: tuple[AbstractSdf, ...], parts: Parts) -> Parts:
    """`parts` with the zero set of the last of `fields` among its facets."""
    field = fields[-1]
    g = values(field, parts.points)
    if not (np.any(g[parts.cells] < 0) and np.any(g[parts.cells] > 0)):
        raise ValueError(
            f"tetrahedralise: interface {len(fields) - 2} does not pass through the shape. "
            "Check its position, lower `size` to its thickness or less, or leave it out."
        )
    parts, g = _snapped(fields, parts, g)
    _check_seen(fields, parts, g)
    return _cut(fields, parts, g)


def _check_seen(fields, parts: Parts, g: np.ndarray) -> None:
    """Raise where a layer between two sides of the last field passes between nodes."""
    edges = unique_edges(parts.cells, len(parts.points))
    a, b = parts.points[edges[:, 0]], parts.points[edges[:, 1]]
    length = np.linalg.norm(b - a, axis=1)
    ends = g[edges]
    reach = float(fields[-1].lipschitz) * length
    one_side = (ends.min(axis=1) >= 0) | (ends.max(axis=1) <= 0)
    one_side &= (ends != 0).any(axis=1) & (np.abs(ends).sum(axis=1) < reach)
    rows = np.flatnonzero(one_side)
    share = np.arange(1, 8)[:, None] / 8
    inner = a[rows, None] + share * (b - a)[rows, None]
    f = values(fields[-1], inner.reshape(-1, 3)).reshape(len(rows), -1)
    depth = -(f * np.sign(ends[rows].sum(axis=1))[:, None]).min(axis=1, initial=np.inf)
    thin = depth > _DEEP * length[rows]
    rows, depth = rows[thin], depth[thin]
    faces = [normals(fields[-1], x[rows]) for x in (a, b)]
    opposed = np.flatnonzero((faces[0] * faces[1]).sum(axis=1) < _OPPOSED)
    if len(opposed):
        worst = opposed[depth[opposed].argmax()]
        where = np.round((a + b)[rows[worst]] / 2, 6)
        raise ValueError(
            f"tetrahedralise: a layer of interface {len(fields) - 2} about "
            f"{2 * depth[worst]:.2g} m thick near {where} m passes between nodes, need "
            "nodes within. Lower `size` to that or less, or thicken the layer."
        )


def _snapped(fields, parts: Parts, g: np.ndarray) -> tuple[Parts, np.ndarray]:
    """Nodes close to the last field moved onto it where their cells allow it."""
    points, cells, owner, features, _ = parts
    last = len(fields) - 1
    edges = unique_edges(cells, len(points))
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    shortest = np.full(len(points), np.inf)
    for end in edges.T:
        np.minimum.at(shortest, end, length)
    slope = np.linalg.norm(values_and_gradients(fields[-1], points)[1], axis=1)
    gap = np.abs(g) / np.maximum(slope, 1e-9)
    g = np.where(gap < 1e-9 * shortest, 0.0, g)
    near = np.flatnonzero((gap < _NEAR * shortest) & ~features.corner)
    sides = _sides_of(owner, features, near)
    fresh = np.arange(len(near))
    own = Sides(fresh, np.full(len(near), last), np.zeros((len(near), 3)))
    places = settle(fields, points[near], joined(sides, own), (1.0, *ZOOMS))
    off = np.abs(values(fields[-1], places))
    far = np.linalg.norm(places - points[near], axis=1)
    good = (far < 2 * _NEAR * shortest[near]) & (off < 1e-6 * shortest[near])
    points, around, taken = points.copy(), Around(cells, len(points)), []
    for k in np.argsort(far, kind="stable"):
        if not good[k]:
            continue
        ball = around(int(near[k]))
        x = np.where((ball == near[k])[..., None], places[k], points[ball])
        if badness(x).max() < max(_THIN, badness(points[ball]).max() + 1e-9):
            points[near[k]] = places[k]
            taken.append(k)
    taken = np.array(taken, int)
    g[near[taken]] = 0.0
    count = np.bincount(sides.point, minlength=len(near))
    owner, features = _joined(owner, features, near, sides, own, taken, count, points)
    return parts._replace(points=points, owner=owner, features=features), g


def _sides_of(owner, features: Features, nodes: np.ndarray) -> Sides:
    """The sides that `nodes` lie on, numbered by their place in it."""
    known = features.sides.of(nodes, len(owner))
    smooth = np.flatnonzero((owner[nodes] >= 0) & ~features.ridge[nodes])
    plain = Sides(smooth, owner[nodes[smooth]], np.zeros((len(smooth), 3)))
    return joined(known, plain)


def _joined(owner, features: Features, near, sides: Sides, own: Sides, taken, count, points):
    """Owners and features after the nodes `near[taken]` got one side more."""
    owner, ridge, corner = owner.copy(), features.ridge.copy(), features.corner.copy()
    moved = np.zeros(len(near), bool)
    moved[taken] = True
    owner[near[moved & (count == 0)]] = own.field[0] if len(own.field) else 0
    ridge[near[moved & (count > 0)]] = True
    corner[near[moved & (count > 1)]] = True
    several = moved & (count > 0)
    rows, fresh = several[sides.point], several[own.point]
    old = ~np.isin(features.sides.point, near[several])
    new = [
        Sides(near[part.point[keep]], part.field[keep], part.along[keep])
        for part, keep in ((sides, rows), (own, fresh))
    ]
    kept = Sides(*(part[old] for part in features.sides))
    return owner, Features(joined(kept, *new), ridge, corner, points)


def _cut(fields, parts: Parts, g: np.ndarray) -> Parts:
    """Cells with corners on both sides of the last field cut along it."""
    points, cells, owner, features, within = parts
    sign, base = np.sign(g).astype(int), len(points)
    both = (sign[cells] < 0).any(axis=1) & (sign[cells] > 0).any(axis=1)
    edges = unique_edges(cells[both], base) if both.any() else np.zeros((0, 2), int)
    edges = edges[sign[edges[:, 0]] * sign[edges[:, 1]] < 0]
    places, sides = _crossings(fields, parts, edges, g)
    keys = edges[:, 0] * np.int64(base) + edges[:, 1]

    def middle(p, q):
        key = np.minimum(p, q) * np.int64(base) + np.maximum(p, q)
        return base + np.searchsorted(keys, key)

    halves, parents, inner = [cells[~both]], [np.flatnonzero(~both)], []
    whole = sign[cells[~both]].sum(axis=1) < 0
    level = ~sign[cells[~both]].any(axis=1)
    if level.any():
        whole[level] = values(fields[-1], points[cells[~both][level]].mean(axis=1)) < 0
    inner.append(whole)
    rows = np.flatnonzero(both)
    for side in (1, -1):
        pieces, cut = inside_parts(cells[rows], side * sign, middle)
        halves.append(pieces)
        parents.append(rows[cut])
        inner.append(np.full(len(pieces), side == 1))
    cells, parent = np.concatenate(halves), np.concatenate(parents)
    points = np.concatenate([points, places])
    turned = signed_volumes(points[cells]) < 0
    cells = np.where(turned[:, None], cells[:, [0, 1, 3, 2]], cells)
    within = np.concatenate([within[parent], np.concatenate(inner)[:, None]], axis=1)
    return Parts(points, cells, *_extended(owner, features, sides, points), within)


def _crossings(fields, parts: Parts, edges, g) -> tuple[np.ndarray, Sides]:
    """Where the last field cuts `edges`, on all sides that each edge lies on."""
    points, last = parts.points, len(fields) - 1
    a, b = edges.T
    share = g[a] / (g[a] - g[b])
    start = points[a] + share[:, None] * (points[b] - points[a])
    faces, group = parts.all_facets()
    known = parts.features.ridge
    found = surface_sides(points, faces, group, known)
    sides = joined(
        _edge_sides(points, faces, group, found, edges, start),
        Sides(np.arange(len(edges)), np.full(len(edges), last), np.zeros((len(edges), 3))),
    )
    return settle(fields, start, sides, (1.0, *ZOOMS)), sides


def _edge_sides(points, faces, group, found: SurfaceSides, edges, start) -> Sides:
    """Sides of the zero sets that `edges` lie on: one of a smooth set, two at a ridge."""
    n = np.int64(len(points))
    keys = found.ends[:, 0] * n + found.ends[:, 1]
    place = np.minimum(np.searchsorted(keys, edges[:, 0] * n + edges[:, 1]), len(keys) - 1)
    hit = keys[place] == edges[:, 0] * n + edges[:, 1]
    row = np.full(len(keys), -1)
    row[place[hit]] = np.flatnonzero(hit)
    face, corner = np.nonzero(row[found.number] >= 0)
    side = found.number[face, corner]
    sharp = found.sharp[side]
    along = points[faces[face]].mean(axis=1) - start[row[side]]
    along = np.where(sharp[:, None], along, 0.0)
    # Of the two facets of a smooth side one is enough, of an interface likewise.
    several = np.where(sharp & (group[face] == 0), face, -1 - group[face])
    _, first = np.unique(np.stack([row[side], several]), axis=1, return_index=True)
    return Sides(row[side][first], group[face][first], along[first])


def _extended(owner, features: Features, sides: Sides, points):
    """Owners and features with the nodes that `sides` tell of at the end."""
    base, fresh = len(owner), len(points) - len(owner)
    count = np.bincount(sides.point, minlength=fresh)
    first = np.full(fresh, -1)
    first[sides.point[::-1]] = sides.field[::-1]
    owner = np.concatenate([owner, first])
    several = count[sides.point] > 1
    new = Sides(base + sides.point[several], sides.field[several], sides.along[several])
    ridge = np.concatenate([features.ridge, count > 1])
    corner = np.concatenate([features.corner, count > 2])
    return owner, Features(joined(features.sides, new), ridge, corner, points)


def whole(points, cells, skin, features: Features) -> Parts:
    """A mesh without further shapes."""
    within = np.zeros((len(cells), 0), bool)
    return Parts(points, cells, np.where(skin, 0, -1), features, within)
