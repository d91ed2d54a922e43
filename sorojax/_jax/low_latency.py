"""Loops in real time: JAX runs small programs in the thread that calls them.

Rests on the option `jax_cpu_enable_async_dispatch`, which JAX documents, and on
`jax._src.xla_bridge.backends_are_initialized`, without which a call that comes too late is
not noticed.
"""

import jax

from sorojax._jax.optional import optional

_OPTION = "jax_cpu_enable_async_dispatch"
_has_started = optional("jax._src.xla_bridge", "backends_are_initialized")


def enable_low_latency() -> None:
    """Have JAX run small programs on a CPU where they are called, for loops in real time.

    By default it hands them to another thread, whose waking takes longer than an estimate of
    a rod's shape: on one core the median of such a call may be halved. Python then no longer
    prepares the next call while the last one runs. To be called before the first array is
    made; never done by an import.

    Raises:
        RuntimeError: If JAX has started already.
    """
    if _has_started is not None and _has_started() and jax.config.values.get(_OPTION, True):
        raise RuntimeError(
            "enable_low_latency: JAX has started already, need it before the first array. Call "
            "it right after the imports."
        )
    jax.config.update(_OPTION, False)
