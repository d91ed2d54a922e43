"""The one room for what JAX does not promise.

Only files here may touch `jax._src`, `jax.core`, `jax.extend`, `jax.interpreters`, custom
primitives, host callbacks, and marks and options of the compiler. Each says which name it
rests on and does without it where it is missing: slower, with the same numbers.
"""


def fast_paths() -> dict[str, str]:
    """Each fast path that needs such a name, as "on" or "off: why"."""
    from sorojax._jax import (
        diffrax_checks,
        host_call,
        operations,
        programs,
        small_kernels,
        small_products,
        trace_state,
    )

    rooms = (
        diffrax_checks,
        host_call,
        operations,
        programs,
        small_kernels,
        small_products,
        trace_state,
    )
    return {room.__name__.rpartition(".")[2]: room.status() for room in rooms}
