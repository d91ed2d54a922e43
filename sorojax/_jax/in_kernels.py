"""What kernels compute by themselves, where a library is called otherwise: sine and cosine by
polynomials of what is left of an angle beside its quarter turns, factors of matrices and
triangular solutions column by column, the order of a few integers.

Reference: Cody, Waite, "Software Manual for the Elementary Functions", 1980, chapter 8, for
sine and cosine; Golub, Van Loan, "Matrix Computations", 2013, chapters 3 and 4.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

# Taylor coefficients: up to pi/4 the first term left out is 2e-17.
_SINE = [(-1.0) ** k / float(np.prod(np.arange(1.0, 2 * k + 2))) for k in range(9)]
_COSINE = [(-1.0) ** k / float(np.prod(np.arange(1.0, 2 * k + 1))) for k in range(9)]
# pi/2 in parts of 33 bits, so that multiples of up to a million are exact
_PARTS = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)


def sine(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """To 3e-16 up to 1e5 rad, beyond that of an angle with a relative error of 1e-16; a few
    operations on all entries, where a library is called for each otherwise."""
    return _of_quarter(*_reduced(angle))


def cosine(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """As `sine`, and by the same numbers."""
    turns, rest = _reduced(angle)
    return _of_quarter(turns + 1, rest)


def _reduced(angle: Array) -> tuple[Array, Array]:
    """Nearest number of quarter turns, and the angle left."""
    turns = jnp.round(angle * (2 / np.pi))
    rest = angle
    for part in _PARTS:
        rest = rest - turns * part
    return turns, jnp.clip(rest, -1.0, 1.0)


def _of_quarter(turns: Array, rest: Array) -> Array:
    """Sine of `turns` quarter turns and `rest`."""
    square = rest * rest
    quarter = turns - 4 * jnp.floor(turns / 4)
    odd = (quarter == 1) | (quarter == 3)
    size = jnp.where(odd, _polynomial(_COSINE, square), rest * _polynomial(_SINE, square))
    return jnp.where(quarter >= 2, -size, size)


def _polynomial(coefficients: Sequence[float], x: Array) -> Array:
    """Sum of `coefficients[k] * x**k`, by Horner's rule."""
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


def cholesky(matrix: Float[Array, "rows rows"]) -> Float[Array, "rows rows"]:
    """The lower factor of a symmetric positive definite matrix, of which the lower half is
    read; NaN where it is none."""
    rows = jnp.arange(matrix.shape[0])

    def column(k: Array, left: Array) -> Array:
        found = jnp.where(rows >= k, left[:, k] / jnp.sqrt(left[k, k]), 0.0)
        rest = left - found[:, None] * found[None]
        return jnp.where(rows == k, found[:, None], jnp.where(rows > k, rest, left))

    return jnp.tril(jax.lax.fori_loop(0, matrix.shape[0], column, matrix))


def triangular_solve(
    matrix: Float[Array, "rows rows"],
    right: Float[Array, "rows columns"],
    *,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    unit_diagonal: bool,
) -> Float[Array, "rows columns"]:
    """As `jax.lax.linalg.triangular_solve`, of real numbers."""
    if not left_side:
        turned = {"left_side": True, "lower": lower, "unit_diagonal": unit_diagonal}
        return triangular_solve(matrix, right.T, transpose_a=not transpose_a, **turned).T
    if transpose_a:
        matrix, lower = matrix.T, not lower
    count = matrix.shape[0]
    rows = jnp.arange(count)

    def row(turn: Array, left: Array) -> Array:
        k = turn if lower else count - 1 - turn
        found = left[k] if unit_diagonal else left[k] / matrix[k, k]
        after = rows > k if lower else rows < k
        column = jnp.where(after, matrix[:, k], 0.0)
        return jnp.where((rows == k)[:, None], found, left - column[:, None] * found[None])

    return jax.lax.fori_loop(0, count, row, right)


def lu(
    matrix: Float[Array, "rows rows"],
) -> tuple[Float[Array, "rows rows"], Int[Array, " rows"], Int[Array, " rows"]]:
    """Both factors by partial pivoting, which rows were swapped in turn, and their order."""
    rows = jnp.arange(matrix.shape[0], dtype=jnp.int32)

    def column(k: Array, state: Any) -> Any:
        left, swaps, order = state
        size = jnp.where(rows >= k, jnp.abs(left[:, k]), -1.0)
        best = jnp.argmax(size).astype(jnp.int32)
        turned = jnp.where(rows == k, best, jnp.where(rows == best, k.astype(jnp.int32), rows))
        left, order = left[turned], order[turned]
        below, pivot = (rows > k) & (left[k, k] != 0), left[k, k]
        share = jnp.where(below, left[:, k] / jnp.where(pivot != 0, pivot, 1.0), 0.0)
        rest = left - share[:, None] * left[k][None]
        kept = jnp.where((rows == k)[None] & below[:, None], share[:, None], left)
        left = jnp.where((rows > k)[None], rest, kept)
        return left, jnp.where(rows == k, best, swaps), order

    return jax.lax.fori_loop(0, matrix.shape[0], column, (matrix, rows, rows))


def sort(keys: Int[Array, " rows"], *others: Array) -> list[Array]:
    """Integers in their order, and what belongs to them; equal ones as they were."""
    rows = jnp.arange(keys.shape[0])
    before = (keys[:, None] > keys[None]) | (
        (keys[:, None] == keys[None]) & (rows[:, None] > rows[None])
    )
    rank = jnp.sum(before, axis=1)
    place = jnp.argmax(rank[None] == rows[:, None], axis=1)
    return [x[place] for x in (keys, *others)]
