"""Inertia and damping of one time step, as a quadratic potential."""

from typing import TYPE_CHECKING, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from sorojax.fem.loads import AbstractLoad
from sorojax.fem.mass import lumped_mass, mass_matrix
from sorojax.math import sparse

if TYPE_CHECKING:
    from sorojax.fem.problem import Problem

Mass = Literal["consistent", "lumped"]


class Inertia(AbstractLoad):
    """Potential d'A d / 2 - pull . d of the displacement d from `origin`.

    A holds the mass over the square of the step and the damping over the step, `pull` [N]
    what the state before the step brings along.
    """

    matrix: Float[Array, " nnz"]
    pull: Float[Array, " dofs"]
    origin: Float[Array, "nodes dim"]
    value: Float[Array, ""]
    name: str = eqx.field(static=True, default="inertia")
    smooth: ClassVar[bool] = True

    def potential(self, problem, u):
        d = (u - self.origin).ravel()
        return _half_square(problem.space.system, self.matrix, d) - jnp.sum(self.pull * d)

    def curved_part(self, problem):
        return None

    def tangent_values(self, problem):
        return self.matrix


@jax.custom_jvp
def _half_square(system: sparse.SparseSymmetric, values, d) -> Float[Array, ""]:
    """d' A d / 2, whose slope takes one product with the matrix instead of three."""
    return 0.5 * jnp.sum(d * sparse.product(system, values, d))


def _half_square_slope(primals, tangents):
    system, values, d = primals
    _, values_dot, d_dot = tangents
    force = sparse.product(system, values, d)
    slope = jnp.zeros((), d.dtype)
    if not isinstance(d_dot, SymbolicZero):
        slope = slope + jnp.sum(force * d_dot)
    if not isinstance(values_dot, SymbolicZero):
        slope = slope + 0.5 * jnp.sum(d * sparse.product(system, values_dot, d))
    return 0.5 * jnp.sum(d * force), slope


_half_square.defjvp(_half_square_slope, symbolic_zeros=True)


def mass_values(problem: "Problem", mass: Mass) -> Float[Array, " nnz"]:
    """Mass matrix [kg] as values in the pattern of the tangent."""
    if mass == "consistent":
        return mass_matrix(problem)
    system, lumped = problem.space.system, lumped_mass(problem)
    spread = lumped[system.rows]
    return jnp.where(system.rows == system.cols, spread, jnp.zeros_like(spread))
