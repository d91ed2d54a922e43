"""64 regulated fingers, one second: all easy, and one of them a hundred times stiffer."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, Timing
from benchmarks.regulated import error, reference, regulated
from sorojax import systems

MEMBERS, STIFF = 64, 37
RATIO = 1.6


def run(gains):
    return systems.simulate_batch(regulated, gains, 1.0, save=11)


def timed(batches, repeats=7):
    """First calls, then calls in turn."""
    firsts, runs, films = {}, {name: [] for name in batches}, {}
    for name, gains in batches.items():
        start = time.perf_counter()
        films[name] = jax.block_until_ready(run(gains))
        firsts[name] = time.perf_counter() - start
    for _ in range(repeats):
        for name, gains in batches.items():
            start = time.perf_counter()
            jax.block_until_ready(run(gains))
            runs[name].append(time.perf_counter() - start)
    return {name: Timing(firsts[name], tuple(runs[name])) for name in batches}, films


def rows():
    easy = 10 * (1 + 1e-3 * np.arange(MEMBERS))
    mixed = np.where(np.arange(MEMBERS) == STIFF, 1000.0, easy)
    batches = {"all easy": jnp.array(easy), "one stiff": jnp.array(mixed)}
    times, films = timed(batches)
    want = reference(1000.0)
    for name, timing in times.items():
        film, stiff = films[name], name == "one stiff"
        end = film["finger.q"][STIFF, -1]
        yield Row(
            "sorojax",
            {"batch": name, "run again": int(film.stats["stiff"].sum())},
            **timing.columns(),
            error=error(end, want) if stiff else None,
            reference="Radau of SciPy, the stiff member" if stiff else None,
            bar=RATIO * times["all easy"].columns()["run_s"] if stiff else None,
        )
