"""Derivatives of roots by the implicit function, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax.math.implicit_root import implicit_root

pytestmark = pytest.mark.versions
A = jnp.array([[3.0, 1.0], [-0.5, 2.0]])
B = jnp.array([1.0, 2.0])


def by_newton(f, x):
    return jax.lax.fori_loop(
        0, 30, lambda _, x: x - jnp.linalg.solve(jax.jacfwd(f)(x), f(x)), x
    )


def by_jacobian(linear, right):
    return jnp.linalg.solve(jax.jacobian(linear)(right), right)


def by_columns(linear, right):
    return jnp.linalg.solve(jax.vmap(linear)(jnp.eye(2)).T, right)


def root(scale, matrix, tangent_solve=by_jacobian):
    """Of an equation that is not symmetric: scale M x + x^3 = b."""
    return implicit_root(lambda x: scale * (matrix @ x) + x**3 - B, B, by_newton, tangent_solve)


def exact(x, scale, matrix):
    return -np.linalg.solve(scale * matrix + np.diag(3 * x**2), matrix @ x)


@pytest.mark.parametrize("tangent_solve", [by_jacobian, by_columns])
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_are_those_of_the_implicit_function(mode, tangent_solve):
    def at(scale):
        return root(scale, A, tangent_solve)

    scale = jnp.asarray(1.3)
    want = exact(np.asarray(at(scale)), 1.3, np.asarray(A))
    for slope in (mode(at), jax.jit(mode(at))):
        np.testing.assert_allclose(slope(scale), want, rtol=1e-12)
    scales = jnp.array([0.7, 1.3, 2.0])
    np.testing.assert_allclose(jax.vmap(mode(at))(scales)[1], want, rtol=1e-12)
    np.testing.assert_allclose(mode(jax.vmap(at))(scales)[1, :, 1], want, rtol=1e-12)


def test_second_derivatives_and_many_numbers():
    def energy(numbers):
        return jnp.sum(root(*numbers) ** 2)

    numbers = (jnp.asarray(1.3), A)
    slope = jax.grad(energy)
    curve = jax.jvp(slope, (numbers,), ((jnp.asarray(1.0), 0 * A),))[1]
    h = 1e-5
    ends = [slope((jnp.asarray(1.3 + d), A)) for d in (h, -h)]
    rate = jax.tree.map(lambda a, b: (a - b) / (2 * h), *ends)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-7), curve, rate)


def test_what_comes_with_the_root_has_no_derivative():
    def at(scale):
        def search(f, x):
            x = by_newton(f, x)
            return x, (jnp.sum(x), jnp.asarray(True))

        found = implicit_root(lambda x: scale * x - B, B, search, by_jacobian, has_aux=True)
        x, (total, done) = found
        return x[0] + total, done

    (value, slope), done = (
        jax.value_and_grad(lambda s: at(s)[0])(jnp.asarray(2.0)),
        at(jnp.asarray(2.0))[1],
    )
    np.testing.assert_allclose([value, slope], [0.5 + 1.5, -0.25])
    assert bool(done)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_an_equation_may_close_over_integers_of_a_trace(mode):
    @jax.jit
    def at(scale, rows):
        def equation(x):
            return scale * (A @ x)[rows] + x[rows] ** 3 - B[rows]

        return implicit_root(equation, B, by_newton, by_jacobian)

    scale, rows = jnp.asarray(1.3), jnp.array([1, 0])
    want = exact(np.asarray(root(scale, A)), 1.3, np.asarray(A))
    np.testing.assert_allclose(mode(at)(scale, rows), want, rtol=1e-12)
