"""Finite-strain kinematics written on the entries of a tensor.

A tensor is a nested tuple of its nine entries, each an array over any number of
points (or a Python float). Entries that are the Python number 0.0 are absent:
products with them vanish at trace time, so a planar state pays for no third
dimension.

Reference: Bonet & Wood, Nonlinear Continuum Mechanics for Finite Element Analysis,
2008, chapters 4 and 6.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

Entry = Any  # float or array over points
Tensor = tuple[tuple[Entry, Entry, Entry], ...]


def absent(entry: Entry) -> bool:
    return isinstance(entry, float) and entry == 0.0


def times(a: Entry, b: Entry) -> Entry:
    return 0.0 if absent(a) or absent(b) else a * b


def plus(a: Entry, b: Entry) -> Entry:
    if absent(a):
        return b
    return a if absent(b) else a + b


def minus(a: Entry, b: Entry) -> Entry:
    return a if absent(b) else a - b


def from_matrix(F: Float[Array, "3 3"]) -> Tensor:
    """Entries of a matrix."""
    return tuple(tuple(F[i, j] for j in range(3)) for i in range(3))  # type: ignore


def determinant(F: Tensor) -> Entry:
    """J = det F, the volume ratio."""
    (a, b, c), (d, e, f), (g, h, i) = F
    first = times(a, minus(times(e, i), times(f, h)))
    second = times(b, minus(times(d, i), times(f, g)))
    third = times(c, minus(times(d, h), times(e, g)))
    return plus(minus(first, second), third)


def square_norm(F: Tensor) -> Entry:
    """I1 = tr(F'F)."""
    total: Entry = 0.0
    for row in F:
        for entry in row:
            total = plus(total, times(entry, entry))
    return total


def isochoric_first_invariant(F: Tensor) -> Entry:
    """J^(-2/3) tr(F'F)."""
    return jnp.exp(-2 / 3 * jnp.log(determinant(F))) * square_norm(F)
