"""Facets in contact: their areas, their size, the law that suits them, and their order."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._jax.trace_state import is_traced
from sorojax.fem.facets import facet_tables, normals
from sorojax.material.hyperelastic import small_strain_moduli
from sorojax.mesh.elements import facet_corners

_TOGETHER = 32  # facets that the broad phase judges by one ball


def areas_of(problem, facets: Int[Array, "facets facet_nodes"]) -> Float[Array, "facets quad"]:
    """Reference areas of the quadrature points of facets [m^2]."""
    tables, kinematics = facet_tables(problem.mesh.element), problem.kinematics
    weights, values = jnp.asarray(tables.weights), jnp.asarray(tables.values)

    def one(X):
        size = jnp.sqrt(jnp.sum(normals(tables, X) ** 2, axis=1))
        return weights * size * kinematics.depth(tuple((values @ X).T))

    return jax.vmap(one)(problem.mesh.points[facets])


def default_law(mesh, material, facets, stiffness, smoothing) -> tuple[Array, Array]:
    """Stiffness [Pa/m] and smoothing [m], where they are not given, from the size of the
    facets and the softest cells at their nodes."""
    shear, bulk = small_strain_moduli(material)
    young = jnp.broadcast_to(9 * bulk * shear / (3 * bulk + shear), (mesh.num_cells,))
    of_nodes = jnp.full(mesh.num_nodes, jnp.inf, young.dtype)
    young = jnp.mean(of_nodes.at[mesh.cells].min(young[:, None])[facets])
    stiffness = 10 * young / mean_size(mesh, facets) if stiffness is None else stiffness
    return stiffness, 1e-3 * young / stiffness if smoothing is None else smoothing


def mean_size(mesh, facets) -> Float[Array, ""]:
    """Mean length of the first sides of facets [m]."""
    corners = mesh.points[facets[:, : facet_corners(mesh.element)]]
    return jnp.mean(jnp.sqrt(jnp.sum((corners[:, 1] - corners[:, 0]) ** 2, axis=1)))


def compact(mesh, facets) -> Int[np.ndarray, "facets facet_nodes"] | Array:
    """The facets in an order that keeps neighbours together, by halving the longest side."""
    if is_traced((mesh.points, facets)):
        return facets
    facets = np.asarray(facets)
    centres = np.asarray(mesh.points)[facets].mean(axis=1)

    def halved(ids):
        if len(ids) <= _TOGETHER:
            return [ids]
        axis = np.argmax(np.ptp(centres[ids], axis=0))
        ids = ids[np.argsort(centres[ids, axis], kind="stable")]
        middle = -(-len(ids) // (2 * _TOGETHER)) * _TOGETHER
        return halved(ids[:middle]) + halved(ids[middle:])

    return facets[np.concatenate(halved(np.arange(len(facets))))]
