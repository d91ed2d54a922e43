"""Sine and cosine by polynomials, alone and where `sorojax.jit` puts them in a kernel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from sorojax._jax import small_kernels as kernels
from sorojax._jax.trigonometry import cosine, sine

pytestmark = pytest.mark.versions
fast = jax.jit(lambda x: (sine(x), cosine(x)))


@pytest.mark.parametrize("size", [1e-9, 1.0, 30.0, 1e5])
def test_both_agree_with_the_library(size):
    angle = np.random.default_rng(0).uniform(-size, size, 20_000)
    angle[:9] = size * np.linspace(-1, 1, 9)
    for found, exact in zip(fast(angle), (np.sin(angle), np.cos(angle)), strict=True):
        np.testing.assert_allclose(found, exact, rtol=0, atol=3e-16)


@pytest.mark.parametrize("size", [1e9, 1e14])
def test_large_angles_err_as_if_rounded(size):
    angle = np.random.default_rng(1).uniform(-size, size, 20_000)
    for found, exact in zip(fast(angle), (np.sin(angle), np.cos(angle)), strict=True):
        np.testing.assert_allclose(found, exact, rtol=0, atol=2.3e-16 * size)


def test_without_an_angle_there_is_no_number():
    found = np.stack(fast(np.array([np.inf, -np.inf, np.nan])))
    assert np.all(np.isnan(found))
    huge = np.stack(fast(np.array([1e17, -1e30, 1e300])))
    assert np.all(np.abs(huge) <= 1)


def test_quarter_turns():
    angle = np.pi / 2 * np.arange(-8, 9)
    found, exact = np.stack(fast(angle)), np.stack([np.sin(angle), np.cos(angle)])
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-16)


@pytest.mark.skipif(not kernels._IS_PROVEN, reason=kernels.status())
@pytest.mark.parametrize("kind", ["float64", "float32"])
def test_loops_in_kernels_use_them(kind):
    x = jnp.linspace(0.1, 0.9, 6).astype(kind)

    def swing(x):
        def step(x, _):
            return 0.5 + 0.4 * jnp.sin(3 * x) * jnp.cos(x), None

        return jax.lax.scan(step, x, length=50)[0]

    text = str(
        jax.jit(kernels.one_kernel(swing), compiler_options=kernels.OPTIONS)
        .lower(x)
        .compile()
        .as_text()
    )
    library = " sine(" in text or " cosine(" in text
    assert library == (kind == "float32")
    eps = float(np.finfo(kind).eps)
    np.testing.assert_allclose(sj.jit(swing)(x), jax.jit(swing)(x), rtol=20 * eps)
