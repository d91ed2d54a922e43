"""The process of one case: `python -m benchmarks.child NAME FILE LINES`.

Pinned to one core before JAX starts; every row is written as soon as it exists.
"""

import os
import sys
from pathlib import Path

from benchmarks.discover import load
from benchmarks.harness import left_out
from benchmarks.rows import dumps, line


def environment(workers: int) -> dict[str, str]:
    """What a measured process needs in its environment before it starts.

    One thread per library, `workers` of JAX. A case takes two, because a host callback that
    waits for the only one waits for ever; where nothing calls the host and arrays are long it
    takes one: two that share the core wait for each other's time slice of 4 ms. Run-time
    checks are left out of the timings.
    """
    threads = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    return dict.fromkeys(threads, "1") | {
        "NPROC": str(workers),
        "PJRT_NPROC": str(workers),
        "EQX_ON_ERROR": "nan",
        "JAX_PLATFORMS": os.environ.get("JAX_PLATFORMS", "cpu"),
    }


def pin() -> None:
    """Stay on one core, the last one: the first is often the busiest."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def main(name: str, file: str, lines: str) -> None:
    pin()
    import jax

    # No persistent compilation cache: `compile_s` is what a new machine pays.
    jax.config.update("jax_enable_x64", True)
    with Path(lines).open("w") as out:
        for row in load(name, Path(file)).rows():
            print(dumps(line(name, row)), file=out, flush=True)
        if last := left_out():
            print(dumps(line(name, last)), file=out)


if __name__ == "__main__":
    main(*sys.argv[1:])
