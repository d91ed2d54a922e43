"""Importing sorojax after jax, equinox and diffrax, in fresh processes."""

import subprocess
import sys

from benchmarks.harness import Row, Timing

PROGRAM = """
import time
import jax, equinox, diffrax
start = time.perf_counter()
import sorojax
print(time.perf_counter() - start)
"""


def rows():
    def once() -> float:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True
        )
        return float(done.stdout)

    first = once()  # may write byte code
    timing = Timing(first, tuple(once() for _ in range(5)))
    yield Row("sorojax", {}, **timing.columns(), error=None, reference=None, bar=1.0)
