"""How a body at an equilibrium answers small forces."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax._jax.jit import once
from sorojax._jax.trace_state import evaluated_now, is_traced
from sorojax._types import from_host
from sorojax.fem.equilibrium.jit import prepare_traced
from sorojax.fem.equilibrium.lanes import moving_part
from sorojax.fem.equilibrium.linear import Prepared, linearise, prepare
from sorojax.fem.problem import Problem, potential_energy, residual, unsupported
from sorojax.math.linalg import sparse
from sorojax.math.linear_map import pushed


def tangent_solve(
    problem: Problem,
    u: Float[Array, "nodes dim"],
    forces: Float[Array, "rows dofs"],
    prepared: Prepared | None = None,
) -> Float[Array, "rows dofs"]:
    """Displacements x = K^-1 f [m] by small forces f [N] at the equilibrium `u`, zero where
    supports hold the body; K is the tangent there.

    Differentiable, forward and reverse, in the forces, in `u` and in every number of the
    problem: dx = K^-1 (df - dK x). So K is factored without a derivative of its assembly, and
    only the products K x, derivatives of the force of the body, are differentiated.
    `prepared` is that of a concrete problem, for many states of one body.
    """
    fixed, held, right = jax.lax.stop_gradient((problem, u, forces))
    with evaluated_now(fixed, held, right):
        if is_traced((fixed, held, right)):
            matrix, known = _tangent(fixed, held)
        else:
            matrix, known = _tangent_on_host(fixed, held, prepared)
        tangent = _Tangent(fixed.space.system, matrix, known, forces.shape)
        found = tangent.solved(right)
    if not is_traced((problem, u, forces)):
        return found
    if is_traced((fixed, held, right)):
        return _solved(tangent, problem, u, forces)
    numbers, rest = eqx.partition((unsupported(problem), u, forces), eqx.is_inexact_array)
    return _answers(_Answers(tangent, rest, found), numbers)


class _Answers(NamedTuple):
    """What was solved; `rest` completes the numbers that have derivatives."""

    tangent: "_Tangent"
    rest: Any
    found: Float[Array, "rows dofs"]

    def __hash__(self):
        return id(self.found)

    def __eq__(self, other):
        return self is other


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _answers(of: _Answers, numbers) -> Float[Array, "rows dofs"]:
    return of.found


def _answers_derivative(of: _Answers, primals, tangents):
    moving, still, rates = moving_part(primals[0], tangents[0])
    if is_traced(moving):  # within another derivative
        rest = eqx.combine(still, of.rest)
        answers = functools.partial(_solved, of.tangent)
        return jax.jvp(lambda x: answers(*eqx.combine(x, rest)), (moving,), (rates,))
    leaves, tree = jax.tree.flatten(rates)
    return of.found, pushed(leaves, _Slope(of, moving, eqx.combine(still, of.rest), tree))[0]


_answers.defjvp(_answers_derivative, symbolic_zeros=True)


def _solved(tangent: "_Tangent", problem: Problem, u, forces) -> Float[Array, "rows dofs"]:
    """The answers by operations that have derivatives of every order."""
    held = tangent.known[None]

    def product(x):
        free = jnp.where(held, jnp.zeros_like(x), x)
        return jnp.where(held, x, _products(problem, u, free))

    def solve(_, b):
        return jnp.where(held, b, tangent.push(b)[0])

    free = jnp.where(held, jnp.zeros_like(forces), forces)
    return jax.lax.custom_linear_solve(product, free, solve, symmetric=True)


class _Slope:
    """The derivative of the answers by the numbers that move, as a `LinearMap`."""

    def __init__(self, of: _Answers, moving, rest, tree):
        self._tangent, self._found, self._tree = of.tangent, of.found, tree
        self._moving, self._rest = moving, rest
        self.inputs, self.outputs = jax.tree.leaves(moving), of.tangent.outputs

    def push(self, *rates):
        return self._tangent.push(self._unbalance(rates))

    def push_now(self, *rates):
        return self._tangent.push_now(self._unbalance(rates))

    def pull(self, *changes):
        return self._pulled(self._tangent.pull(*changes)[0])

    def pull_now(self, *changes):
        return self._pulled(self._tangent.pull_now(*changes)[0])

    def _unbalance(self, rates):
        rates = jax.tree.unflatten(self._tree, rates)
        return _unbalance(self._moving, self._rest, rates, self._found)

    def _pulled(self, works):
        return jax.tree.leaves(_pulled(self._moving, self._rest, self._found, works))


@once
def _unbalance(moving, rest, rates, found) -> Float[Array, "rows dofs"]:
    """df - dK x."""

    def unbalanced(moving):
        problem, u, forces = eqx.combine(moving, rest)
        return forces - _products(problem, u, found)

    return jax.jvp(unbalanced, (moving,), (rates,))[1]


@once
def _pulled(moving, rest, found, works: Float[Array, "rows dofs"]):
    """The derivatives of y (f - K x) by the numbers that move: of products with y = `works`
    and x = `found` alone, as K is the second derivative of an energy."""

    *body, forces = moving

    def work(body, x, y):
        problem, u = eqx.combine(tuple(body), rest[:2])
        x, y = (way.reshape(u.shape) for way in (x, y))

        def slope(u):
            return jax.jvp(lambda u: potential_energy(problem, u), (u,), (x,))[1]

        return -jax.jvp(slope, (u,), (y,))[1]

    def add(total, ways):
        return jax.tree.map(jnp.add, total, jax.grad(work)(body, *ways)), None

    # row by row: the program holds one, and its arrays stay in the cache
    start = jax.tree.map(jnp.zeros_like, body)
    total, _ = jax.lax.scan(add, start, (found, works))
    return *total, None if forces is None else works


def _tangent_on_host(problem: Problem, u, prepared: Prepared | None):
    """The same by the program that the search for equilibria has."""
    prepared = prepare(problem) if prepared is None else prepared
    values, known = linearise(problem, prepared, u, u).values, np.asarray(prepared.known)
    return sparse.fixed_on_host(problem.space.system, np.asarray(values), known), known


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
        matrix: Float[Array | np.ndarray, " nnz"],
        known: Bool[Array | np.ndarray, " dofs"],
        shape: tuple[int, ...],
    ):
        self.system, self.matrix, self.known = system, matrix, known
        self.inputs = self.outputs = (jax.ShapeDtypeStruct(shape, matrix.dtype),)

    def push(self, *rates):
        (rows,) = rates
        free = jnp.where(self.known[None], jnp.zeros_like(rows), rows)
        matrix = from_host(self.matrix)
        solve = jax.vmap(lambda b: sparse.solve(self.system, matrix, b))
        return (jnp.where(self.known[None], jnp.zeros_like(rows), solve(free)),)

    def push_now(self, *rates):
        (rows,) = rates
        free = np.where(self.known, 0.0, rows)
        found = self.system.solver.solve(np.asarray(self.matrix), free)
        return (from_host(np.where(self.known, 0.0, found)),)

    def pull(self, *changes):
        return self.push(*changes)

    def pull_now(self, *changes):
        return self.push_now(*changes)

    def solved(self, rows):
        """The image of rows without a derivative."""
        move = self.push if is_traced((self.matrix, rows)) else self.push_now
        return move(rows)[0]
