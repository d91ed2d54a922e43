"""How a body at an equilibrium answers small forces."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax._jax.trace_state import evaluated_now, is_traced
from sorojax.fem.equilibrium.jit import prepare_traced
from sorojax.fem.equilibrium.linear import linearise
from sorojax.fem.problem import Problem, residual
from sorojax.math.linalg import sparse
from sorojax.math.linear_map import pushed


def tangent_solve(
    problem: Problem, u: Float[Array, "nodes dim"], forces: Float[Array, "rows dofs"]
) -> Float[Array, "rows dofs"]:
    """Displacements x = K^-1 f [m] by small forces f [N] at the equilibrium `u`, zero where
    supports hold the body; K is the tangent there.

    Differentiable once, forward and reverse, in the forces, in `u` and in every number of the
    problem: the answer is held by `jax.lax.stop_gradient`, and x + K^-1 (f - K x) has the
    derivative K^-1 (df - dK x). So K is factored without a derivative of its assembly, and only
    the products K x, derivatives of the force of the body, are differentiated.
    """
    fixed, held, right = jax.lax.stop_gradient((problem, u, forces))
    with evaluated_now(fixed, held, right):
        matrix, known = _tangent(fixed, held)
        tangent = _Tangent(fixed.space.system, matrix, known, forces.shape)
        found = tangent.solved(right)
    if not is_traced((problem, u, forces)):
        return found
    if is_traced((fixed, held)):
        return found + tangent.push(forces - _products(problem, u, found))[0]
    return found + pushed((forces - _products(problem, u, found),), tangent)[0]


@eqx.filter_jit
def _tangent(problem: Problem, u):
    """The tangent with its supports applied, and which unknowns these decide."""
    prepared = prepare_traced(problem)
    values = linearise(problem, prepared, u, u).values
    return sparse.fix(problem.space.system, values, prepared.known), prepared.known


@eqx.filter_jit
def _products(problem: Problem, u, ways: Float[Array, "rows dofs"]) -> Array:
    """The tangent times each of `ways`: how the force of the body changes along it."""

    def product(way):
        way = way.reshape(u.shape)
        return jax.jvp(lambda u: residual(problem, u), (u,), (way,))[1].ravel()

    return jax.vmap(product)(ways)


class _Tangent:
    """K^-1 of a tangent with supports, as a `LinearMap`; it is its own transpose."""

    def __init__(
        self,
        system: sparse.SparseSymmetric,
        matrix: Float[Array, " nnz"],
        known: Bool[Array, " dofs"],
        shape: tuple[int, ...],
    ):
        self.system, self.matrix, self.known = system, matrix, known
        self.inputs = self.outputs = (jax.ShapeDtypeStruct(shape, matrix.dtype),)

    def push(self, *rates):
        (rows,) = rates
        free = jnp.where(self.known[None], jnp.zeros_like(rows), rows)
        solve = jax.vmap(lambda b: sparse.solve(self.system, self.matrix, b))
        return (jnp.where(self.known[None], jnp.zeros_like(rows), solve(free)),)

    def push_now(self, *rates):
        (rows,) = rates
        free = np.where(self.known, 0.0, rows)
        found = self.system.solver.solve(np.asarray(self.matrix), free)
        return (jnp.asarray(np.where(self.known, 0.0, found)),)

    def pull(self, *changes):
        return self.push(*changes)

    def pull_now(self, *changes):
        return self.push_now(*changes)

    def solved(self, rows):
        """The image of rows without a derivative."""
        move = self.push if is_traced((self.matrix, rows)) else self.push_now
        return move(rows)[0]
