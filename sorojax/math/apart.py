"""Work that XLA keeps apart from what uses it.

On the CPU, XLA drops optimization barriers before it fuses loops; the work of a producer is
then repeated in every entry that reads it, and a loop that holds the slice of an outer loop
is not vectorised. What crosses a branch is written to memory once.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

Answer = TypeVar("Answer")
Alone = Callable[[Callable[[], Any]], Any]


def apart(always: Bool[Array, ""]) -> Alone:
    """A function that calls `work()` by itself. `always` is true, but known at run time only:
    where it is not, the answer is NaN."""

    def alone(work: Callable[[], Answer]) -> Answer:
        shapes = jax.eval_shape(work)

        def never() -> Any:
            return jax.tree.map(lambda s: jnp.full(s.shape, jnp.nan, s.dtype), shapes)

        return jax.lax.cond(always, work, never)

    return alone
