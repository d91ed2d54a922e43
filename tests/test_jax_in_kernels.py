"""What kernels compute by themselves: sine, cosine, factors and solutions of small matrices,
alone and where `sorojax.jit` puts them in a kernel."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from sorojax._jax import small_kernels as kernels
from sorojax._jax.in_kernels import cholesky, cosine, lu, sine, sort, triangular_solve

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


def matrix(rows, kind="float64"):
    return jnp.asarray(np.random.default_rng(rows).normal(size=(rows, rows)).astype(kind))


@pytest.mark.parametrize("kind", ["float64", "float32"])
@pytest.mark.parametrize("rows", [1, 2, 7, 12])
def test_factors_are_those_of_the_library(rows, kind):
    a, close = matrix(rows, kind), {"rtol": 0, "atol": 200 * float(np.finfo(kind).eps)}
    even = a @ a.T + np.eye(rows, dtype=kind)
    np.testing.assert_allclose(cholesky(even), np.linalg.cholesky(even), **close)
    for found, known in zip(lu(a), jax.lax.linalg.lu(a), strict=True):
        assert found.dtype == known.dtype
        np.testing.assert_allclose(found, known, **close)


def test_matrices_without_a_factor():
    none = jnp.array([[1.0, 2.0], [2.0, 1.0]])  # of both signs
    assert np.isnan(cholesky(none)[1, 1])
    singular = jnp.array([[0.0, 1.0], [0.0, 2.0]])
    for found, known in zip(lu(singular), jax.lax.linalg.lu(singular), strict=True):
        np.testing.assert_array_equal(found, known)


@pytest.mark.parametrize("unit_diagonal", [False, True])
@pytest.mark.parametrize("transpose_a", [False, True])
@pytest.mark.parametrize("lower", [False, True])
@pytest.mark.parametrize("left_side", [False, True])
def test_triangular_solutions(left_side, lower, transpose_a, unit_diagonal):
    a = matrix(5) / 5 + np.eye(5)
    right = matrix(5)[:, :3] if left_side else matrix(5)[:3]
    how = {"left_side": left_side, "lower": lower, "transpose_a": transpose_a}
    found = triangular_solve(a, right, unit_diagonal=unit_diagonal, **how)
    known = jax.lax.linalg.triangular_solve(a, right, unit_diagonal=unit_diagonal, **how)
    np.testing.assert_allclose(found, known, rtol=1e-12)


def test_integers_in_order():
    keys, numbers = jnp.array([3, 1, 3, 0, 1]), jnp.arange(5.0)
    ordered, moved = sort(keys, numbers)
    np.testing.assert_array_equal(ordered, [0, 1, 1, 3, 3])
    np.testing.assert_array_equal(moved, [3, 1, 4, 0, 2])


@pytest.mark.skipif(not kernels._IS_PROVEN, reason=kernels.status())
@pytest.mark.parametrize("rows", [4, kernels.LARGEST_SOLVED, kernels.LARGEST_SOLVED + 1])
@pytest.mark.parametrize("solve", [jnp.linalg.solve, jax.scipy.linalg.solve])
def test_loops_with_solutions_are_kernels(solve, rows):
    a = jnp.asarray(matrix(rows) @ matrix(rows).T + np.eye(rows))

    def run(x):
        def step(x, _):
            return jnp.sin(solve(a + jnp.diag(x * x), 1 + x)), None

        return jax.lax.scan(step, x, length=20)[0]

    way = {"assume_a": "pos"} if solve is jax.scipy.linalg.solve else {}
    solve = partial(solve, **way)
    for function in (run, jax.grad(lambda x: jnp.sum(run(x)))):
        text = jax.jit(kernels.one_kernel(function)).lower(jnp.ones(rows)).as_text()
        assert ("xla_cpu_small_call" in text) is (rows <= kernels.LARGEST_SOLVED)
        x = jnp.linspace(0.1, 0.9, rows)
        np.testing.assert_allclose(
            sj.jit(function)(x), jax.jit(function)(x), rtol=1e-9, atol=1e-12
        )
