"""Tests run in float64 with strict promotion and a persistent compilation cache."""

import itertools

import jax
import pytest

from sorojax._cache import enable_compilation_cache

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

enable_compilation_cache()


@pytest.fixture
def getkey():
    """A fresh typed PRNG key at every call, the same sequence in every run."""
    keys = (jax.random.fold_in(jax.random.key(0), i) for i in itertools.count())
    return lambda: next(keys)
