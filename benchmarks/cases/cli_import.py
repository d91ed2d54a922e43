"""Importing sorojax after jax, equinox and diffrax, in fresh processes: by itself, and with
all of its floors, which are imported when they are first asked for."""

import subprocess
import sys

from benchmarks.harness import Row, Timing

PROGRAM = """
import time
import jax, equinox, diffrax
start = time.perf_counter()
import sorojax
{more}
print(time.perf_counter() - start)
"""
MORE = {"none": "", "all": "[getattr(sorojax, name) for name in dir(sorojax)]"}


def rows():
    def once(more: str) -> float:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM.format(more=more)],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        return float(done.stdout)

    for floors, more in MORE.items():
        first = once(more)  # may write byte code
        timing = Timing(first, tuple(once(more) for _ in range(5)))
        yield Row("sorojax", {"floors": floors}, **timing.columns(), bar=1.0)
