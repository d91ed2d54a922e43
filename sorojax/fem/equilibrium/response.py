"""How a body at an equilibrium answers small forces."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.equilibrium.jit import prepare_traced
from sorojax.fem.equilibrium.linear import linearise
from sorojax.fem.problem import Problem, residual
from sorojax.math.linalg import sparse


@eqx.filter_jit
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
    system, fixed = problem.space.system, jax.lax.stop_gradient(problem)
    prepared = prepare_traced(fixed)
    held = jax.lax.stop_gradient(u)
    matrix = sparse.fix(system, linearise(fixed, prepared, held, held).values, prepared.known)

    def free(rows):
        return jnp.where(prepared.known[None], jnp.zeros_like(rows), rows)

    def solve(rows):
        return jax.vmap(lambda b: sparse.solve(system, matrix, b))(free(rows))

    def product(way):
        way = way.reshape(u.shape)
        return jax.jvp(lambda u: residual(problem, u), (u,), (way,))[1].ravel()

    found = jax.lax.stop_gradient(solve(forces))
    return found + solve(forces - jax.vmap(product)(found))
