"""Measuring, inside the process of one case."""

import os
import time
from collections.abc import Callable
from typing import Any

from benchmarks.rows import Row as Row, Timing as Timing, missing as missing

#: CPU seconds of this process where `python -m benchmarks --cpu` asks for them: other programs
#: on the same core do not count.
clock = time.process_time if os.environ.get("SOROJAX_BENCH_CPU") == "1" else time.perf_counter

_left_out: dict[str, None] = {}  # in order, each once


def quick(left_out: str = "") -> bool:
    """Whether few sizes will do: `python -m benchmarks --quick`. The page then names under
    the case what it leaves out."""
    short = os.environ.get("SOROJAX_BENCH_QUICK") == "1"
    if short and left_out:
        _left_out[left_out] = None
    return short


def left_out() -> Row | None:
    """The row that names what this quick run leaves out of the case."""
    return Row("sorojax", {"left_out": list(_left_out)}) if _left_out else None


def measure(
    function: Callable[..., Any],
    *args: Any,
    repeats: int = 9,
    keep: Callable[[Any], Any] | None = None,
) -> Timing:
    """Compile a JAX function for the shapes of `args`, then time it.

    The arguments are inputs of the program: XLA cannot fold them. `keep` is handed the
    compiled program.
    """
    import jax

    start = clock()
    compiled = jax.jit(function).lower(*args).compile()
    compile_s = clock() - start
    if keep is not None:
        keep(compiled)
    jax.block_until_ready(compiled(*args))
    return Timing(compile_s, _runs(lambda: jax.block_until_ready(compiled(*args)), repeats))


def measure_together(
    functions: dict[str, Callable[..., Any]],
    *args: Any,
    repeats: int = 9,
    results: dict[str, Any] | None = None,
) -> dict[str, Timing]:
    """As `measure`, of several functions of the same arguments whose ratios matter.

    They run in turn, there and back, so that all meet the same machine. What they yield is
    put into `results`.
    """
    import jax

    compiled, compile_s, runs = {}, {}, {name: [] for name in functions}
    for name, function in functions.items():
        start = clock()
        compiled[name] = jax.jit(function).lower(*args).compile()
        compile_s[name] = clock() - start
        first = jax.block_until_ready(compiled[name](*args))
        if results is not None:
            results[name] = first
    order = list(functions)
    for _ in range(repeats):
        for name in order:
            call = compiled[name]
            runs[name].extend(_runs(lambda call=call: jax.block_until_ready(call(*args)), 1))
        order.reverse()
    return {name: Timing(compile_s[name], tuple(runs[name])) for name in functions}


def measure_once(function: Callable[..., Any], *args: Any) -> tuple[Timing, Any]:
    """As `measure`, of a program that takes long: it runs once, and what it yields is kept."""
    import equinox as eqx
    import jax

    results: dict[str, Any] = {}

    def call():
        results["last"] = jax.block_until_ready(compiled(*args))

    start = clock()
    compiled = eqx.filter_jit(function).lower(*args).compile()
    compile_s = clock() - start
    return Timing(compile_s, _runs(call, 1)), results["last"]


def measure_calls(function: Callable[[], Any], repeats: int = 5) -> Timing:
    """Time a function that compiles what it needs at its first call.

    `compile_s` is what the first call takes beyond the median of the later ones.
    """
    import jax

    def call():
        jax.block_until_ready(function())

    (first,) = _runs(call, 1)
    runs = _runs(call, repeats)
    return Timing(max(0.0, first - sorted(runs)[len(runs) // 2]), runs)


def _runs(call: Callable[[], Any], repeats: int) -> tuple[float, ...]:
    seconds = []
    for _ in range(repeats):
        start = clock()
        call()
        seconds.append(clock() - start)
    return tuple(seconds)
