"""The nearest of many pieces: a search without derivatives, then one piece with them.

Which piece is nearest does not vary with small changes, so only the winner is
differentiated: a gradient costs one piece, and a tie takes the first.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int


def nearest(
    measure: Callable[..., Array], table: Any, x: tuple[Array, ...]
) -> Int[Array, "..."]:
    """Index of the row of `table` (a pytree of arrays) with the least `measure(row, *x)`."""
    return scan_rows(measure, table, x, lambda _, *x: jnp.zeros_like(x[0]))[0]


def scan_rows(
    measure: Callable[..., Array], table: Any, x: tuple[Array, ...], extra: Callable
) -> tuple[Int[Array, "..."], Array]:
    """Nearest row and the sum of `extra(row, *x)` over all rows, in one pass."""
    table, x = jax.lax.stop_gradient((table, x))
    count = jax.tree.leaves(table)[0].shape[0]
    start = (
        jnp.full_like(x[0], jnp.inf),
        jnp.zeros(x[0].shape, jnp.int32),
        jnp.zeros_like(x[0]),
    )

    def visit(i, state):
        best, index, total = state
        row = jax.tree.map(lambda a: a[i], table)
        value = measure(row, *x)
        closer = value < best
        index = jnp.where(closer, jnp.asarray(i, jnp.int32), index)
        return jnp.where(closer, value, best), index, total + extra(row, *x)

    _, index, total = jax.lax.fori_loop(0, count, visit, start)
    return index, total


def take(table: Any, index: Int[Array, "..."]) -> tuple[tuple[Array, ...], ...]:
    """Rows of `table` at `index`: for each (n, dim) array one array per axis."""
    return tuple(tuple(a[index, i] for i in range(a.shape[1])) for a in table)
