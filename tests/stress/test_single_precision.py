"""Stress cases of single precision: digits as the table of the benchmark states them."""

import jax.numpy as jnp
import pytest

from benchmarks.single import KERNELS, error, kernel

SLOW = ("fem tangent, Tet10", "network of five fingers")  # to compile


@pytest.mark.stress(51)
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in KERNELS],
)
def test_kernels_keep_the_digits_stated(name):
    asked = kernel(name)
    assert 0 < error(asked) < asked.bound


def test_an_answer_of_another_precision_is_refused():
    wide = kernel("sdf value")._replace(function=lambda s, p: p.astype(jnp.float64))
    with pytest.raises(TypeError, match="got float64"):
        error(wide)
