"""Mass matrices, consistent or lumped on the diagonal, and damping matrices C, force -C v, in
the sparsity pattern of the tangent.

Reference: Hinton, Rock, Zienkiewicz, "A note on mass lumping and related processes in
the finite element method", Earthquake Engineering & Structural Dynamics 4, 1976.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._types import real
from sorojax.fem.assembly import assemble as asm
from sorojax.fem.assembly.geometry import (
    by_cell,
    deformation,
    geometry,
    node_gradients,
    points_at,
    quadrature_points,
    tables_at,
)
from sorojax.fem.dynamics.masses import (
    kinetic_energy,
    masses_of,
    moving_nodes,
    with_masses,
)
from sorojax.fem.kinematics import green_rates, strain_pairs
from sorojax.fem.problem import Problem
from sorojax.math.linalg import sparse
from sorojax.mesh.elements.polygon import PolyN

_TAKES = "Damping takes energy."


class AbstractDamping(eqx.Module):
    """Something that takes energy from a motion; never gives any."""

    constant: eqx.AbstractClassVar[bool]  # whether the matrix is the same in every state

    @abc.abstractmethod
    def matrix(
        self, problem: Problem, mass: Float[Array, " nnz"], u: Float[Array, "nodes dim"]
    ) -> Float[Array, " nnz"]:
        """C [N s/m] at the state u."""

    def check(self, problem: Problem) -> None:
        """Raise a `ValueError` if the damping does not fit the body."""


class Rayleigh(AbstractDamping):
    """C = `mass` M + `stiffness` K, of the body at rest without loads.

    The damping ratio at the angular frequency w is (mass / w + stiffness w) / 2. The part of
    the stiffness [s] also resists large rotations; `KelvinVoigt` does not. That of the mass
    [1/s] resists every motion, as a resting fluid does.
    """

    mass: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    stiffness: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    constant: ClassVar[bool] = True

    def __check_init__(self):
        for name, unit in (("mass", "1/s"), ("stiffness", "s")):
            _check.finite("Rayleigh", name, getattr(self, name), _TAKES)
            _check.not_negative("Rayleigh", name, getattr(self, name), unit, _TAKES)

    def matrix(self, problem, mass, u):
        rest = jnp.zeros_like(u)
        shape = geometry(
            problem.space, problem.kinematics, problem.formulation, problem.mesh.points
        )
        body = asm.assemble(
            problem.space, shape, problem.material, problem.kinematics, rest, rest
        )
        return self.mass * mass + self.stiffness * body.values


class KelvinVoigt(AbstractDamping):
    """Viscous second Piola-Kirchhoff stress 2 `viscosity` dE/dt, E the Green strain.

    `viscosity` [Pa s], a number or one per cell, over the shear modulus is the time of
    relaxation; small vibrations at the angular frequency w have the damping ratio
    w viscosity / (2 mu). Rotations cost nothing.
    """

    viscosity: Float[Array, "..."] = eqx.field(converter=real)
    constant: ClassVar[bool] = False

    def __check_init__(self):
        _check.finite("KelvinVoigt", "viscosity", self.viscosity, _TAKES)
        _check.not_negative("KelvinVoigt", "viscosity", self.viscosity, "Pa s", _TAKES)

    def check(self, problem):
        if self.viscosity.shape not in ((), (problem.mesh.num_cells,)):
            raise ValueError(
                f"fem.simulate: KelvinVoigt has a viscosity of shape {self.viscosity.shape}, "
                f"need () or ({problem.mesh.num_cells},): a number or one per cell."
            )
        if isinstance(problem.mesh.element, PolyN):
            raise ValueError(
                "fem.simulate: KelvinVoigt got polygons, need cells of one shape. "
                "Use Rayleigh, or another mesh."
            )

    def matrix(self, problem, mass, u):
        rates = strain_rates(problem, u)  # strains, nodes * dim, quad, cells
        points = quadrature_points(problem.mesh, problem.kinematics)
        weights = 2 * points.volumes * jnp.atleast_1d(self.viscosity)[None]
        cells = jnp.einsum("saqc,sbqc->cab", rates, rates * weights[None, None])
        return sparse.assemble(problem.space.system, cells)


def strain_rates(
    problem: Problem, u: Float[Array, "nodes dim"]
) -> Float[Array, "strains cell_dofs quad cells"]:
    """Rates of the Green strain by the velocities of a cell's nodes [1/m], entries off the
    diagonal times the square root of 2."""
    mesh, kinematics = problem.mesh, problem.kinematics
    points = quadrature_points(mesh, kinematics)
    F = deformation(mesh, kinematics, points, u)[:, None, None]
    G = node_gradients(kinematics, points, by_cell(mesh, mesh.points))
    G = jnp.moveaxis(G, 2, 0).swapaxes(1, 2)  # columns, nodes, quad, cells
    unit = jnp.eye(mesh.element.dim, dtype=G.dtype)[:, None, :, None, None]
    rates = jnp.stack([unit[s.component] * G[s.column][:, None] for s in kinematics.slots])
    scale = [1.0 if j == k else 2.0**0.5 for j, k in strain_pairs(kinematics)]
    rates = jnp.stack(
        [a * E for a, E in zip(scale, green_rates(kinematics, F, rates), strict=True)]
    )
    return rates.reshape(len(scale), -1, *G.shape[2:])


# Mass matrices: consistent in the pattern of the tangent, lumped on the diagonal


def mass_matrix(
    problem: Problem, displacement: Float[Array, "nodes dim"] | None = None
) -> Float[Array, " nnz"]:
    """Consistent mass matrix [kg], as values in the pattern `problem.space.system`.

    `sparse.product(problem.space.system, mass_matrix(problem), v)` multiplies by it.
    That of embedded rods is on the diagonal; that of mounted ones depends on the
    `displacement` [m], zero if omitted. Differentiable in density, thickness, nodes and
    displacement.

    Args:
        problem: The boundary value problem.
        displacement: At which mounted rods are [m].

    Returns:
        Entries of the matrix [kg].

    Raises:
        ValueError: If the material has no density.
    """
    u = jnp.zeros_like(problem.mesh.points) if displacement is None else displacement
    return with_masses(problem, u, nodal_mass(problem))


def nodal_mass(problem: Problem) -> Float[Array, " nnz"]:
    """`mass_matrix` without the masses of loads that are elsewhere than at nodes."""
    scalar = _cell_masses(problem)
    cells, nodes, _ = scalar.shape
    dim = problem.mesh.element.dim
    each = jnp.eye(dim, dtype=scalar.dtype)
    full = scalar[:, :, None, :, None] * each[None, None, :, None, :]
    size, system = nodes * dim, problem.space.system
    mass = sparse.assemble(system, full.reshape(cells, size, size))
    if (more := _of_loads(problem)) is None:
        return mass
    added = jnp.repeat(more, dim)[system.rows]
    return mass + jnp.where(system.rows == system.cols, added, jnp.zeros_like(added))


def lumped_mass(problem: Problem) -> Float[Array, " dofs"]:
    """Mass of every unknown [kg], the diagonal of the consistent matrix of each cell scaled
    to its mass; positive for every element.

    Args:
        problem: The boundary value problem.

    Returns:
        The diagonal of the mass matrix [kg].

    Raises:
        ValueError: If the material has no density.
    """
    scalar = _cell_masses(problem)
    diagonal = jnp.einsum("caa->ca", scalar)
    total = jnp.sum(scalar, axis=(1, 2))
    share = diagonal * (total / jnp.sum(diagonal, axis=1))[:, None]
    zero = jnp.zeros(problem.mesh.num_nodes, share.dtype)
    nodal, more = zero.at[problem.mesh.cells].add(share), _of_loads(problem)
    return jnp.repeat(nodal if more is None else nodal + more, problem.mesh.element.dim)


def total_mass(problem: Problem) -> Float[Array, ""]:
    """Mass of the body [kg].

    Args:
        problem: The boundary value problem.

    Returns:
        Mass [kg].
    """
    own, more = jnp.sum(_cell_masses(problem)), _of_loads(problem)
    own = own if more is None else own + jnp.sum(more)
    if not masses_of(problem):
        return own
    still = jnp.zeros_like(problem.mesh.points)
    shift = still.at[:, 0].set(moving_nodes(problem))
    return own + 2 * kinetic_energy(problem, still, shift)


def _of_loads(problem: Problem) -> Float[Array, " nodes"] | None:
    """Mass that loads add to the nodes [kg], such as rods in the solid."""
    found = [load.lumped_mass(problem) for load in problem.loads]
    given = [mass for mass in found if mass is not None]
    return sum(given[1:], start=given[0]) if given else None


@once
def _cell_masses(problem: Problem) -> Float[Array, "cells cell_nodes cell_nodes"]:
    density = problem.material.density
    if density is None:
        raise ValueError(
            "fem.mass_matrix: the material has no density, need one [kg/m^3]. Give `density` "
            "to the material; rubber has about 1070."
        )
    tables = tables_at(problem.mesh.element, "mass")
    points = points_at(problem.mesh, problem.kinematics, tables)
    weights = points.volumes * jnp.atleast_1d(jnp.asarray(density))[None]
    N = jnp.asarray(tables.values)
    if points.kinds is None:
        return jnp.einsum("qa,qb,qc->cab", N[0], N[0], weights)
    return jnp.einsum("cqa,cqb,qc->cab", N[points.kinds], N[points.kinds], weights)
