"""Many items through one verb, in batches that stay in the cache."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from sorojax import _check

CHUNK = 64  # items of a few kB each; more leave the cache of a core


def batched(verb: Callable[..., Any], *, chunk: int = CHUNK) -> Callable[..., Any]:
    """`verb` over the first axis of all its arguments, as `jax.vmap` but in chunks.

    On a CPU the intermediate values of a whole batch travel through memory, those of a
    chunk stay in the cache. Accelerators take the batch at once. What all items share is
    closed over, and made once:

        constants = rod.operators(finger)
        batched(lambda q: rod.motion(finger, q, constants=constants).position)(many_q)

    Args:
        verb: Of arrays, or pytrees of them: models too.
        chunk: Items at once on a CPU.

    Raises:
        ValueError: If the arguments do not have equally many items.
    """
    _check.positive("batched", "chunk", chunk, "items", "Give how many to take at once.")

    def every(*items: Any) -> Any:
        arrays, rest = eqx.partition(items, lambda x: isinstance(x, jax.Array | np.ndarray))
        _check_counts(arrays)

        def one(item: Any) -> Any:
            return verb(*eqx.combine(item, rest))

        def in_chunks(items: Any) -> Any:
            return jax.lax.map(one, items, batch_size=chunk)

        if len(jax.tree.leaves(arrays)[0]) <= chunk:
            return jax.vmap(one)(arrays)
        return jax.lax.platform_dependent(arrays, cpu=in_chunks, default=jax.vmap(one))

    return every


def _check_counts(arrays: Any) -> None:
    counts = {leaf.shape[0] if leaf.ndim else 0 for leaf in jax.tree.leaves(arrays)}
    if len(counts) != 1 or 0 in counts:
        raise ValueError(
            f"batched: got first axes of {sorted(counts)} items (0: none), need one count "
            "for all. Close over what all items share."
        )
