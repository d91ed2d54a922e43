"""Tests run in float64 with strict promotion and a persistent compilation cache."""

import itertools
import os
from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

_cache = Path(
    os.environ.get("SOROJAX_CACHE", Path.home() / ".cache" / "sorojax")
) / "jax"
_cache.mkdir(parents=True, exist_ok=True, mode=0o700)
jax.config.update("jax_compilation_cache_dir", str(_cache))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


@pytest.fixture
def getkey():
    """A fresh typed PRNG key at every call, the same sequence in every run."""
    keys = (jax.random.fold_in(jax.random.key(0), i) for i in itertools.count())
    return lambda: next(keys)
