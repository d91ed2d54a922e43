"""How an equilibrium answers to small changes of its numbers: a linear map and its transpose.

The map is R_u du = -R_p dp. With concrete numbers it is one operation, so that tracing a
derivative stages one operation; the work is done in whichever direction is asked for: one
compiled program, one factor and one back-substitution.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax._jax.linear_map import pushed
from sorojax._jax.trace_state import evaluated_now
from sorojax.fem.energy_form import potential_energy, residual
from sorojax.fem.problem import Problem, unsupported
from sorojax.fem.supports import known_dofs, known_values
from sorojax.fem.traced import known_mask
from sorojax.math import sparse


class Equilibrium(NamedTuple):
    """What the map is made of: the numbers that move, all others, and the state.

    `values` are those of the tangent; the first of the `counts` of the solve is one where the
    state is no equilibrium, which has no derivative.
    """

    params: Problem
    rest: Problem
    u: Float[Array, "nodes dim"]
    values: Float[Array, " nnz"]
    counts: Float[Array, " 4"]


def response(at: Equilibrium, rates: Problem) -> Float[Array, "nodes dim"]:
    """du for the rates dp of the numbers that move, by operations that JAX differentiates."""
    system, matrix, known = _held_tangent(at)
    if _supports_move(at):
        rhs, move = _moved_unbalance(at, rates, known)
        return _answer(system, matrix, rhs, at.u) + move
    rhs = _unbalance(_without_supports(at), unsupported(rates), known)
    return _answer(system, matrix, rhs, at.u)


def response_at_once(at: Equilibrium, rates: Problem) -> Float[Array, "nodes dim"]:
    """The same for a concrete equilibrium, as one operation."""
    moving, tree = jax.tree.flatten(rates)
    return pushed(moving, _Map(at, tree))[0]


class _Map:
    """An equilibrium as a `LinearMap`."""

    def __init__(self, at: Equilibrium, tree):
        self.at, self.tree = at, tree
        self.inputs, self.outputs = jax.tree.leaves(at.params), (at.u,)

    def push(self, *moving) -> tuple:
        return (response(self.at, jax.tree.unflatten(self.tree, moving)),)

    push_now = push

    def pull(self, *changes) -> list:
        return list(jax.linear_transpose(self.push, *self.inputs)(changes))

    def pull_now(self, *changes) -> list:
        """By one back-substitution and the derivative of one number."""
        if _supports_move(self.at):
            return self.pull(*changes)
        system, matrix, known = _held_on_host(self.at)
        force = np.where(known, 0.0, np.asarray(changes[0]).ravel())
        # the last factor of the solve belongs to the state before the last, small update
        work = system.solver.solve_near(matrix, force)
        return jax.tree.leaves(_pulled(_without_supports(self.at), work, known))


def _supports_move(at: Equilibrium) -> bool:
    return bool(jax.tree.leaves(at.params.supports))


def _without_supports(at: Equilibrium) -> Equilibrium:
    return at._replace(params=unsupported(at.params), rest=unsupported(at.rest))


def _held_tangent(at: Equilibrium):
    """The system, the tangent with its supports, and which unknowns these decide."""
    problem = eqx.combine(at.params, at.rest)
    system = problem.space.system
    # Concrete numbers run one compiled program, not its operations for the trace.
    with evaluated_now(at):
        return system, *_held(system, problem.supports, at.values, at.u)


def _held_on_host(at: Equilibrium):
    """The same as arrays of the host, where supports do not move."""
    system = eqx.combine(at.params.space.system, at.rest.space.system)
    known = known_dofs(at.rest.supports, *at.u.shape)
    return system, sparse.fixed_on_host(system, np.asarray(at.values), known), known


@eqx.filter_jit
def _held(system: sparse.SparseSymmetric, supports: tuple, values, u):
    known = known_mask(supports, *u.shape)
    return sparse.fix(system, values, known), known


# Few programs, each differentiated and transposed once: operation by operation the trace
# of a derivative costs more than the solve.


@jax.jit
def _unbalance(at: Equilibrium, rates: Problem, known: Bool[Array, " dofs"]):
    """-dR for the numbers that move, at displacements that stay."""

    def unbalanced(params):
        return residual(eqx.combine(params, at.rest), at.u).ravel()

    _, rate = jax.jvp(unbalanced, (at.params,), (rates,))
    return jnp.where(known, jnp.zeros_like(rate), -_valid(at) * rate)


@jax.jit
def _pulled(at: Equilibrium, work: Float[Array, " dofs"], known: Bool[Array, " dofs"]):
    """-work . dR by each of these numbers."""
    way = jnp.where(known, jnp.zeros_like(work), -_valid(at) * work).reshape(at.u.shape)

    def along(params):
        def energy(u):
            return potential_energy(eqx.combine(params, at.rest), u)

        return jax.jvp(energy, (at.u,), (way,))[1]

    return jax.grad(along)(at.params)


@eqx.filter_jit
def _moved_unbalance(at: Equilibrium, rates: Problem, known: Bool[Array, " dofs"]):
    """-dR with the displacements that supports prescribe, and how these move [m]."""

    def prescribed(params):
        return known_values(eqx.combine(params, at.rest).supports, *at.u.shape)

    def unbalanced(params, u):
        return residual(eqx.combine(params, at.rest), u).ravel()

    _, move = jax.jvp(prescribed, (at.params,), (rates,))
    move = _valid(at) * move.reshape(at.u.shape)
    _, rate = jax.jvp(unbalanced, (at.params, at.u), (rates, move))
    return jnp.where(known, jnp.zeros_like(rate), -_valid(at) * rate), move


@jax.jit
def _answer(system: sparse.SparseSymmetric, matrix, rhs, u):
    return sparse.solve(system, matrix, rhs).reshape(u.shape)


def _valid(at: Equilibrium) -> Float[Array, ""]:
    """1, or NaN where there is no derivative: a factor keeps the map linear."""
    failed = at.counts[0]
    return jnp.where(failed == 0, jnp.ones_like(failed), jnp.nan)
