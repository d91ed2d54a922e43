"""Importing sorojax after jax, equinox and diffrax, in fresh processes: by itself, and with
all of its floors, which are imported when they are first asked for. The byte code is kept by
the first import, as for every user."""

import os
import subprocess
import sys

from benchmarks.harness import Row, Timing, quick

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
    keeps_byte_code = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}

    def once(more: str) -> float:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM.format(more=more)],
            capture_output=True,
            text=True,
            check=True,
            env=keeps_byte_code,
        )
        return float(done.stdout)

    for floors, more in MORE.items():
        first = once(more)  # may write byte code
        timing = Timing(first, tuple(once(more) for _ in range(3 if quick() else 5)))
        yield Row("sorojax", {"floors": floors}, **timing.columns(), bar=1.0)
