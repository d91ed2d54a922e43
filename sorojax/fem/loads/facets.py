"""Integrals over facets: the sides of plane cells, the faces of solid ones."""

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax.fem.kinematics import AbstractKinematics, Axisymmetric
from sorojax.mesh.elements.base import (
    AbstractElement,
    facet_corners,
    facet_element,
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


def pressure_force(
    problem: "Problem", u: Float[Array, "nodes dim"], facets: Facets
) -> Float[Array, "nodes dim"]:
    """Nodal forces of a unit of pressure on the outer side of deformed facets [m^2]."""
    tables, kinematics = facet_tables(problem.mesh.element), problem.kinematics
    weights, values = (jnp.asarray(x, u.dtype) for x in (tables.weights, tables.values))

    def one(x):
        depth = weights * kinematics.depth(tuple((values @ x).T))
        return -jnp.einsum("q,qa,qi->ai", depth, values, normals(tables, x))

    pushed = jax.vmap(one)((problem.mesh.points + u)[facets])
    return jnp.zeros_like(u).at[facets].add(pushed)


def areas_of(problem: "Problem", facets: Facets) -> Float[Array, "facets quad"]:
    """Reference areas of the quadrature points of facets [m^2]."""
    tables, kinematics = facet_tables(problem.mesh.element), problem.kinematics
    dtype = problem.mesh.points.dtype
    weights, values = jnp.asarray(tables.weights, dtype), jnp.asarray(tables.values, dtype)

    def one(X):
        size = jnp.sqrt(jnp.sum(normals(tables, X) ** 2, axis=1))
        return weights * size * kinematics.depth(tuple((values @ X).T))

    return jax.vmap(one)(problem.mesh.points[facets])


def facet_integral(
    problem: "Problem", facets: Facets, nodal: Float[Array, "nodes dim"]
) -> Float[Array, " dim"]:
    """Integral of a nodal field over the reference area of facets."""
    values = jnp.asarray(facet_tables(problem.mesh.element).values, nodal.dtype)
    return jnp.einsum("fq,qa,fai->i", areas_of(problem, facets), values, nodal[facets])


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


# Load stiffness: small dense matrices of groups of nodes, scattered into the tangent


_BLOCK = 32  # groups that are skipped together


class CurvedPart(NamedTuple):
    """Groups of nodes, and the energy [J] of one at its deformed positions [m].

    `energy(x, data)` takes the positions of a group and its row of `data`. Where
    `idle(x, data)` holds for a block of groups its stiffness is known to be zero and is
    not computed.
    """

    groups: Int[Array, "groups group_nodes"]
    energy: Callable[[Float[Array, "group_nodes dim"], Any], Float[Array, ""]]
    data: Any = None
    idle: Callable[[Float[Array, "block group_nodes dim"], Any], Bool[Array, ""]] | None = None


def group_matrices(
    part: CurvedPart, x: Float[Array, "groups group_nodes dim"]
) -> Float[Array, "groups entries"]:
    """Upper triangles of the second derivatives, node by node [N/m].

    Where a node stands twice in a group, the entry between the two is one of the diagonal
    and counts twice.
    """
    size, dim = x.shape[1] * x.shape[2], x.shape[2]
    first, second = np.triu_indices(size)
    twin = (first != second) & (first % dim == second % dim)
    repeated = part.groups[:, first // dim] == part.groups[:, second // dim]
    count = jnp.where(repeated & jnp.asarray(twin)[None], 2.0, 1.0).astype(x.dtype)

    def upper(x, data):
        def energy(flat):
            return part.energy(flat.reshape(x.shape), data)

        return jax.hessian(energy)(x.ravel())[first, second]

    def many(x, data):
        return jax.vmap(upper)(x, data)

    if part.idle is None:
        return count * many(x, part.data)
    return count * blockwise(many, part.idle, x, part.data, (len(first),))


@eqx.filter_custom_jvp
def group_energy(
    x: Float[Array, "groups group_nodes dim"], load: Any, problem: Any
) -> Float[Array, ""]:
    """Energy [J] of the groups of `load` at positions `x` [m].

    Of groups that are idle neither the energy nor its slope is computed.
    """
    return _summed(x, load, problem)


def _summed(x, load, problem):
    part = load.curved_part(problem)
    return jnp.sum(blockwise(jax.vmap(part.energy), part.idle, x, part.data, ()))


@group_energy.def_jvp
def _group_slope(primals, tangents):
    if jax.tree.leaves(tangents[1:]):
        return eqx.filter_jvp(_summed, primals, tangents)
    x, load, problem = primals
    part = load.curved_part(problem)
    slope = jax.vmap(jax.grad(part.energy))
    found = blockwise(slope, part.idle, x, part.data, x.shape[1:])
    return group_energy(x, load, problem), jnp.sum(found * tangents[0])


def blockwise(
    kernel: Callable,
    idle: Callable,
    x: Float[Array, "groups ..."],
    data: Any,
    tail: tuple,
    rest: Callable | None = None,
) -> Float[Array, "groups ..."]:
    """`kernel(x, data)` in blocks of groups; where a block is idle `rest(x, data)`, or zeros
    of shape `tail`."""
    count = x.shape[0]
    width = min(_BLOCK, count)
    num_blocks = -(-count // width)
    # the last block is filled up with copies of the last group
    at = jnp.minimum(jnp.arange(num_blocks * width), count - 1).reshape(num_blocks, width)

    rows = jax.tree.map(lambda leaf: leaf[at], (x, data))
    still = jax.vmap(idle)(*rows)

    def nothing(*_):
        return jnp.zeros((width, *tail), x.dtype)

    def block(row):
        return jax.lax.cond(row[0], rest or nothing, kernel, *row[1])

    # a loop that finds every block idle costs more than all that it finds
    found = jax.lax.cond(
        jnp.all(still),
        lambda: jax.vmap(rest or nothing)(*rows),
        lambda: jax.lax.map(block, (still, rows)),
    )
    return found.reshape(num_blocks * width, *tail)[:count]
