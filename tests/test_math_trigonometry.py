"""Cosine and sine at once: digits, derivatives, what is no number, single precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax.math.trigonometry import cosine_and_sine

both = jax.jit(cosine_and_sine)


@pytest.mark.parametrize("size", [1e-9, 1.0, 10.0, 1e3, 1e5])
def test_digits(size):
    angle = np.random.default_rng(0).uniform(-size, size, 2000)
    cosine, sine = both(angle)
    assert np.abs(cosine - np.cos(angle)).max() <= 3e-16
    assert np.abs(sine - np.sin(angle)).max() <= 3e-16
    assert np.allclose(sine, np.sin(angle), rtol=1e-10 if size > 1 else 4e-16, atol=0)


def test_quarters_and_what_is_no_number():
    angle = np.pi / 2 * np.arange(-8.0, 9.0)
    cosine, sine = both(angle)
    assert np.abs(cosine - np.cos(angle)).max() < 3e-16
    assert np.abs(sine - np.sin(angle)).max() < 3e-16
    assert np.isnan(both(jnp.array([np.nan, np.inf]))).all()


def test_derivatives_of_both_orders():
    angle = jnp.array([0.3, -4.0, 20.0])

    def total(angle):
        cosine, sine = cosine_and_sine(angle)
        return jnp.sum(cosine * jnp.array([1.0, 2.0, 3.0]) + sine)

    def known(angle):
        return jnp.sum(jnp.cos(angle) * jnp.array([1.0, 2.0, 3.0]) + jnp.sin(angle))

    assert np.allclose(jax.grad(total)(angle), jax.grad(known)(angle), rtol=1e-14)
    assert np.allclose(jax.hessian(total)(angle), jax.hessian(known)(angle), atol=1e-14)


def test_single_precision_stays_single():
    cosine, sine = both(jnp.array([0.5, 3.0], jnp.float32))
    assert cosine.dtype == sine.dtype == jnp.float32
    assert np.allclose(sine, np.sin([0.5, 3.0]), atol=1e-7)
