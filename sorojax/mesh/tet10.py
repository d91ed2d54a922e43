"""Ten-node tetrahedra on a shape, and the named sets of a solid mesh."""

import numpy as np

from sorojax.mesh.elements import Tet10
from sorojax.mesh.features import Features
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.middles import with_side_nodes
from sorojax.mesh.settle import ZOOMS, Sides, settle
from sorojax.mesh.shape import nodes as reference_nodes, quadrature, shape_gradients
from sorojax.mesh.surface_sides import surface_sides
from sorojax.mesh.tet_shape import signed_volumes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import land

_LEAST = 0.1  # least det dx/dxi over that of the straight cell


def named(mesh: Mesh, features: Features) -> Mesh:
    """`mesh` with its boundary, ridges and corners as sets."""
    ridge = features.ridge & ~features.corner
    nodes = {"corners": np.flatnonzero(features.corner), "ridges": np.flatnonzero(ridge)}
    sets = {"boundary": boundary_facets(mesh)}
    return Mesh(mesh.points, mesh.cells, mesh.element, nodes, sets)


def curved(shape: AbstractSdf, points, cells, features: Features) -> Mesh:
    """Ten-node cells; mid-sides of the surface on it where all their cells stay valid."""
    straight, ten = with_side_nodes(points, cells, Tet10())
    n = len(points)
    facets = boundary_facets(Mesh(straight, ten, Tet10()))
    surface = np.unique(facets[:, 3:])
    x = straight.copy()
    x[surface] = land(shape, straight[surface])
    rim, sides = _rims(straight, facets, features.ridge)
    if len(rim):
        x[rim] = settle((shape,), straight[rim], sides, (1.0, *ZOOMS))
    for _ in range(20):
        folded = np.unique(ten[_least_jacobian(x[ten]) < _LEAST, 4:])
        if not len(folded):
            break
        x[folded] = straight[folded]
    bent = np.zeros(len(x) - n, bool)
    on_ridge = bent.copy()
    on_ridge[rim - n] = True
    own = Features(
        features.sides,
        np.concatenate([features.ridge, on_ridge]),
        np.concatenate([features.corner, bent]),
        x,
    )
    return named(Mesh(x, ten, Tet10()), own)


def _rims(x, facets, ridge) -> tuple[np.ndarray, Sides]:
    """Mid-side nodes of the sharp edges, and the two facets beside each as its sides."""
    known = np.concatenate([ridge, np.zeros(len(x) - len(ridge), bool)])
    faces = facets[:, :3]
    found = surface_sides(x, faces, np.zeros(len(faces), int), known)
    row, corner = np.nonzero(found.sharp[found.number])
    node = facets[row, 3 + corner]
    rim, place = np.unique(node, return_inverse=True)
    along = x[faces[row]].mean(axis=1) - x[node]
    return rim, Sides(place, np.zeros(len(place), int), along)


def _least_jacobian(x: np.ndarray) -> np.ndarray:
    """Least det dx/dxi at the nodes and inside, over that of the straight cell."""
    at = np.concatenate([reference_nodes(Tet10()), quadrature(Tet10(), 5).points])
    straight = 6 * signed_volumes(x[:, :4])
    least = np.full(len(x), np.inf)
    for slopes in shape_gradients(Tet10(), at):
        least = np.minimum(least, np.linalg.det(np.einsum("cai,ad->cid", x, slopes)))
    return least / straight
