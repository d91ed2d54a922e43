"""What `move` needs to know about the surface of a solid mesh, worked out on the host."""

import numpy as np

from sorojax.mesh.boundary_motion import BoundaryPlan, FieldPlan
from sorojax.mesh.elements import facet_corners
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.outline_plan import Border, facet_groups
from sorojax.mesh.surface_sides import Sides, facet_normals, surface_sides, unit

_STRAIGHT = 1e-9  # of a side: a mid-side node nearer than that to its middle
_FLAT = 0.06  # least eigenvalue of the sum of n n' at a corner; below it is a ridge


def plan_surface(mesh: Mesh, num_interfaces: int) -> Border:
    """The plan of a solid mesh: smooth nodes, ridge nodes and corners of its surface."""
    points = np.asarray(mesh.points)
    groups = facet_groups(mesh, num_interfaces)
    count = facet_corners(mesh.element)
    facets = np.concatenate(groups)
    owner = np.repeat(np.arange(len(groups)), [len(g) for g in groups])
    faces, middles = facets[:, :count], facets[:, count:]
    known = _marked(mesh)
    sides = surface_sides(points, faces, owner, known)
    allowed = _most_sides(mesh, faces, owner, known)
    corners, ridge, tangent, chamfers = _sharp_nodes(points, faces, sides, allowed)
    bent = _curved(points, faces, middles)
    on_ridge = bent & sides.sharp[sides.number]
    if bent.any():
        ends = points[np.roll(faces, -1, axis=1)] - points[faces]
        tangent[middles[on_ridge]] = unit(ends[on_ridge])
        ridge = np.concatenate([ridge, np.unique(middles[on_ridge])])
    sharp = np.concatenate([corners, ridge]).astype(int)
    place = np.full(len(points), -1)
    place[sharp] = np.arange(len(sharp))
    taken, fields = place >= 0, []
    for i in range(len(groups)):
        own = owner == i
        patch = np.where(np.isin(sides.patch[own], chamfers), -1, sides.patch[own])
        rows = (faces[own], middles[own], bent[own], patch)
        fields.append(_plan_field(points, *rows, place, taken))
        taken[np.asarray(fields[-1].nodes)] = True
    where = np.arange(len(corners), len(sharp))
    plan = BoundaryPlan(sharp, where, tangent[sharp[where]], tuple(fields))
    return Border(plan, corners, sides.ends[sides.sharp], faces)


def _marked(mesh: Mesh) -> np.ndarray | None:
    """Whether nodes are known to lie on ridges; `None` if the mesh does not say."""
    if "ridges" not in mesh.node_sets:
        return None
    known = np.zeros(mesh.num_nodes, bool)
    for name in ("ridges", "corners"):
        known[np.asarray(mesh.node_sets.get(name, []), int)] = True
    return known


def _most_sides(mesh: Mesh, faces, owner, known: np.ndarray | None) -> np.ndarray:
    """How many sides a node may have: two on a ridge, any number at corners and where surfaces
    meet, else one. Where facets cut an edge off they turn sharply beside nodes of one side."""
    most = np.full(mesh.num_nodes, mesh.num_nodes)
    if known is None:
        return most
    count = np.zeros(mesh.num_nodes, int)
    for i in np.unique(owner):
        count[np.unique(faces[owner == i])] += 1
    single = count < 2
    single[np.asarray(mesh.node_sets.get("corners", []), int)] = False
    most[single] = np.where(known, 2, 1)[single]
    return most


def _sharp_nodes(points, faces, sides: Sides, allowed: np.ndarray):
    """Corners, ridge nodes, the direction in which sharp nodes see no side, and the patches
    that are none of the `allowed` number of sides of their node."""
    n = len(points)
    patches, first, number = np.unique(
        sides.patch.ravel(), return_index=True, return_inverse=True
    )
    total = np.zeros((len(patches), 3))
    np.add.at(total, number.ravel(), np.repeat(facet_normals(points, faces), faces.shape[1], 0))
    owner, normal = faces.ravel()[first], unit(total)
    sharp = np.zeros(n, bool)
    sharp[sides.ends[sides.sharp]] = True
    count = np.bincount(owner, minlength=n)
    sharp &= (count > 1) & (allowed > 1)
    chamfer = np.zeros(len(patches), bool)
    for node in np.flatnonzero(sharp & (allowed == 2) & (count > 2)):
        mine = np.flatnonzero(owner == node)
        cosine = normal[mine] @ normal[mine].T
        chamfer[np.delete(mine, np.unravel_index(cosine.argmin(), cosine.shape))] = True
    matrix = np.zeros((n, 3, 3))
    np.add.at(matrix, owner, (normal * ~chamfer[:, None])[:, :, None] * normal[:, None, :])
    nodes = np.flatnonzero(sharp)
    strength, ways = np.linalg.eigh(matrix[nodes])
    tangent = np.zeros_like(points)
    tangent[nodes] = ways[:, :, 0]
    ridge = strength[:, 0] < _FLAT
    return nodes[~ridge], nodes[ridge], tangent, patches[chamfer]


def _curved(points, faces, middles) -> np.ndarray:
    """Whether the mid-side node of each side of a facet lies off its middle."""
    if not middles.shape[1]:
        return np.zeros(faces.shape, bool)
    a, b = points[faces], points[np.roll(faces, -1, axis=1)]
    gap = np.linalg.norm(points[middles[:, : faces.shape[1]]] - (a + b) / 2, axis=2)
    return gap > _STRAIGHT * np.linalg.norm(b - a, axis=2)


def _plan_field(points, faces, middles, bent, patch, place, taken) -> FieldPlan:
    normals, centres = facet_normals(points, faces), points[faces].mean(axis=1)
    total, own = np.zeros_like(points), np.zeros(len(points), bool)
    for column in faces.T:
        np.add.at(total, column, normals)
    own[faces] = True
    rows, columns = np.nonzero(bent)
    if len(rows):
        nodes = middles[rows, columns]
        np.add.at(total, nodes, normals[rows])
        own[nodes] = True
        held = place[nodes] >= 0
        rows, nodes = rows[held], nodes[held]
    else:
        nodes = np.zeros(0, int)
    smooth = np.flatnonzero(own & ~taken)
    row, corner = np.nonzero((place[faces] >= 0) & (patch >= 0))
    # One side per patch around a sharp node, seen towards the middle of its facets.
    which, first, number = np.unique(patch[row, corner], return_index=True, return_inverse=True)
    here = faces[row, corner]
    # Smooth nodes of the patch lie on it for certain; the far side of a facet is next best.
    smooth_ones = place[faces[row]] < 0
    weight = 1e-3 + smooth_ones.sum(axis=1)
    gaps = points[faces[row]] - points[here][:, None]
    towards = (gaps * (smooth_ones[..., None] + 5e-4)).sum(axis=1)
    along = np.zeros((len(which), 3))
    np.add.at(along, number, towards)
    along /= np.bincount(number, weight, len(which))[:, None]
    return FieldPlan(
        nodes=smooth,
        normal=unit(total[smooth]),
        beside=place[np.concatenate([here[first], nodes])],
        along=np.concatenate([along, centres[rows] - points[nodes]]),
    )
