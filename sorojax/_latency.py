"""Loops in real time: JAX answers in the thread that asks."""


def enable_low_latency() -> None:
    """Have JAX run small programs on a CPU where they are called, for loops in real time.

    By default it hands them to another thread, whose waking takes longer than an estimate of
    a rod's shape: on one core the median of such a call may be halved. Python then no longer
    prepares the next call while the last one runs. To be called before the first array is
    made; never done by an import.

    Raises:
        RuntimeError: If JAX has started already.
    """
    import jax
    from jax._src import xla_bridge

    name = "jax_cpu_enable_async_dispatch"
    if xla_bridge.backends_are_initialized() and jax.config.read(name):
        raise RuntimeError(
            "enable_low_latency: JAX has started already, need it before the first array. Call "
            "it right after the imports."
        )
    jax.config.update(name, False)
