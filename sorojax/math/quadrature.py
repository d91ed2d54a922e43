"""Gauss-Legendre quadrature on [0, 1] and spectral integration between its nodes.

Everything here depends on a node count only, so it is computed on the host, cached,
and enters a program as a constant.
"""

import functools
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

Values: TypeAlias = np.ndarray | jax.Array


def legendre_values(s: Values, degree: int) -> Values:
    """Shifted Legendre polynomials P_0..P_degree at `s` in [0, 1], (degree + 1, points)."""
    x = 2 * s - 1
    rows = [x * 0 + 1, x]
    for m in range(1, degree):
        rows.append(((2 * m + 1) * x * rows[m] - m * rows[m - 1]) / (m + 1))
    return _stack(rows[: degree + 1])


def chebyshev_values(s: Values, degree: int) -> Values:
    """Shifted Chebyshev polynomials T_0..T_degree at `s` in [0, 1], (degree + 1, points)."""
    x = 2 * s - 1
    rows = [x * 0 + 1, x]
    for _ in range(1, degree):
        rows.append(2 * x * rows[-1] - rows[-2])
    return _stack(rows[: degree + 1])


@functools.lru_cache(maxsize=64)
def gauss_legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights on [0, 1], exact for polynomials of degree 2 count - 1."""
    x, w = np.polynomial.legendre.leggauss(count)
    return _frozen((x + 1) / 2), _frozen(w / 2)


def integration_rows(count: int, s: Values) -> Values:
    """Weights that integrate from 0 to each `s` what is known at `count` Gauss nodes.

    Row k holds the integrals from 0 to s_k of the Lagrange polynomials of the nodes;
    the Legendre form is well conditioned at any count.
    """
    nodes, weights = gauss_legendre(count)
    at_nodes = legendre_values(nodes, count - 1) * weights
    values = legendre_values(s, count)
    # Integral of P_m from -1 to x is (P_{m+1} - P_{m-1}) / (2 m + 1); for m = 0, x + 1.
    below = [-values[0], *values[: count - 1]]
    rises = _stack([values[m + 1] - below[m] for m in range(count)])
    at_nodes = np.asarray(at_nodes, dtype=rises.dtype)
    return rises.T @ at_nodes / 2


@functools.lru_cache(maxsize=64)
def integration_matrix(count: int) -> np.ndarray:
    """Integrals from 0 to each Gauss node, (count, count)."""
    return _frozen(np.asarray(integration_rows(count, gauss_legendre(count)[0])))


def _stack(rows: list) -> Any:
    return jnp.stack(rows) if isinstance(rows[0], jax.Array) else np.stack(rows)


def _frozen(values: np.ndarray) -> np.ndarray:
    values.flags.writeable = False
    return values
