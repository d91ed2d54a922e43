"""Stresses and forces of an equilibrium."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax.fem.energy import pressure
from sorojax.fem.energy_form import body_at, residual
from sorojax.fem.facets import cavity_volume
from sorojax.fem.formulation import coefficients
from sorojax.fem.kinematics import PlaneStress
from sorojax.fem.points import (
    Points,
    deformation,
    node_points,
    pressure_modes,
    quadrature_points,
)
from sorojax.fem.problem import Problem, body
from sorojax.fem.tensor import Entries, stack_matrix
from sorojax.material.kinematics import Entry, Tensor, determinant
from sorojax.mesh.measure import check_some
from sorojax.mesh.mesh import Mesh


def deformation_gradient(
    problem: Problem, u: Float[Array, "nodes dim"]
) -> Float[Array, "cells cell_nodes 3 3"]:
    """F in three dimensions at the nodes of every cell."""
    return _deformation_gradient(body(problem), u)


@jax.jit
def _deformation_gradient(problem: Problem, u) -> Float[Array, "cells cell_nodes 3 3"]:
    points = node_points(problem.mesh, problem.kinematics)
    F = _full(problem, points, deformation(problem.mesh, problem.kinematics, points, u))
    return jnp.swapaxes(stack_matrix(F, points.volumes), 0, 1)


def cauchy_stress(
    problem: Problem, u: Float[Array, "nodes dim"]
) -> Float[Array, "cells cell_nodes 3 3"]:
    """sigma = P F' / J at the nodes of every cell [Pa], not averaged between cells."""
    return _cauchy_stress(body(problem), u)


@jax.jit
def _cauchy_stress(problem: Problem, u) -> Float[Array, "cells cell_nodes 3 3"]:
    return stress_at(problem, u, node_points(problem.mesh, problem.kinematics))


def stress_at(
    problem: Problem, u: Float[Array, "nodes dim"], points: Points
) -> Float[Array, "cells points 3 3"]:
    """Cauchy stress at `points` of every cell [Pa]."""
    F = _full(problem, points, deformation(problem.mesh, problem.kinematics, points, u))
    material = body_at(problem, points).material
    entries = jax.tree.map(lambda e: jnp.broadcast_to(jnp.asarray(e, points.volumes.dtype),
                                                      points.volumes.shape), F)  # fmt: skip
    P = jax.grad(lambda F: jnp.sum(material.isochoric_energy(F)))(entries)
    J = determinant(entries)
    matrix_P, matrix_F = (stack_matrix(T, points.volumes) for T in (P, entries))
    shape = jnp.einsum("qcij,qckj->qcik", matrix_P, matrix_F) / J[..., None, None]
    spread = jnp.eye(3, dtype=J.dtype)[None, None]
    sigma = shape + _pressure_at(problem, u, points, J)[..., None, None] * spread
    return jnp.swapaxes(sigma, 0, 1)


def _full(problem: Problem, points: Points, F: Entries) -> Tensor:
    """F in three dimensions, the thickness stretch of a sheet included."""
    kinematics = problem.kinematics
    if not isinstance(kinematics, PlaneStress):
        return kinematics.embed(tuple(F))
    material = body_at(problem, points).material
    (a, b, _), (c, d, _), _ = kinematics.embed(tuple(F))
    return (
        (a, b, 0.0),
        (c, d, 0.0),
        (0.0, 0.0, kinematics.thickness_stretch(material, tuple(F))),
    )


def _pressure_at(problem: Problem, u, points: Points, J: Entry) -> Entry:
    """dU/dJ at the nodes: of J there, or the pressure that the cells carry."""
    inside = quadrature_points(problem.mesh, problem.kinematics)
    body = body_at(problem, inside)
    if body.modes is None:
        volumetric = body_at(problem, points).material.volumetric_energy
        return jax.grad(lambda J: jnp.sum(volumetric(J)))(J)
    F = deformation(problem.mesh, problem.kinematics, inside, u)
    carried = coefficients(body.modes, body.volumes, pressure(body, F))
    return jnp.sum(_extended(problem, inside, points) * carried[:, None], axis=0)


def _extended(problem: Problem, inside: Points, points: Points):
    """The orthonormal pressure functions of the quadrature points, at other points."""
    given = jnp.stack(problem.formulation.pressures(inside.position))
    wanted = jnp.stack(problem.formulation.pressures(points.position))
    from_given = pressure_modes(problem.formulation, inside)
    assert from_given is not None
    weights = inside.volumes[None, None]
    gram = jnp.sum(weights * given[:, None] * given[None], axis=2)
    mixed = jnp.sum(weights * given[:, None] * from_given[None], axis=2)
    change = jnp.linalg.solve(jnp.moveaxis(gram, 2, 0), jnp.moveaxis(mixed, 2, 0))
    return jnp.einsum("cfm,fqc->mqc", change, wanted)


def von_mises_stress(
    problem: Problem, u: Float[Array, "nodes dim"]
) -> Float[Array, "cells cell_nodes"]:
    """Von Mises stress at the nodes of every cell [Pa]; zero, with a zero slope, at rest."""
    return _von_mises(cauchy_stress(problem, u))


@jax.jit
def _von_mises(sigma: Float[Array, "cells cell_nodes 3 3"]):
    mean = jnp.trace(sigma, axis1=-2, axis2=-1) / 3
    deviator = sigma - mean[..., None, None] * jnp.eye(3, dtype=sigma.dtype)[None, None]
    square = 1.5 * jnp.sum(deviator**2, axis=(-2, -1))
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def principal_stresses(
    problem: Problem, u: Float[Array, "nodes dim"]
) -> Float[Array, "cells cell_nodes 3"]:
    """Principal Cauchy stresses at the nodes of every cell, rising [Pa]."""
    return jnp.linalg.eigvalsh(cauchy_stress(problem, u))


def nodal_average(
    problem: Problem, field: Float[Array, "cells cell_nodes *value"]
) -> Float[Array, "nodes *value"]:
    """Mean over the cells that share a node, of numbers, vectors or tensors at the nodes of
    every cell."""
    return _nodal_average(problem.mesh, field)


@jax.jit
def _nodal_average(mesh: Mesh, field: Float[Array, "cells cell_nodes *value"]):
    zero = jnp.zeros((mesh.num_nodes, *field.shape[2:]), field.dtype)
    total = zero.at[mesh.cells].add(field)
    return total / zero.at[mesh.cells].add(jnp.ones_like(field))


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
    """Volume of the cavities that closed sets of `facets` enclose [m^3].

    Raises:
        ValueError: If there is no facet.
    """
    check_some("fem.enclosed_volume", facets)
    return _enclosed_volume(body(problem), u, facets)


_enclosed_volume = jax.jit(cavity_volume)
