"""Mass matrices: consistent in the pattern of the tangent, lumped on the diagonal.

Reference: Hinton, Rock, Zienkiewicz, "A note on mass lumping and related processes in
the finite element method", Earthquake Engineering & Structural Dynamics 4, 1976.
"""

from functools import cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.fem.points import points_of
from sorojax.fem.problem import Problem
from sorojax.fem.tables import Tables, quadrature_tables
from sorojax.math import sparse
from sorojax.mesh.elements import (
    AbstractElement,
    Hex8,
    PolyN,
    Quad4,
    Quad8,
    Quad9,
    Tet15,
    Tri7,
)
from sorojax.mesh.shape import quadrature, shape_functions, shape_gradients


def mass_matrix(problem: Problem) -> Float[Array, " nnz"]:
    """Consistent mass matrix [kg], as values in the pattern `problem.space.system`.

    `sparse.product(problem.space.system, mass_matrix(problem), v)` multiplies by it.
    Differentiable in density, thickness and nodes.

    Raises:
        ValueError: If the material has no density.
    """
    scalar = _cell_masses(problem)
    cells, nodes, _ = scalar.shape
    dim = problem.mesh.element.dim
    each = jnp.eye(dim, dtype=scalar.dtype)
    full = scalar[:, :, None, :, None] * each[None, None, :, None, :]
    size = nodes * dim
    return sparse.assemble(problem.space.system, full.reshape(cells, size, size))


def lumped_mass(problem: Problem) -> Float[Array, " dofs"]:
    """Mass of every unknown [kg], the diagonal of the consistent matrix of each cell scaled
    to its mass; positive for every element.

    Raises:
        ValueError: If the material has no density.
    """
    scalar = _cell_masses(problem)
    diagonal = jnp.einsum("caa->ca", scalar)
    total = jnp.sum(scalar, axis=(1, 2))
    share = diagonal * (total / jnp.sum(diagonal, axis=1))[:, None]
    zero = jnp.zeros(problem.mesh.num_nodes, share.dtype)
    return jnp.repeat(zero.at[problem.mesh.cells].add(share), problem.mesh.element.dim)


def total_mass(problem: Problem) -> Float[Array, ""]:
    """Mass of the body [kg]."""
    return jnp.sum(_cell_masses(problem))


def _cell_masses(problem: Problem) -> Float[Array, "cells cell_nodes cell_nodes"]:
    density = problem.material.density
    if density is None:
        raise ValueError(
            "fem.mass_matrix: the material has no density, need one [kg/m^3]. Give `density` "
            "to the material; rubber has about 1070."
        )
    tables = mass_tables(problem.mesh.element)
    points = points_of(problem.mesh, problem.kinematics, tables)
    weights = points.volumes * jnp.atleast_1d(jnp.asarray(density))[None]
    N = jnp.asarray(tables.values)
    if points.kinds is None:
        return jnp.einsum("qa,qb,qc->cab", N[0], N[0], weights)
    return jnp.einsum("cqa,cqb,qc->cab", N[points.kinds], N[points.kinds], weights)


@cache
def mass_tables(element: AbstractElement) -> Tables:
    """Tables exact for products of two shape functions times a radius, on straight cells;
    those of the stiffness for polygons, whose functions are rational."""
    if isinstance(element, PolyN):
        return quadrature_tables(element)
    if isinstance(element, Quad4 | Quad8 | Quad9 | Hex8):
        at, weights = quadrature(element, 2 * element.order + 3)
    else:
        bubble = {Tri7: 3, Tet15: 4}.get(type(element), element.order)
        at, weights = _collapsed(element.dim, bubble + 2)
    values, slopes = shape_functions(element, at), shape_gradients(element, at)
    return Tables(values[None], slopes[None], weights[None])


def _collapsed(dim: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss rule of the unit cube collapsed onto the unit simplex."""
    x, w = np.polynomial.legendre.leggauss(count)
    axes = np.meshgrid(*[(x + 1) / 2] * dim, indexing="ij")
    weights = np.prod(np.meshgrid(*[w / 2] * dim, indexing="ij"), axis=0)
    left, at = np.ones_like(weights), []
    for axis, u in enumerate(axes):
        at.append(u * left)
        weights = weights * (1 - u) ** (dim - 1 - axis)
        left = left * (1 - u)
    return np.stack([a.ravel() for a in at], axis=1), weights.ravel()
