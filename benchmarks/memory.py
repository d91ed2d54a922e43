"""Memory: what this process holds at its highest, and what a compiled program asks for."""

import ctypes
import gc
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def resident(entry: str) -> float:
    """Resident memory [MB]: `VmRSS` now, `VmHWM` at its highest."""
    line = next(x for x in _STATUS.read_text().splitlines() if x.startswith(entry))
    return int(line.split()[1]) / 1024


def highest() -> float | None:
    """Most memory [MB] that this process has held; `None` if the system does not tell."""
    return resident("VmHWM") if _STATUS.exists() else None


def forget_peak() -> None:
    """From here on, the highest is counted anew."""
    _CLEAR.write_text("5")


def peak(call: Callable[[], Any]) -> float | None:
    """Most memory [MB] that `call` holds beyond what there was; `None` if the system does
    not tell. What the process kept of earlier calls is given back before."""
    if not _CLEAR.exists():
        return None
    gc.collect()
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)
    forget_peak()
    before = resident("VmRSS")
    result = call()
    most = resident("VmHWM") - before
    del result
    return most


def of_program(compiled: Any) -> float | None:
    """Arguments, results and intermediate values [MB] of a compiled JAX function."""
    told = compiled.memory_analysis()
    if told is None:
        return None
    parts = (told.argument_size_in_bytes, told.output_size_in_bytes, told.temp_size_in_bytes)
    return sum(parts) / 2**20
