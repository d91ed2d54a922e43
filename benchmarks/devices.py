"""The same kernels on a CPU and on an accelerator: rows that carry both."""

from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure, missing
from benchmarks.single import narrow

Device = Any  # a `jax.Device`, whose type is a variable to type checkers
COMMAND = "make bench-device"


def found() -> list[Device]:
    """One CPU core of this machine and, where there is one, an accelerator."""
    devices = [jax.devices("cpu")[0]]
    return devices + [d for d in jax.devices()[:1] if d.platform != "cpu"]


def absent() -> Row:
    """The row of a case that needs an accelerator and finds none."""
    return missing(
        "accelerator", f"JAX sees no accelerator. Install jax[cuda13] and run `{COMMAND}`."
    )


def put(tree: Any, device: Device) -> Any:
    """`tree` with all its arrays on `device`."""
    arrays, rest = eqx.partition(tree, eqx.is_array)
    return eqx.combine(jax.device_put(arrays, device), rest)


def name(device: Device) -> str:
    return "one CPU core" if device.platform == "cpu" else device.device_kind


def compared(
    what: str,
    function: Callable[..., Any],
    args: tuple,
    *,
    count: int,
    of: str,
    error_of: Callable[[Any], float],
    bar: float | None,
    reference: str,
    devices: list[Device],
    double: bool = True,
    calls: int = 1,
) -> Iterator[Row]:
    """A row for each device: seconds per call and item, and the error there.

    Args:
        count: Items of one call, counted `of`.
        error_of: Of what the function yields.
        bar: Of the error.
        double: In double precision; in single precision otherwise.
        calls: That one run of the function makes.
    """
    given = args if double else narrow(args)
    for device in devices:
        here, programs = put(given, device), []
        with jax.default_device(device):
            timing = measure(function, *here, repeats=5, keep=programs.append).per(calls)
            error = error_of(programs[0](*here))
        settings = named(what, device, double) | {
            "against": of,
            of: count,
            "ns an item": round(min(timing.runs) / count * 1e9, 4),
        }
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            error=error,
            reference=reference,
            bar=bar,
            bar_on="error",
        )


def named(what: str, device: Device, double: bool = True) -> dict[str, Any]:
    """Settings that say what ran where."""
    precision = "double" if double else "single"
    return {"method": f"{what}, {name(device)}, {precision}", "device": name(device)}


def relative(exact: Any) -> Callable[[Any], float]:
    """Largest difference of an answer, over the largest entry of `exact`; of as many items
    as that has."""
    wanted = [np.asarray(x, np.float64) for x in jax.tree.leaves(exact)]

    def error(answer: Any) -> float:
        worst = 0.0
        for got, want in zip(jax.tree.leaves(answer), wanted, strict=True):
            got = np.asarray(got[: len(want)], np.float64)
            worst = max(worst, float(np.abs(got - want).max() / np.abs(want).max()))
        return worst

    return error


def on_cpu(function: Callable[..., Any], *args: Any) -> Any:
    """The answer of the CPU in double precision."""
    cpu = jax.devices("cpu")[0]
    with jax.default_device(cpu):
        return jax.tree.map(jnp.asarray, jax.jit(function)(*put(args, cpu)))
