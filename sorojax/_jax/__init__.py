"""The one room for what JAX does not promise.

Only files here may touch `jax._src`, `jax.core`, `jax.extend`, `jax.interpreters`, custom
primitives, host callbacks, and marks and options of the compiler. Each says which name it
rests on and does without it where it is missing: slower, with the same numbers.
"""

import importlib

_FAST_PATHS = (
    "diffrax_checks", "host_call", "operations", "programs", "small_kernels", "small_products",
    "trace_state",
)  # fmt: skip


def fast_paths() -> dict[str, str]:
    """Each fast path that needs such a name, as "on" or "off: why"."""
    rooms = {name: importlib.import_module(f"{__name__}.{name}") for name in _FAST_PATHS}
    return {name: room.status() for name, room in rooms.items()}
