"""Ten-node tetrahedra on a shape, and the named sets of a solid mesh."""

import numpy as np

from sorojax.mesh.elements import Tet4, Tet10
from sorojax.mesh.interfaces import Parts
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.middles import with_side_nodes
from sorojax.mesh.settle import ZOOMS, Sides, settle
from sorojax.mesh.shape import nodes as reference_nodes, quadrature, shape_gradients
from sorojax.mesh.surface_sides import surface_sides
from sorojax.mesh.tet_shape import signed_volumes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import land

_SIDES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))  # of the mid-side nodes
_LEAST = 0.1  # least det dx/dxi over that of the straight cell


def solid_mesh(fields: tuple[AbstractSdf, ...], parts: Parts, order: int) -> Mesh:
    """The finished mesh with its boundary, ridges, corners and interfaces as sets."""
    features = parts.features
    ridge = np.zeros(len(parts.points), bool)
    on_body = features.sides.point[features.sides.field == 0]
    ridge[on_body[np.bincount(on_body, minlength=len(ridge))[on_body] > 1]] = True
    corner = features.corner
    nodes = {"corners": np.flatnonzero(corner), "ridges": np.flatnonzero(ridge & ~corner)}
    facets = [parts.facets(i) for i in range(len(fields))]
    points, cells, element = parts.points, parts.cells, Tet4()
    if order == 2:
        points, cells, facets, rim = _curved(fields, parts, facets, ridge | corner)
        nodes["ridges"] = np.union1d(nodes["ridges"], rim)
        element = Tet10()
    facets[0] = boundary_facets(Mesh(points, cells, element))
    sets = {"boundary": facets[0]}
    for i, own in enumerate(facets[1:]):
        sets[f"interface_{i}"] = own
        nodes[f"interface_{i}"] = np.unique(own)
    regions = {f"inside_{i}": np.flatnonzero(own) for i, own in enumerate(parts.within.T)}
    return Mesh(points, cells, element, nodes, sets, regions)


def _curved(fields, parts: Parts, facets, ridge):
    """Ten-node cells; mid-sides of the surfaces on them where all their cells stay valid."""
    straight, ten = with_side_nodes(parts.points, parts.cells, Tet10())
    n = len(parts.points)
    six = [_with_middles(own, ten, n, len(straight)) for own in facets]
    x = straight.copy()
    for field, own in zip(fields[::-1], six[::-1], strict=True):
        surface = np.unique(own[:, 3:])
        x[surface] = land(field, straight[surface])
    every, owner = np.concatenate(six), np.repeat(np.arange(len(six)), list(map(len, six)))
    rim, sides, on_ridge = _rims(straight, every, owner, ridge)
    if len(rim):
        x[rim] = settle(fields, straight[rim], sides, (1.0, *ZOOMS))
    for _ in range(20):
        folded = np.unique(ten[_least_jacobian(x[ten]) < _LEAST, 4:])
        if not len(folded):
            break
        x[folded] = straight[folded]
    return x, ten, six, rim[on_ridge]


def _with_middles(faces, ten, n: int, count: int) -> np.ndarray:
    """Triangles of corner nodes with the mid-side nodes of their sides."""
    sides = np.concatenate([ten[:, [a, b, 4 + k]] for k, (a, b) in enumerate(_SIDES)])
    keys = sides[:, :2].min(axis=1) * np.int64(count) + sides[:, :2].max(axis=1)
    order = np.argsort(keys)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)])
    wanted = ends.min(axis=0) * np.int64(count) + ends.max(axis=0)
    middles = sides[order, 2][np.searchsorted(keys[order], wanted)]
    return np.concatenate([faces, middles.reshape(-1, 3)], axis=1)


def _rims(x, facets, owner, ridge) -> tuple[np.ndarray, Sides, np.ndarray]:
    """Mid-side nodes of the sharp edges, the facets beside each as its sides, and which of
    the nodes lie on ridges of the body."""
    known = np.concatenate([ridge, np.zeros(len(x) - len(ridge), bool)])
    faces = facets[:, :3]
    found = surface_sides(x, faces, owner, known)
    row, corner = np.nonzero(found.sharp[found.number])
    node = facets[row, 3 + corner]
    rim, place = np.unique(node, return_inverse=True)
    along = x[faces[row]].mean(axis=1) - x[node]
    only_body = np.bincount(place, owner[row], len(rim)) == 0
    return rim, Sides(place, owner[row], along), only_body


def _least_jacobian(x: np.ndarray) -> np.ndarray:
    """Least det dx/dxi at the nodes and inside, over that of the straight cell."""
    at = np.concatenate([reference_nodes(Tet10()), quadrature(Tet10(), 5).points])
    straight = 6 * signed_volumes(x[:, :4])
    least = np.full(len(x), np.inf)
    for slopes in shape_gradients(Tet10(), at):
        least = np.minimum(least, np.linalg.det(np.einsum("cai,ad->cid", x, slopes)))
    return least / straight
