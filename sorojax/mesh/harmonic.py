"""Displacements spread from some nodes of a mesh, curve or surface over all others."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax._types import integers
from sorojax.math import sparse
from sorojax.mesh.elements import AbstractElement, Hex8, Quad4, Tet4, Tri3
from sorojax.mesh.shape import quadrature, shape_gradients

_LINEAR = {(2, 3): Tri3, (2, 4): Quad4, (3, 4): Tet4, (3, 8): Hex8}


class Harmonic(eqx.Module):
    """A Laplace problem on `nodes`, with displacements given where `held`."""

    system: sparse.SparseSymmetric
    values: Float[Array, " nnz"]
    fixed_values: Float[Array, " nnz"]
    held: Bool[Array, " own"]
    nodes: Int[Array, " own"] = eqx.field(converter=integers)


def harmonic(cells: np.ndarray, stiffness: np.ndarray, held: np.ndarray) -> Harmonic | None:
    """The problem on the nodes of `cells` with element matrices `stiffness`.

    Nodes that no `held` one is connected to are held as well; `None` if none is free.
    """
    nodes, number = np.unique(cells, return_inverse=True)
    number = number.reshape(cells.shape)
    fixed = held[nodes] | _adrift(number, held[nodes])
    if fixed.all():
        return None
    system = sparse.from_cells(len(nodes), number)
    mask = jnp.asarray(fixed)
    values, fixed_values = _assembled(system, jnp.asarray(stiffness), mask)
    return Harmonic(system, values, fixed_values, mask, nodes)


def _adrift(cells: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Nodes in parts without any held node."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    first = np.repeat(cells[:, :1], cells.shape[1] - 1, axis=1).ravel()
    ends = (np.ones(len(first)), (first, cells[:, 1:].ravel()))
    label = connected_components(coo_matrix(ends, shape=(len(held),) * 2), directed=False)[1]
    return ~np.isin(label, label[held])


@eqx.filter_jit
def _assembled(system, stiffness, held):
    values = sparse.assemble(system, stiffness)
    return values, sparse.fix(system, values, held)


@eqx.filter_jit
def spread(
    problem: Harmonic, displacement: Float[Array, "nodes dim"]
) -> Float[Array, "nodes dim"]:
    """`displacement`, with that of the free nodes of `problem` made harmonic."""
    system, held = problem.system, problem.held

    def one(known):
        known = jnp.where(held, known, jnp.zeros_like(known))
        pull = -sparse.product(system, problem.values, known)
        pull = jnp.where(held, jnp.zeros_like(pull), pull)
        return known + sparse.solve(system, problem.fixed_values, pull)

    inside = jax.vmap(one, 1, 1)(displacement[problem.nodes])
    return displacement.at[problem.nodes].set(inside)


def linear_element(element: AbstractElement) -> AbstractElement:
    """The element with the corners of `element` and no other nodes."""
    return _LINEAR[element.dim, element.num_corners]()


def laplace_cells(points: np.ndarray, cells: np.ndarray, element: AbstractElement):
    """Stiffness of the Laplace operator on linear cells, (cells, corners, corners)."""
    rule, x = quadrature(element), points[cells]
    total = np.zeros((len(cells), cells.shape[1], cells.shape[1]))
    for slope, weight in zip(shape_gradients(element, rule.points), rule.weights, strict=True):
        jacobian = np.einsum("cai,ad->cid", x, slope)
        det = np.abs(np.linalg.det(jacobian))
        g = slope @ np.linalg.inv(jacobian)
        total += (weight * det)[:, None, None] * np.einsum("cai,cbi->cab", g, g)
    return total


def laplace_graph(points: np.ndarray, polygons: np.ndarray) -> np.ndarray:
    """Stiffness of springs along the sides of polygons in space (or of single lines).

    A side pulls with one over its length, so a displacement varies linearly along a line.
    """
    count = polygons.shape[1]
    total = np.zeros((len(polygons), count, count))
    for i in range(count if count > 2 else 1):
        j = (i + 1) % count
        length = np.linalg.norm(points[polygons[:, i]] - points[polygons[:, j]], axis=1)
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            total[:, a, b] += sign / np.maximum(length, 1e-300)
    return total
