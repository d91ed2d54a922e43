"""Gauss-Legendre quadrature on [0, 1] and spectral integration between its nodes.

A rule is a node count, or a `Quadrature` where the integrand is smooth between known
breaks only. Everything here depends on the rule alone, so it is computed on the host,
cached, and enters a program as a constant.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Values: TypeAlias = np.ndarray | jax.Array


class Quadrature(NamedTuple):
    """Gauss nodes on each of the spans into which `breaks` divide [0, 1].

    Attributes:
        count: Nodes of a span.
        breaks: Where spans meet, rising strictly inside (0, 1).
    """

    count: int
    breaks: tuple[float, ...] = ()

    @property
    def edges(self) -> np.ndarray:
        """Ends of the spans, 0 and 1 included."""
        return np.array([0.0, *self.breaks, 1.0])

    @property
    def num_nodes(self) -> int:
        return self.count * (len(self.breaks) + 1)

    @property
    def cell_ends(self) -> np.ndarray:
        """Nodes and breaks, rising: ends of cells in which an integrand is smooth."""
        return np.sort(np.concatenate([gauss_legendre(self)[0], self.breaks]))

    @property
    def node_cells(self) -> np.ndarray:
        """The cell that ends at each node."""
        return np.searchsorted(self.cell_ends, gauss_legendre(self)[0])


Rule: TypeAlias = int | Quadrature


def legendre_values(s: Values, degree: int) -> Values:
    """Shifted Legendre polynomials P_0..P_degree at `s` in [0, 1], (degree + 1, points)."""
    x = 2 * s - 1
    rows = [x * 0 + 1, x]
    for m in range(1, degree):
        rows.append(((2 * m + 1) * x * rows[m] - m * rows[m - 1]) / (m + 1))
    return array_module(s).stack(rows[: degree + 1])


def chebyshev_values(s: Values, degree: int) -> Values:
    """Shifted Chebyshev polynomials T_0..T_degree at `s` in [0, 1], (degree + 1, points)."""
    x = 2 * s - 1
    rows = [x * 0 + 1, x]
    for _ in range(1, degree):
        rows.append(2 * x * rows[-1] - rows[-2])
    return array_module(s).stack(rows[: degree + 1])


@functools.lru_cache(maxsize=64)
def gauss_legendre(rule: Rule) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights on [0, 1], exact for polynomials of degree 2 count - 1 per span."""
    if isinstance(rule, int):
        x, w = np.polynomial.legendre.leggauss(rule)
        return _frozen((x + 1) / 2), _frozen(w / 2)
    x, w = gauss_legendre(rule.count)
    starts, sizes = rule.edges[:-1, None], np.diff(rule.edges)[:, None]
    return _frozen((starts + sizes * x).ravel()), _frozen((sizes * w).ravel())


def integration_rows(rule: Rule, s: Values) -> Values:
    """Weights that integrate from 0 to each `s` what is known at the nodes of `rule`.

    Row k holds the integrals from 0 to s_k of the Lagrange polynomials of the nodes;
    the Legendre form is well conditioned at any count.
    """
    if isinstance(rule, int):
        return _integration_rows(rule, s)
    if not rule.breaks:
        return _integration_rows(rule.count, s)
    sizes = np.diff(rule.edges)
    parts = [
        float(size) * _integration_rows(rule.count, local)
        for size, local in zip(sizes, _local(rule, s), strict=True)
    ]
    return array_module(s).concatenate(parts, axis=1)


def interpolation_rows(rule: Rule, s: Values) -> Values:
    """Weights that take what is known at the nodes of `rule` to each `s`.

    Row k holds the Lagrange polynomials of the nodes at s_k; a break belongs to the span
    behind it.
    """
    if isinstance(rule, int):
        return _interpolation_rows(rule, s)
    if not rule.breaks:
        return _interpolation_rows(rule.count, s)
    edges, parts = rule.edges, []
    for k, local in enumerate(_local(rule, s)):
        inside = (s >= edges[k]) if k else (s < edges[1])
        if 0 < k < len(rule.breaks):
            inside = inside & (s < edges[k + 1])
        rows = _interpolation_rows(rule.count, local)
        parts.append(rows * inside[:, None].astype(rows.dtype))
    return array_module(s).concatenate(parts, axis=1)


@functools.lru_cache(maxsize=64)
def integration_matrix(rule: Rule) -> np.ndarray:
    """Integrals from 0 to each node, (nodes, nodes)."""
    return _frozen(np.asarray(integration_rows(rule, gauss_legendre(rule)[0])))


def _integration_rows(count: int, s: Values) -> Values:
    nodes, weights = gauss_legendre(count)
    at_nodes = legendre_values(nodes, count - 1) * weights
    values = legendre_values(s, count)
    # Integral of P_m from -1 to x is (P_{m+1} - P_{m-1}) / (2 m + 1); for m = 0, x + 1.
    below = [-values[0], *values[: count - 1]]
    rises = array_module(s).stack([values[m + 1] - below[m] for m in range(count)])
    at_nodes = np.asarray(at_nodes, dtype=rises.dtype)
    return rises.T @ at_nodes / 2


def _interpolation_rows(count: int, s: Values) -> Values:
    nodes, weights = gauss_legendre(count)
    scale = 2 * np.arange(count) + 1.0
    at_nodes = scale[:, None] * legendre_values(nodes, count - 1) * weights
    values = legendre_values(s, count - 1)
    return values.T @ np.asarray(at_nodes, dtype=values.dtype)


def _local(rule: Quadrature, s: Values) -> list[Values]:
    """Coordinates of `s` in each span, held inside it except beyond 0 and 1."""
    edges, last = rule.edges, len(rule.breaks)
    xp = array_module(s)
    found = []
    for k in range(last + 1):
        local = (s - float(edges[k])) / float(edges[k + 1] - edges[k])
        local = xp.maximum(local, 0.0) if k else local
        found.append(xp.minimum(local, 1.0) if k < last else local)
    return found


def array_module(values: Any) -> Any:
    """What makes arrays of the kind of `values`: `jax.numpy` or NumPy."""
    return jnp if isinstance(values, jax.Array) else np


def _frozen(values: np.ndarray) -> np.ndarray:
    values.flags.writeable = False
    return values


# Polynomials of a few given coefficients


def polynomial(
    coefficients: Sequence[float], x: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Sum of `coefficients[k] * x**k`, by Horner's rule."""
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value
