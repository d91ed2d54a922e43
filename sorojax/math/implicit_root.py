"""Roots whose derivative is that of the implicit function, whatever search finds them.

Used in place of `jax.lax.custom_root`, which since jax 0.12 (0.12.0.1 was tried) hands
`tangent_solve` a map whose Jacobian by `jax.jacobian` is wrong, without an error.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

Function = Callable[[Array], Array]


def implicit_root(
    f: Function,
    guess: Array,
    solve: Callable[..., Any],
    tangent_solve: Callable[[Function, Array], Array],
    *,
    has_aux: bool = False,
    has_matrix: bool = False,
) -> Any:
    """The x with f(x) = 0 near `guess`; dx = -f_x^-1 df by the numbers that `f` closes over.

    Args:
        f: Of x, and of any numbers that it closes over.
        guess: Where the search begins; without a derivative.
        solve: Of `f` and `guess`, answers x, or x and more with `has_aux`; not differentiated.
        tangent_solve: Of a linear map and a right-hand side, answers its solution.
        has_aux: Whether `solve` answers a pair, whose second part has no derivative.
        has_matrix: Whether `solve`, of `f`, `guess` and whether there is a derivative, answers
            a pair of all that and a matrix, where there is a derivative f_x at the root.
    """

    def search(guess: Array, at_root: Array) -> tuple[Array, Any, Array | None]:
        found, matrix = solve(f, guess, at_root) if has_matrix else (solve(f, guess), None)
        return (*found, matrix) if has_aux else (found, (), matrix)

    equation, numbers = _opened(f, guess)
    method, constants = _opened(search, guess, jnp.array(False))

    @jax.custom_jvp
    def root(numbers: Any, constants: Any, guess: Array) -> tuple[Array, Any]:
        x, more, _ = method(guess, jnp.array(False), *constants)
        return jax.tree.map(jnp.asarray, (x, more))  # constants are numbers

    @jax.custom_jvp
    def full_root(numbers: Any, constants: Any, guess: Array) -> Any:
        return jax.tree.map(jnp.asarray, method(guess, jnp.array(True), *constants))

    def full_derivative(primals: Any, tangents: Any) -> Any:
        numbers, rates = primals[0], tangents[0]
        x, more, matrix = full_root(*primals)
        moving = [k for k, rate in enumerate(rates) if not isinstance(rate, SymbolicZero)]
        still = jax.tree.map(_still, (more, matrix))
        if not moving:
            return (x, more, matrix), (jnp.zeros_like(x), *still)

        def moved(*values: Array) -> Array:
            own = dict(zip(moving, values, strict=True))
            return equation(x, *(own.get(k, number) for k, number in enumerate(numbers)))

        def linear(rate: Array) -> Array:
            return jax.jvp(lambda x: equation(x, *numbers), (x,), (rate,))[1]

        values, dots = ([each[k] for k in moving] for each in (numbers, rates))
        change = jax.jvp(moved, values, dots)[1]
        if matrix is None:
            return (x, more, None), (-tangent_solve(linear, change), *still)
        return (x, more, matrix), (-_solved_by(matrix, linear, change), *still)

    def derivative(primals: Any, tangents: Any) -> Any:
        (x, more, _), (change, still, _) = full_derivative(primals, tangents)
        return (x, more), (change, still)

    root.defjvp(derivative, symbolic_zeros=True)
    full_root.defjvp(full_derivative, symbolic_zeros=True)
    x, more = root(tuple(numbers), tuple(constants), guess)
    return (x, more) if has_aux else x


def _solved_by(matrix: Array, linear: Function, right: Array) -> Array:
    """x with linear(x) = right by the known `matrix`, with the derivative of `linear`."""
    matrix = jax.lax.stop_gradient(matrix)
    return jax.lax.custom_linear_solve(
        linear,
        right,
        lambda _, right: jnp.linalg.solve(matrix, right),
        lambda _, right: jnp.linalg.solve(matrix.T, right),
    )


def _opened(function: Callable[..., Any], *args: Array) -> tuple[Any, list[Array]]:
    """A function of what `function` closes over too, and these arrays: integers as well, as a
    derivative is taken where those of a trace are gone."""
    closed = eqx.filter_closure_convert(function, *args)
    arrays, rest = eqx.partition(closed, eqx.is_array)
    leaves, tree = jax.tree.flatten(arrays)

    def call(*values: Array) -> Any:
        own, leaves = values[: len(args)], values[len(args) :]
        return eqx.combine(jax.tree.unflatten(tree, leaves), rest)(*own)

    return call, leaves


def matrix_of(linear: Function, like: Array) -> Array:
    """The matrix of a linear map of vectors `like`, column by column in one pass."""
    return jax.vmap(linear, out_axes=1)(jnp.eye(like.shape[0], dtype=like.dtype))


def _still(x: Array) -> Any:
    """A rate of zero."""
    if jnp.issubdtype(x.dtype, jnp.inexact):
        return jnp.zeros_like(x)
    return np.zeros(x.shape, jax.dtypes.float0)
