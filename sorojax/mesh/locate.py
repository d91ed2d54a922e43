"""Where points lie in a mesh, and what nodal fields are there."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._jax.trace_state import is_traced
from sorojax.math.spatial import KDTree
from sorojax.mesh.elements import Hex8, PolyN, Quad4, Quad8, Quad9
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.shape import nodes, shape_functions, shape_gradients


class Locations(NamedTuple):
    """Nodes of the cells that hold the points, and the weights of these nodes."""

    nodes: Int[Array, "points cell_nodes"]
    weights: Float[Array, "points cell_nodes"]

    def __call__(self, nodal: Float[Array, "nodes dim"]) -> Float[Array, "points dim"]:
        """Values of a nodal field at the points; differentiable in the field."""
        return jnp.einsum("pa,pai->pi", self.weights, nodal[self.nodes])


def locate(mesh: Mesh, points: Float[np.ndarray, "points dim"]) -> Locations:
    """The cells that hold `points` [m] of the reference configuration (on the host).

    Raises:
        ValueError: If a point lies outside the mesh, the mesh is traced or its cells are
            polygons.
    """
    if isinstance(mesh.element, PolyN):
        raise ValueError("locate: got polygons, need triangles, quadrilaterals or solid cells.")
    if is_traced(mesh):
        raise ValueError("locate: the mesh is traced, need concrete points. Call it outside.")
    points = np.atleast_2d(np.asarray(points, float))
    _check.finite("locate", "points", points, "Give points in metres.")
    _check.shape("locate", "points", points, (None, mesh.element.dim), "One row per point.")
    if not len(points):
        raise ValueError("locate: got no point, need one or more. Give one row per point.")
    X, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    centres = X[cells[:, : mesh.element.num_corners]].mean(axis=1)
    near = KDTree(centres).query(points, k=min(24, len(cells)))[1].reshape(len(points), -1)
    xi = _reference_coordinates(mesh, X[cells[near]], points)
    inside = _depth(mesh, xi)
    best = np.argmax(inside, axis=1)
    rows = np.arange(len(points))
    if (outside := np.flatnonzero(inside[rows, best] < -1e-6)).size:
        raise ValueError(
            f"locate: {outside.size} of {len(points)} points lie outside the mesh, the first "
            f"at {points[outside[0]]} m. Move the curve into the body."
        )
    weights = shape_functions(mesh.element, xi[rows, best])
    return Locations(jnp.asarray(cells[near[rows, best]]), jnp.asarray(weights))


def _depth(mesh: Mesh, xi: np.ndarray) -> np.ndarray:
    """How far reference points lie inside the cell; negative outside."""
    if isinstance(mesh.element, Quad4 | Quad8 | Quad9 | Hex8):
        return 1 - np.abs(xi).max(axis=-1)
    return np.minimum(xi.min(axis=-1), 1 - xi.sum(axis=-1))


def _reference_coordinates(mesh: Mesh, corners, points, iterations: int = 4):
    """Newton's method for X(xi) = point in every candidate cell."""
    dim = mesh.element.dim
    centre = nodes(mesh.element)[: mesh.element.num_corners].mean(axis=0)
    xi = np.broadcast_to(centre, (*corners.shape[:2], dim)).copy()
    for _ in range(iterations):
        flat = xi.reshape(-1, dim)
        N = shape_functions(mesh.element, flat).reshape(*xi.shape[:2], -1)
        dN = shape_gradients(mesh.element, flat).reshape(*xi.shape[:2], -1, dim)
        gap = points[:, None] - np.einsum("pca,pcai->pci", N, corners)
        jac = np.einsum("pcad,pcai->pcid", dN, corners)
        xi = np.clip(xi + np.linalg.solve(jac, gap[..., None])[..., 0], -2, 3)
    return xi
