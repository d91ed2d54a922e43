"""How eigenvalues and shapes move with the numbers of a problem.

Reference: Nelson, "Simplified calculation of eigenvector derivatives", AIAA Journal 14,
1976.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from sorojax._jax.trace_state import is_traced
from sorojax.fem.linear import linearise
from sorojax.fem.mass import mass_matrix
from sorojax.fem.problem import Problem
from sorojax.fem.traced import known_mask, prepare_traced
from sorojax.math import sparse

_APART = 1e-8  # of the larger eigenvalue: below that two modes are no functions by themselves

Find = Callable[[Problem, Array], tuple[Array, Array]]


class _Call:
    """A search with all that is no number; compared by identity, so it may be a parameter."""

    def __init__(self, where: str, find: Find, rest: Any, tree: Any, massive: bool):
        self.where, self.find, self.rest = where, find, rest
        self.tree, self.massive = tree, massive

    def inputs(self, leaves) -> tuple[Problem, Array]:
        return eqx.combine(jax.tree.unflatten(self.tree, leaves), self.rest)

    def moving(self, leaves, dots) -> tuple[Any, Any, Any]:
        """The numbers that move, all else, and how they move."""
        moves = [not isinstance(dot, SymbolicZero) for dot in dots]

        def pick(values, wanted):
            kept = [x if m == wanted else None for x, m in zip(values, moves, strict=True)]
            return jax.tree.unflatten(self.tree, kept)

        rest = eqx.combine(pick(leaves, False), self.rest)
        return pick(leaves, True), rest, pick(dots, True)


def differentiable(
    where: str, find: Find, problem: Problem, u: Float[Array, "nodes dim"], massive: bool
) -> tuple[Float[Array, " modes"], Float[Array, "modes nodes dim"]]:
    """`find(problem, u)`, eigenvalues and shapes, with derivatives in every number of both.

    Each shape takes one factorisation for all directions. Modes of one eigenvalue have no
    derivative by themselves: NaN.

    Raises:
        ValueError: Inside `jit` and `vmap`, where there are no numbers to search with.
    """
    moving, rest = eqx.partition((problem, u), eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(moving)
    return _found(_Call(where, find, rest, tree, massive), leaves)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _found(call: _Call, leaves):
    if is_traced(leaves):
        raise ValueError(
            f"{call.where}: called inside jit or vmap, need concrete numbers. Call it outside; "
            "grad, jvp and jacfwd of it are fine."
        )
    return call.find(*call.inputs(leaves))


class _Pair(NamedTuple):
    """Values of K and M, and how they move."""

    K: Array
    M: Array
    dK: Array
    dM: Array


def _derivative(call: _Call, primals, tangents):
    (leaves,), (dots,) = primals, tangents
    eigenvalues, shapes = _found(call, leaves)
    problem, _ = call.inputs(leaves)
    moving, rest, dot = call.moving(leaves, dots)

    def matrices(moving):
        return _matrices(moving, rest, call.massive)

    (K, M), (dK, dM) = jax.jvp(matrices, (moving,), (dot,))
    known = known_mask(problem.supports, *shapes.shape[1:])
    pair, moves = _Pair(K, M, dK, dM), []
    for k in range(len(eigenvalues)):
        shape = shapes[k].ravel()
        moves.append(_moved(problem.space.system, pair, known, eigenvalues[k], shape))
    slopes, vectors = (jnp.stack(column) for column in zip(*moves, strict=True))
    alone = _alone(eigenvalues)
    vectors = vectors.reshape(shapes.shape) * alone[:, None, None]
    return (eigenvalues, shapes), (slopes * alone, vectors)


_found.defjvp(_derivative, symbolic_zeros=True)


@eqx.filter_jit
def _matrices(moving, rest, massive: bool) -> tuple[Array, Array]:
    """Values of K, and of M or the identity."""
    problem, u = eqx.combine(moving, rest)
    system = problem.space.system
    K = linearise(problem, prepare_traced(problem), u, u).values
    if massive:
        return K, mass_matrix(problem)
    return K, jnp.where(system.rows == system.cols, jnp.ones_like(K), jnp.zeros_like(K))


def _moved(system: sparse.SparseSymmetric, pair: _Pair, known, value, shape):
    """How one eigenvalue and its shape of unit mass move."""

    def product(values, x):
        return sparse.product(system, values, x)

    change = product(pair.dK, shape) - value * product(pair.dM, shape)
    change = jnp.where(known, jnp.zeros_like(change), change)
    slope = shape @ change
    weight = product(pair.M, shape)
    # the largest entry stays: what is left of K - value M is regular
    fixed = known.at[jnp.argmax(jnp.abs(shape))].set(True)
    matrix = _fix(system, pair.K - value * pair.M, fixed)
    rhs = jnp.where(fixed, jnp.zeros_like(change), slope * weight - change)
    part = sparse.solve(system, matrix, rhs)
    along = weight @ part + shape @ product(pair.dM, shape) / 2
    return slope, part - along * shape


_fix = jax.jit(sparse.fix)


def _alone(eigenvalues: Float[Array, " modes"]) -> Float[Array, " modes"]:
    """One for eigenvalues apart from all others, NaN for the rest."""
    gap = jnp.abs(eigenvalues[:, None] - eigenvalues[None])
    size = jnp.maximum(jnp.abs(eigenvalues)[:, None], jnp.abs(eigenvalues)[None])
    other = ~jnp.eye(len(eigenvalues), dtype=bool)
    crowded = jnp.any(other & (gap <= _APART * size), axis=1)
    return jnp.where(crowded, jnp.nan, jnp.ones_like(eigenvalues))
