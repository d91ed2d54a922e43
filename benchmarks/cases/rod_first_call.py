"""First use of the finger D1 in fresh processes: building it, compiling its acceleration.

Compiled without a persistent cache, and found in one that an earlier process left.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile

from benchmarks.harness import Row, quick

PROGRAM = """
import json, time
import jax
jax.config.update("jax_enable_x64", True)
import sorojax, sorojax.rod
from benchmarks.fingers import finger
sorojax.enable_compilation_cache()
jax.block_until_ready(jax.numpy.zeros(6) + 1)
start = time.perf_counter()
model = finger(8)
built = time.perf_counter()
q = jax.numpy.zeros(6)
begin = time.perf_counter()
a = sorojax.rod.forward_dynamics(model, q, q, (sorojax.rod.Gravity(),))
jax.block_until_ready(a)
print(json.dumps({"build": built - start, "acceleration": time.perf_counter() - begin}))
"""
REPEATS = 2 if quick() else 3
BARS = {"build": 0.1, "acceleration": 2.5, "acceleration from the cache": 0.4}


def once(cache: str) -> dict[str, float]:
    """Seconds of each part in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=os.environ | {"SOROJAX_CACHE": cache},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def rows():
    seconds = {name: [] for name in BARS}
    for _ in range(REPEATS):
        with tempfile.TemporaryDirectory() as cache:
            first, second = once(cache), once(cache)
        seconds["build"] += [first["build"], second["build"]]
        seconds["acceleration"].append(first["acceleration"])
        seconds["acceleration from the cache"].append(second["acceleration"])
    for name, runs in seconds.items():
        yield Row(
            "sorojax",
            {"first": name},
            run_s=statistics.median(runs),
            run_s_min=min(runs),
            run_s_max=max(runs),
            bar=BARS[name],
        )
