"""Tests run in float64 with strict promotion, a persistent compilation cache and the compiler
that users have, or with `make test COMPILER=quick` one that takes half of the time."""

import gc
import importlib.metadata
import itertools
import math
import os
import time

import jax
import pytest

from sorojax import _mappings
from sorojax._cache import enable_compilation_cache

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

enable_compilation_cache()

_MAX_MAPPINGS = 20_000
_BEGUN = time.monotonic()


def _compile_quickly():
    """XLA without most of LLVM's optimisation and, where it can do without, its emitters of
    fused loops: set before anything is computed, and in the programs that tests start."""
    flags = [os.environ.get("XLA_FLAGS", ""), "--xla_backend_optimization_level=0"]
    if importlib.metadata.version("jaxlib").startswith("0.10."):
        flags.append("--xla_cpu_use_fusion_emitters=false")
    os.environ["XLA_FLAGS"] = " ".join(flags).strip()


if os.environ.pop("SOROJAX_TEST_COMPILER", "user") == "quick":
    _compile_quickly()


def pytest_addoption(parser):
    parser.addoption(
        "--minutes",
        type=float,
        default=math.inf,
        help="skip tests that would begin later than this, and say so",
    )


def pytest_runtest_setup(item):
    minutes = item.config.option.minutes
    if time.monotonic() > _BEGUN + 60 * minutes:
        pytest.skip(f"not begun within --minutes {minutes:g}: this machine is slow")


def pytest_collection_finish(session):
    """Tracing makes so many objects that looking for garbage takes a sixth of the time;
    looked for less often, a hundredth."""
    gc.set_threshold(100_000, 20, 20)


_looked_at = [time.monotonic()]


@pytest.fixture(autouse=True)
def _bounded_number_of_programs():
    """Every compiled program holds memory mappings, of which Linux allows 65,530 a process;
    beyond that the compiler crashes. One test may add 12,000. What comes back later is read
    from the cache. Counting takes some 10 ms: not more often than every second."""
    yield
    if time.monotonic() < _looked_at[0] + 1.0:
        return
    _looked_at[0] = time.monotonic()
    if _mappings.count() > _MAX_MAPPINGS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def getkey():
    """A fresh typed PRNG key at every call, the same sequence in every run."""
    keys = (jax.random.fold_in(jax.random.key(0), i) for i in itertools.count())
    return lambda: next(keys)


def pytest_terminal_summary(terminalreporter, config):
    """After `-m stress`: every case of the catalogue and whether its tests held."""
    if config.option.markexpr != "stress":
        return
    from tests.stress.catalogue import CASES

    found = {number: [] for number in CASES}
    for outcome in ("passed", "failed", "skipped", "error"):
        for report in terminalreporter.stats.get(outcome, ()):
            for number in dict(getattr(report, "user_properties", ())).get("stress", ()):
                found[number].append(outcome)
    terminalreporter.section("stress cases")
    for number, outcomes in found.items():
        bad = set(outcomes) - {"passed"}
        word = "NOT RUN" if not outcomes else "NO" if bad else "holds"
        terminalreporter.write_line(f"{number:3d}  {word:8s} {CASES[number]}")


@pytest.fixture(autouse=True)
def _cases(request, record_property):
    """Tells the summary which cases of the catalogue a test shows."""
    numbers = [n for mark in request.node.iter_markers("stress") for n in mark.args]
    if numbers:
        record_property("stress", numbers)
