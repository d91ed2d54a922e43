"""Stresses and forces of an equilibrium."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax.fem.energy_form import residual
from sorojax.fem.kinematics import determinant
from sorojax.fem.loads import cavity_volume
from sorojax.fem.points import deformation_gradients
from sorojax.fem.problem import Problem
from sorojax.material.hyperelastic import first_piola_kirchhoff_stress
from sorojax.mesh.shape import nodes as reference_nodes


def cauchy_stress(
    problem: Problem, u: Float[Array, "nodes dim"]
) -> Float[Array, "cells cell_nodes 3 3"]:
    """sigma = P F' / J at the nodes of every cell [Pa], not averaged between cells."""
    F = deformation_gradients(problem.mesh, u, at=reference_nodes(problem.mesh.element))
    full = problem.kinematics.embed(F)
    like = F[0][0]
    entries = [[jnp.broadcast_to(jnp.asarray(e, like.dtype), like.shape) for e in row]
               for row in full]  # fmt: skip
    matrices = jnp.moveaxis(jnp.stack([jnp.stack(row) for row in entries]), (0, 1), (-2, -1))

    def at_point(material, F):
        P = first_piola_kirchhoff_stress(material, F)
        return P @ F.T / determinant(((F[0, 0], F[0, 1]), (F[1, 0], F[1, 1]))) / F[2, 2]

    axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) == 1 else None, problem.material)
    by_cell = jax.vmap(jax.vmap(at_point, in_axes=(None, 0)), in_axes=(axes, 1))
    return by_cell(problem.material, matrices)


def von_mises_stress(
    problem: Problem, u: Float[Array, "nodes dim"]
) -> Float[Array, "cells cell_nodes"]:
    """Von Mises stress at the nodes of every cell [Pa]; zero, with a zero slope, at rest."""
    sigma = cauchy_stress(problem, u)
    mean = jnp.trace(sigma, axis1=-2, axis2=-1) / 3
    deviator = sigma - mean[..., None, None] * jnp.eye(3, dtype=sigma.dtype)[None, None]
    square = 1.5 * jnp.sum(deviator**2, axis=(-2, -1))
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def nodal_average(
    problem: Problem, field: Float[Array, "cells cell_nodes"]
) -> Float[Array, " nodes"]:
    """Mean over the cells that share a node, for pictures."""
    zero = jnp.zeros(problem.mesh.num_nodes, field.dtype)
    total = zero.at[problem.mesh.cells].add(field)
    count = zero.at[problem.mesh.cells].add(jnp.ones_like(field))
    return total / count


def reaction_force(
    problem: Problem, u: Float[Array, "nodes dim"], nodes: Int[Array, " nodes"]
) -> Float[Array, " dim"]:
    """Force that the supports of `nodes` exert on the body [N]."""
    return jnp.sum(residual(problem, u)[nodes], axis=0)


def enclosed_volume(
    problem: Problem,
    u: Float[Array, "nodes dim"],
    facets: Int[Array, "facets facet_nodes"],
) -> Float[Array, ""]:
    """Volume of the cavities that closed loops of `facets` enclose [m^3]."""
    order = problem.mesh.element.order
    return cavity_volume(problem.mesh.points + u, facets, order, problem.kinematics.depth)
