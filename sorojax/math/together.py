"""Independent work of the host at the same time: compilers and BLAS leave Python to others."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax


def together(*works: Callable[[], Any]) -> list[Any]:
    """What `works`, each of concrete numbers, answer; each in a thread of its own.

    Precision and default device of the caller hold in all of them.
    """
    first, *rest = works
    x64, device = jax.config.jax_enable_x64, jax.config.jax_default_device  # type: ignore

    def alike(work: Callable[[], Any]) -> Any:
        with jax.enable_x64(x64), jax.default_device(device):
            return work()

    with ThreadPoolExecutor(max(1, len(rest))) as pool:
        others = [pool.submit(alike, work) for work in rest]
        return [first(), *(other.result() for other in others)]
