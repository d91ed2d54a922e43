"""Small dense products and symmetric solves, and the inverse cube root (a first guess from the
bits of a number, then Householder's iteration).

References: Lomont, "Fast inverse square root", 2003, for the guess; Householder, "The
Numerical Treatment of a Single Nonlinear Equation", 1970, for steps of higher order.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.scipy
from jaxtyping import Array, Float

from sorojax.math.quadrature import polynomial

UNROLL_BELOW = 9  # written out, LDL' beats a LAPACK call up to 8 unknowns


@jax.custom_jvp
def solve_symmetric(
    matrix: Float[Array, "dof dof"], right: Float[Array, " dof"]
) -> Float[Array, " dof"]:
    """x with `matrix` x = `right`, `matrix` symmetric positive definite.

    The derivative of M^-1 r is M^-1 (dr - dM x).
    """
    solve = _ldl(matrix) if right.shape[0] < UNROLL_BELOW else _cholesky(matrix)
    return _batch_first(solve(right))


@solve_symmetric.defjvp
def _solve_symmetric_jvp(primals, tangents):
    return jax.jvp(_solved, primals, tangents)


def _batch_first(x: Array) -> Array:
    """`x`, with any axis of `jax.vmap` as the first one.

    A function with a rule and that rule must have it in one place: where they do not, JAX
    (0.10.2 and 0.12.0.1 were tried) confuses axes in derivatives of `vmap(jit(f))`, without
    an error where the sizes allow it.
    """
    return jnp.squeeze(x[..., None], -1)


def _solved(matrix: Array, right: Array) -> Array:
    """`solve_symmetric` in programs of derivatives, where several solves share a factor.

    Of a few unknowns that is the inverse, by a loop: what is written out is long to compile.
    """
    fixed = jax.lax.stop_gradient(matrix)
    if right.shape[0] < UNROLL_BELOW:
        inverse = _eliminated(fixed, jnp.eye(right.shape[0], dtype=matrix.dtype))
        solve = functools.partial(jnp.matmul, inverse)
    else:
        solve = _cholesky(fixed)
    solution = jax.lax.custom_linear_solve(
        lambda x: matrix @ x, right, lambda _, r: solve(r), symmetric=True
    )
    return _batch_first(solution)


def solve_columns(
    matrix: Float[Array, "dof dof"], right: Float[Array, "dof columns"]
) -> Float[Array, "dof columns"]:
    """`solve_symmetric` for every column of `right`."""
    fixed = jax.lax.stop_gradient(matrix)
    if matrix.shape[0] < UNROLL_BELOW:
        solve = functools.partial(_eliminated, fixed)
    else:
        solve = _cholesky(fixed)
    return jax.lax.custom_linear_solve(
        lambda x: matrix @ x, right, lambda _, r: solve(r), symmetric=True
    )


def _eliminated(matrix: Array, right: Array) -> Array:
    """Gauss and Jordan's elimination: a loop is a quarter of what writing it out costs."""
    n = matrix.shape[0]

    def clear(k, both):
        row = both[k] / both[k, k]
        rest = both - both[:, k, None] * row[None]
        return jnp.where((jnp.arange(n) == k)[:, None], row[None], rest)

    return jax.lax.fori_loop(0, n, clear, jnp.concatenate([matrix, right], axis=1))[:, n:]


@jax.custom_jvp
def product(
    left: Float[Array, "rows terms"], right: Float[Array, "terms columns"]
) -> Float[Array, "rows columns"]:
    """`left @ right`, written out up to 8 terms: less than a library call costs.

    For few columns; XLA repeats the sums in every entry that reads them. Programs of
    derivatives hold plain products, as sums would take long to compile.
    """
    if not 0 < left.shape[1] < UNROLL_BELOW:
        return _batch_first(left @ right)
    both = zip(jnp.unstack(left, axis=1), jnp.unstack(right), strict=True)
    return functools.reduce(jnp.add, (column[:, None] * row[None] for column, row in both))


@product.defjvp
def _product_jvp(primals, tangents):
    (left, right), (change, turn) = primals, tangents
    return _batch_first(left @ right), change @ right + left @ turn


def _cholesky(matrix: Array) -> Callable[[Array], Array]:
    factor, lower = jax.scipy.linalg.cho_factor(matrix)
    return lambda right: jax.scipy.linalg.cho_solve((factor, lower), right)


def _ldl(matrix: Array) -> Callable[[Array], Array]:
    n = matrix.shape[0]
    lower = [[matrix[0, 0]] * n for _ in range(n)]
    pivot, inverse = [matrix[0, 0]] * n, [matrix[0, 0]] * n
    for j in range(n):
        scaled = [lower[j][k] * pivot[k] for k in range(j)]
        pivot[j] = matrix[j, j] - _dot(lower[j], scaled)
        inverse[j] = 1 / pivot[j]
        for i in range(j + 1, n):
            lower[i][j] = (matrix[i, j] - _dot(lower[i], scaled)) * inverse[j]

    def solve(right: Array) -> Array:
        x = [right[i] for i in range(n)]
        for i in range(n):
            x[i] = x[i] - _dot(lower[i], x[:i])
        x = [value * scale for value, scale in zip(x, inverse, strict=True)]
        for i in reversed(range(n)):
            below = [lower[k][i] for k in range(i + 1, n)]
            x[i] = x[i] - _dot(below, x[i + 1 :])
        return jnp.stack(x)

    return solve


def _dot(a: list[Array], b: list[Array]) -> Array | float:
    """Sum of products over the shorter list; 0.0 when empty."""
    return sum((x * y for x, y in zip(a, b, strict=False)), start=0.0)


# The inverse cube root, by a first guess from the bits of a number and Newton-like steps


# Of (1 - e)^(-1/3), by powers of e.
_SERIES = (1 / 3, 2 / 9, 14 / 81, 35 / 243, 91 / 729)
# Sign, exponent and the first bits behind the point of 1.0, which are linear in the logarithm
# nearly; what is taken off makes the guess err by at most 3.5 % on both sides.
_ONE = {"float64": (0x3FF00000, 71_500), "float32": (0x3F800000, 572_000)}


@jax.custom_jvp
def inverse_cube_root(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """x^(-1/3) to one unit in the last place; NaN unless x is a normal number above zero.

    A few operations on all entries, where a library is called for each otherwise: a sixth of
    the time of a power by exponential and logarithm. Derivatives are powers of the root.
    """
    x = jnp.asarray(x)
    if x.dtype.name not in _ONE:
        return x ** (-1 / 3)
    guess = _guess(x)
    # from the left: x times one root is far from the ends of the numbers, a cube is not
    rest = 1 - x * guess * guess * guess
    near = guess + guess * rest * polynomial(_SERIES, rest)
    rest = 1 - x * near * near * near
    # XLA repeats cheap operations for every use of theirs, but no division: so it ends in one
    return jnp.where(x > 0, near, jnp.nan) / (1 - rest * (1 / 3 + rest / 9))


@inverse_cube_root.defjvp
def _rate(primals, tangents):
    root = inverse_cube_root(*primals)
    square = root * root
    return root, -1 / 3 * (square * square) * tangents[0]


def _guess(x: Array) -> Array:
    """By a third of the negative of the bits, as of a logarithm; to 3.5 %."""
    whole, half = (jnp.int64, 32) if x.dtype == jnp.float64 else (jnp.int32, 0)
    one, less = _ONE[x.dtype.name]
    high = (jax.lax.bitcast_convert_type(x, whole) >> half).astype(jnp.int32)
    third = (4 / 3 * one - less) - high.astype(x.dtype) / 3
    return jax.lax.bitcast_convert_type(third.astype(whole) << half, x.dtype)


def least_squares(
    matrix: Float[Array, "rows columns"], right: Float[Array, "rows *more"]
) -> Float[Array, "columns *more"]:
    """x of least |`matrix` x - `right`| for columns that do not depend on each other, by QR of
    columns of unit length; differentiable in both."""
    size = jnp.sqrt(jnp.sum(matrix**2, axis=0, keepdims=True))
    Q, R = jnp.linalg.qr(matrix / size)
    found = jax.scipy.linalg.solve_triangular(R, Q.T @ right)
    return found / size.reshape(-1, *(1,) * (right.ndim - 1))
