"""Nodes, cells and facets of a mesh chosen by place; all results are host arrays."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import values

Predicate = Callable[[Any], Any]
Nodes = Int[np.ndarray, " nodes"]
Cells = Int[np.ndarray, " cells"]
Facets = Int[np.ndarray, "facets facet_nodes"]


def nodes_where(mesh: Mesh, predicate: Predicate) -> Nodes:
    """Nodes whose point satisfies `predicate(p)`, as in `lambda p: p[0] <= 0`.

    A node that should lie at 0 may lie at 1e-18: compare with a tolerance where the
    place is the result of a computation.
    """
    return np.flatnonzero(_holds(mesh.points, predicate))


def cells_where(mesh: Mesh, predicate: Predicate) -> Cells:
    """Cells whose centroid (mean of the corners) satisfies `predicate(p)`."""
    corners = mesh.cells[:, : mesh.element.num_corners]
    return np.flatnonzero(_holds(jnp.mean(mesh.points[corners], axis=1), predicate))


def facets_where(mesh: Mesh, predicate: Predicate) -> Facets:
    """Boundary facets, as node numbers, whose midpoint satisfies `predicate(p)`."""
    facets = boundary_facets(mesh)
    return facets[_holds(_middles(mesh, facets), predicate)]


def facets_on(mesh: Mesh, shape: AbstractSdf, tol: float | None = None) -> Facets:
    """Boundary facets, as node numbers, that lie on the zero set of `shape`.

    Args:
        mesh: A mesh; the outline of `shape` should be part of its boundary.
        shape: For example the chambers that were cut out of the body.
        tol: Largest distance of a node from the zero set [m]; 1e-6 of the extent of
            the mesh when omitted.
    """
    points = np.asarray(mesh.points)
    if tol is None:
        tol = 1e-6 * float(np.ptp(points, axis=0).max())
    facets = boundary_facets(mesh)
    near = np.abs(values(shape, points)) <= tol
    ends = points[facets[:, :2]]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    # Both ends of a chord between two curves lie on them, its middle does not; the
    # middle of a straight side on a fillet is off by less than a tenth of its length.
    off = np.abs(values(shape, ends.mean(axis=1)))
    return facets[near[facets].all(axis=1) & (off <= 0.15 * length + tol)]


def nearest_node(mesh: Mesh, point: Any) -> int:
    """The node closest to `point` [m]."""
    gap = np.asarray(mesh.points) - np.asarray(point, dtype=float)
    return int(np.argmin((gap**2).sum(axis=1)))


def _middles(mesh: Mesh, facets: np.ndarray) -> jax.Array:
    return jnp.mean(mesh.points[facets[:, :2]], axis=1)


def _holds(points: jax.Array, predicate: Predicate) -> np.ndarray:
    if not len(points):
        return np.zeros(0, bool)
    return np.asarray(jax.vmap(lambda p: jnp.asarray(predicate(p), dtype=bool))(points))
