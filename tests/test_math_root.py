"""The inverse cube root: accuracy over all sizes, derivatives, and what has none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax.math.linalg.dense import inverse_cube_root

root = jax.jit(inverse_cube_root)
third = jax.jit(jax.grad(jax.grad(jax.grad(inverse_cube_root))))


@pytest.mark.parametrize("kind, largest", [("float64", 700.0), ("float32", 85.0)])
@pytest.mark.parametrize("share", [1e-3, 1.0])
def test_it_errs_by_one_unit_in_the_last_place(kind, largest, share):
    sizes = np.random.default_rng(0).uniform(-largest * share, largest * share, 50_000)
    x = np.exp(sizes).astype(kind)
    exact = x.astype(np.longdouble) ** (np.longdouble(-1) / 3)
    error = np.abs(np.asarray(root(x)).astype(np.longdouble) / exact - 1).max()
    assert error < 1.5 * np.finfo(kind).eps
    assert root(x).dtype == kind


@pytest.mark.parametrize("x", [0.3, 1.0, 7.0])
def test_derivatives_of_any_order(x):
    assert np.isclose(third(x), -28 / 27 * x ** (-10 / 3), rtol=1e-14)


@pytest.mark.parametrize("kind", ["float64", "float32"])
def test_without_a_root_there_is_no_number(kind):
    denormal = np.finfo(kind).tiny / 2
    x = np.array([0.0, -1e-3, -2.0, np.inf, -np.inf, np.nan, denormal], kind)
    assert np.all(np.isnan(root(x)))
    assert np.all(np.isnan(jax.grad(lambda x: jnp.sum(inverse_cube_root(x)))(x)))


@pytest.mark.parametrize("kind", ["float64", "float32"])
def test_the_smallest_and_the_largest_number_have_a_root(kind):
    ends = np.array([np.finfo(kind).tiny, np.finfo(kind).max])
    exact = ends.astype(np.longdouble) ** (np.longdouble(-1) / 3)
    assert np.allclose(root(ends), exact.astype(kind), rtol=2 * np.finfo(kind).eps, atol=0)


def test_other_numbers_take_a_power():
    assert np.isclose(float(root(jnp.asarray(8.0, "bfloat16"))), 0.5, rtol=1e-2)
