"""Integrals over facets: the sides of plane cells, the faces of solid ones."""

from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax.fem.kinematics import AbstractKinematics, Axisymmetric
from sorojax.mesh.elements import AbstractElement, facet_corners, facet_element
from sorojax.mesh.shape import (
    quadrature,
    shape_functions,
    shape_gradients,
    side_functions,
    side_slopes,
)

if TYPE_CHECKING:
    from sorojax.fem.problem import Problem

Facets = Int[Array, "facets facet_nodes"]


class FacetTables(NamedTuple):
    """Shape functions of a facet at its quadrature points, their slopes and the weights."""

    values: Float[np.ndarray, "quad facet_nodes"]
    slopes: Float[np.ndarray, "quad facet_nodes dim_minus_1"]
    weights: Float[np.ndarray, " quad"]


@cache
def facet_tables(element: AbstractElement) -> FacetTables:
    """Tables exact for the volume that facets enclose, curved ones too."""
    if element.dim == 2:
        at, weights = np.polynomial.legendre.leggauss(element.order + 1)
        slopes = side_slopes(element.order, at)[:, :, None]
        return FacetTables(side_functions(element.order, at), slopes, weights)
    face = facet_element(element)
    rule = quadrature(face)
    values = shape_functions(face, rule.points)
    return FacetTables(values, shape_gradients(face, rule.points), rule.weights)


def normals(
    tables: FacetTables, x: Float[Array, "facet_nodes dim"]
) -> Float[Array, "quad dim"]:
    """Outward normal times the area of each quadrature point over its weight."""
    slope = jnp.einsum("qad,ai->qid", jnp.asarray(tables.slopes, x.dtype), x)
    if x.shape[1] == 2:
        return jnp.stack([slope[:, 1, 0], -slope[:, 0, 0]], axis=1)
    return jnp.cross(slope[:, :, 0], slope[:, :, 1])


def facet_volume(
    element: AbstractElement,
    kinematics: AbstractKinematics,
    x: Float[Array, "facet_nodes dim"],
    flux_shares: tuple[float, ...] | None = None,
) -> Float[Array, ""]:
    """Share of a facet in the volume that its outer side encloses [m^3].

    The flux of a field of divergence one that is parallel to the planes through the origin
    (to those across the axis, in a body of revolution), so that cavities cut by planes of
    symmetry need no lid there. `flux_shares` by axis add up to one; the field is parallel
    to every plane across an axis without a share.
    """
    tables = facet_tables(element)
    position = jnp.asarray(tables.values, x.dtype) @ x
    normal = normals(tables, x)
    if isinstance(kinematics, Axisymmetric):
        flux = jnp.pi * position[:, 0] ** 2 * normal[:, 0]
    else:
        shares = jnp.asarray(flux_shares or (1 / x.shape[1],) * x.shape[1], x.dtype)
        flux = (position * normal) @ shares
        flux = flux * kinematics.depth(tuple(position.T))
    return -jnp.sum(jnp.asarray(tables.weights, x.dtype) * flux)


def cavity_volume(
    problem: "Problem",
    u: Float[Array, "nodes dim"],
    facets: Facets,
    flux_shares: tuple[float, ...] | None = None,
) -> Float[Array, ""]:
    """Volume that closed sets of facets enclose on their outer side [m^3]."""
    x = (problem.mesh.points + u)[facets]
    element, kinematics = problem.mesh.element, problem.kinematics
    return jnp.sum(jax.vmap(lambda x: facet_volume(element, kinematics, x, flux_shares))(x))


def facet_integral(
    problem: "Problem", facets: Facets, nodal: Float[Array, "nodes dim"]
) -> Float[Array, " dim"]:
    """Integral of a nodal field over the reference area of facets."""
    tables, kinematics = facet_tables(problem.mesh.element), problem.kinematics

    def one(X, value):
        size = jnp.sqrt(jnp.sum(normals(tables, X) ** 2, axis=1))
        values = jnp.asarray(tables.values, X.dtype)
        position = values @ X
        area = jnp.asarray(tables.weights, X.dtype) * size * kinematics.depth(tuple(position.T))
        return area @ (values @ value)

    return jnp.sum(jax.vmap(one)(problem.mesh.points[facets], nodal[facets]), axis=0)


def open_nodes(element: AbstractElement, facets: Int[np.ndarray, "facets nodes"]) -> np.ndarray:
    """Nodes at which a set of facets has an open end (plane) or edge (space)."""
    facets = np.asarray(facets)
    count = facet_corners(element)
    if element.dim == 2:
        nodes, number = np.unique(facets[:, :2].ravel(), return_counts=True)
        return nodes[number % 2 == 1]
    corners = facets[:, :count]
    middles = facets[:, count : 2 * count] if facets.shape[1] >= 2 * count else corners
    # Sides in order around the facet: the middle of side k lies between corners k, k + 1.
    edges = np.stack([corners, np.roll(corners, -1, axis=1), middles], axis=2).reshape(-1, 3)
    keys = np.sort(edges[:, :2], axis=1)
    _, inverse, number = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    return np.unique(edges[(number % 2 == 1)[inverse.ravel()]])
