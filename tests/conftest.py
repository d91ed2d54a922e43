"""Tests run in float64 with strict promotion and a persistent compilation cache."""

import gc
import itertools
import os
from importlib import metadata
from pathlib import Path

if metadata.version("jaxlib").startswith("0.10."):  # elsewhere an unknown flag is fatal
    # Compiles a third faster. XLA_FLAGS= runs the tests with the compiler that users have.
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")

import jax
import pytest

from sorojax._cache import enable_compilation_cache

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

enable_compilation_cache()

_MAX_MAPPINGS = 15_000


@pytest.fixture(autouse=True, scope="module")
def _bounded_number_of_programs():
    """Every compiled program holds memory mappings, of which Linux allows 65,530 a process;
    beyond that the compiler crashes. What comes back later is read from the cache."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > _MAX_MAPPINGS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def getkey():
    """A fresh typed PRNG key at every call, the same sequence in every run."""
    keys = (jax.random.fold_in(jax.random.key(0), i) for i in itertools.count())
    return lambda: next(keys)
