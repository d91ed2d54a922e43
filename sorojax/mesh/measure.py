"""Areas and volumes of cells and cavities, differentiable in the points of a mesh."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax.mesh.elements import facet_element
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.shape import quadrature, shape_functions, shape_gradients


def cell_areas(mesh: Mesh) -> Float[Array, " cells"]:
    """Area of each plane cell [m^2], curved sides included; differentiable in the points."""
    if mesh.element.dim != 2:
        raise ValueError(
            f"cell_areas: the mesh has {mesh.element.name} cells, need plane ones. Use "
            "cell_volumes."
        )
    return _areas(mesh)


@eqx.filter_jit
def _areas(mesh: Mesh) -> Float[Array, " cells"]:
    x = mesh.points[mesh.cells]
    total = jnp.zeros_like(x[:, 0, 0])
    for facet in mesh.element.facets:
        # From a corner of the cell, so that small cells far away keep their digits.
        total = total + _under([x[:, i] - x[:, 0] for i in facet])
    return total


def cell_volumes(mesh: Mesh) -> Float[Array, " cells"]:
    """Volume of each solid cell [m^3], curved faces included; differentiable in the points."""
    if mesh.element.dim != 3:
        raise ValueError(
            f"cell_volumes: the mesh has {mesh.element.name} cells, need solid ones. Use "
            "cell_areas."
        )
    return _volumes(mesh)


@eqx.filter_jit
def _volumes(mesh: Mesh) -> Float[Array, " cells"]:
    rule = quadrature(mesh.element, 3)
    slopes = jnp.asarray(shape_gradients(mesh.element, rule.points), mesh.points.dtype)
    x = mesh.points[mesh.cells]
    total = jnp.zeros_like(x[:, 0, 0])
    for slope, weight in zip(slopes, rule.weights, strict=True):
        a, b, c = (jnp.einsum("cai,a->ci", x, slope[:, k]) for k in range(3))
        total = total + weight * jnp.sum(a * jnp.cross(b, c), axis=1)
    return total


def enclosed_volume(
    mesh: Mesh, facets: Int[np.ndarray, "facets facet_nodes"]
) -> Float[Array, ""]:
    """Volume [m^3] of the cavity that closed `facets` of a body surround (area [m^2] in
    the plane); negative for an outer surface. Differentiable in the points.

    Raises:
        ValueError: If there is no facet.
    """
    check_some("mesh.enclosed_volume", facets)
    return _enclosed(mesh.points, jnp.asarray(facets), mesh.element)


def check_some(where: str, facets: Any) -> None:
    """Raise a `ValueError` if there is no facet."""
    if 0 in np.shape(facets):
        raise ValueError(
            f"{where}: got no facet, need those around a cavity. Look at mesh.chambers(mesh), "
            "or at the shape given to mesh.facets_on."
        )


@eqx.filter_jit
def _enclosed(points, facets, element) -> Float[Array, ""]:
    x = points[facets]
    if element.dim == 2:
        origin = x[0, 0]
        ends = [x[:, i] - origin[None] for i in range(facets.shape[1])]
        return -jnp.sum(_under(ends))
    side = facet_element(element)
    rule = quadrature(side, 4)
    values = jnp.asarray(shape_functions(side, rule.points), x.dtype)
    slopes = jnp.asarray(shape_gradients(side, rule.points), x.dtype)
    x = x - x[0, 0][None, None]
    total = jnp.zeros_like(x[0, 0, 0])
    for value, slope, weight in zip(values, slopes, rule.weights, strict=True):
        p, a, b = (jnp.einsum("fai,a->fi", x, w) for w in (value, slope[:, 0], slope[:, 1]))
        total = total + weight * jnp.sum(p * jnp.cross(a, b)) / 3
    return -total


def _under(ends) -> Float[Array, " sides"]:
    """Area between sides and the origin: x dy/2, with two thirds of chord times height
    for the parabola over a chord."""
    a, b = ends[0], ends[1]
    area = _cross(a, b) / 2
    if len(ends) == 3:
        area = area + 2 / 3 * _cross(ends[2] - (a + b) / 2, b - a)
    return area


def _cross(a: Float[Array, "cells 2"], b: Float[Array, "cells 2"]) -> Float[Array, " cells"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
