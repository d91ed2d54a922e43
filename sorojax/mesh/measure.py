"""Areas and volumes of cells and cavities, differentiable in the points of a mesh."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._jax.trace_state import is_traced
from sorojax._types import from_host, real
from sorojax.math.host import KDTree
from sorojax.mesh.elements.base import (
    AbstractElement,
    facet_element,
    nodes,
    quadrature,
    shape_functions,
    shape_gradients,
)
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.elements.polynomials import traced_shape_functions
from sorojax.mesh.mesh import Mesh
from sorojax.sdf.surface.marching import cross


def cell_areas(mesh: Mesh) -> Float[Array, " cells"]:
    """Area of each plane cell [m^2], curved sides included; differentiable in the points.

    Args:
        mesh: A plane mesh.

    Returns:
        Areas [m^2].
    """
    if mesh.element.dim != 2:
        raise ValueError(
            f"cell_areas: the mesh has {mesh.element.name} cells, need plane ones. Use "
            "cell_volumes."
        )
    return _areas(mesh)


@once
def _areas(mesh: Mesh) -> Float[Array, " cells"]:
    x = mesh.points[mesh.cells]
    total = jnp.zeros_like(x[:, 0, 0])
    for facet in mesh.element.facets:
        # From a corner of the cell, so that small cells far away keep their digits.
        total = total + _under([x[:, i] - x[:, 0] for i in facet])
    return total


def cell_volumes(mesh: Mesh) -> Float[Array, " cells"]:
    """Volume of each solid cell [m^3], curved faces included; differentiable in the points.

    Args:
        mesh: A mesh in space.

    Returns:
        Volumes [m^3].
    """
    if mesh.element.dim != 3:
        raise ValueError(
            f"cell_volumes: the mesh has {mesh.element.name} cells, need solid ones. Use "
            "cell_areas."
        )
    return _volumes(mesh)


@once
def _volumes(mesh: Mesh) -> Float[Array, " cells"]:
    rule = quadrature(mesh.element, max(3, mesh.element.stiffness_degree))
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

    Args:
        mesh: The mesh.
        facets: Nodes of the facets, one row per facet.

    Returns:
        Volume [m^3]; area [m^2] in the plane.

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


@once
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
    area = cross(a, b) / 2
    if len(ends) == 3:
        area = area + 2 / 3 * cross(ends[2] - (a + b) / 2, b - a)
    return area


# Where points lie in a mesh, and what nodal fields are there


class Locations(NamedTuple):
    """Places in a mesh: `nodes` of the cells that hold the points, the `weights` [-] of these
    nodes, and the numbers of these `cells`, None where they are not kept."""

    nodes: Int[Array, "points cell_nodes"]
    weights: Float[Array, "points cell_nodes"]
    cells: Int[Array, " points"] | None = None

    def __call__(self, nodal: Float[Array, "nodes dim"]) -> Float[Array, "points dim"]:
        """Values of a nodal field at the points; differentiable in the field."""
        return jnp.einsum("pa,pai->pi", self.weights, nodal[self.nodes])


def locate(
    mesh: Mesh,
    points: Float[Array | np.ndarray, "points dim"],
    cells: Int[Array, " points"] | None = None,
) -> Locations:
    """The cells that hold `points` [m] of the reference configuration, and where in them.

    Differentiable in the points and in the nodes: which cell holds a point is chosen on the
    host, once, and has no derivative; the place inside the cell has.

    Args:
        mesh: Triangles, quadrilaterals or solid cells.
        points: Where to look [m].
        cells: Those chosen before, for a mesh with the same cells. Needed under `jit` and
            `vmap`, where nothing can be chosen.

    Returns:
        Cells and local coordinates of the points.

    Raises:
        ValueError: If a point lies outside the mesh, the cells are polygons, or mesh or
            points are traced and no `cells` are given.
    """
    if isinstance(mesh.element, PolyN):
        raise ValueError("locate: got polygons, need triangles, quadrilaterals or solid cells.")
    if cells is None:
        cells = jnp.asarray(cells_at(mesh, points))
    points = real(points).astype(mesh.points.dtype)
    if is_traced((mesh, points, cells)):
        nodes = mesh.cells[cells]
        return Locations(nodes, _weights(mesh.points[nodes], points, mesh.element), cells)
    # without a program to compile
    nodes = np.asarray(mesh.cells)[np.asarray(cells)]
    corners = np.asarray(mesh.points)[nodes]
    xi = _reference_coordinates(mesh, corners[:, None], np.asarray(points))[:, 0]
    weights = shape_functions(mesh.element, xi)
    return Locations(from_host(nodes), from_host(weights, points.dtype), cells)


def cells_at(mesh: Mesh, points) -> Int[np.ndarray, " points"]:
    """The cell that each point lies deepest in, among those near it."""
    fixed = jax.lax.stop_gradient((mesh.points, points))
    if is_traced((mesh.cells, fixed)):
        raise ValueError(
            "locate: the mesh or the points are traced, need concrete numbers to choose cells "
            "by. Call it outside, or give the `cells` that a call outside has chosen."
        )
    X, points = (np.asarray(x, float) for x in fixed)
    points = np.atleast_2d(points)
    _check.finite("locate", "points", points, "Give points in metres.")
    _check.shape("locate", "points", points, (None, mesh.element.dim), "One row per point.")
    if not len(points):
        raise ValueError("locate: got no point, need one or more. Give one row per point.")
    cells = np.asarray(mesh.cells)
    centres = X[cells[:, : mesh.element.num_corners]].mean(axis=1)
    near = KDTree(centres).query(points, k=min(24, len(cells)))[1].reshape(len(points), -1)
    xi = _reference_coordinates(mesh, X[cells[near]], points)
    inside = mesh.element.depth(xi)
    best = np.argmax(inside, axis=1)
    rows = np.arange(len(points))
    if (outside := np.flatnonzero(inside[rows, best] < -1e-6)).size:
        raise ValueError(
            f"locate: {outside.size} of {len(points)} points lie outside the mesh, the first "
            f"at {points[outside[0]]} m. Move the curve into the body."
        )
    return near[rows, best]


@functools.partial(jax.jit, static_argnums=2)
def _weights(
    corners: Float[Array, "points cell_nodes dim"],
    points: Float[Array, "points dim"],
    element: AbstractElement,
) -> Float[Array, "points cell_nodes"]:
    """Shape functions where X(xi) = point, by Newton's method from the centre of the cell.

    The last two steps alone are differentiated: one gives the first derivative at a
    root, two the second.
    """

    def improved(corners, point, xi):
        def gap(xi):
            return point - traced_shape_functions(element, xi[None])[0] @ corners

        return xi - jnp.linalg.solve(jax.jacfwd(gap)(xi), gap(xi))

    def weights(corners, point):
        xi, held = jnp.asarray(centre, corners.dtype), jax.lax.stop_gradient((corners, point))
        xi = jax.lax.fori_loop(0, 5, lambda _, xi: jnp.clip(improved(*held, xi), -2, 3), xi)
        xi = improved(corners, point, improved(corners, point, xi))
        return traced_shape_functions(element, xi[None])[0]

    centre = nodes(element)[: element.num_corners].mean(axis=0)
    return jax.vmap(weights)(corners, points)


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
