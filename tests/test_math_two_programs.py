"""Functions of which each derivative is one program: the numbers of plain ones, and how many
programs they are."""

import contextlib
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax._jax import small_kernels
from sorojax.math.two_programs import linear_program, two_programs

pytestmark = pytest.mark.versions

X = jnp.linspace(0.5, 1.5, 3)


class Spring(eqx.Module):
    stiffness: jax.Array
    name: str = eqx.field(static=True, default="spring")


def plain(spring, x, power):
    force = spring.stiffness * jnp.sin(x) ** power
    return {"force": force, "spring": Spring(2 * spring.stiffness), "count": jnp.arange(2)}


whole, keeping = two_programs(plain), two_programs(plain, keeps=True)


def energy(function, stiffness, x):
    return jnp.sum(function(Spring(stiffness), x, 2)["force"] ** 2)


@pytest.mark.parametrize("programs", [whole, keeping])
@pytest.mark.parametrize(
    "way",
    [
        jax.value_and_grad,
        jax.jacfwd,
        jax.hessian,
        lambda f: jax.jit(jax.grad(f)),
        lambda f: lambda s, x: jax.vmap(jax.grad(f), (None, 0))(s, jnp.stack([x, 2 * x])),
        lambda f: (
            lambda s, x: jax.grad(lambda x: jnp.sum(jax.vmap(f, (None, 0))(s, x)))(
                jnp.stack([x, 2 * x])
            )
        ),
    ],
)
def test_derivatives_are_those_of_the_plain_function(way, programs):
    found, known = (way(lambda s, x, f=f: energy(f, s, x))(X[0], X) for f in (programs, plain))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), found, known)


def test_what_is_static_is_returned_as_it_is():
    found = whole(Spring(X[0]), np.asarray(X), 3)
    assert found["spring"].name == "spring"
    np.testing.assert_array_equal(found["count"], np.arange(2))
    np.testing.assert_allclose(found["force"], plain(Spring(X[0]), X, 3)["force"])


@contextlib.contextmanager
def compiled():
    """The names of programs that are compiled."""
    names, open_ = [], [True]

    def listen(event, _, **about):
        if open_[0] and event == "/jax/core/compile/backend_compile_duration":
            names.append(about.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield names
    open_[0] = False


def test_a_gradient_is_the_program_of_the_value_and_one_more():
    @two_programs
    def lonely(x):
        return jnp.cumsum(jnp.tanh(x)), jnp.prod(x)

    lonely(X)
    with compiled() as names:
        cotangents = jax.vjp(lambda x: lonely(x)[0], X)[1](X)
    assert [name for name in names if "lonely" in name] == ["jit(lonely_pulled)"]
    with compiled() as names:
        again = jax.vjp(lambda x: lonely(x)[0], 2 * X)[1](X)
    assert not [name for name in names if "lonely" in name]
    assert not np.allclose(cotangents[0], again[0])


def test_a_value_with_what_its_derivative_needs_and_a_program_for_each_direction():
    @functools.partial(two_programs, keeps=True)
    def alone(x):
        return jnp.cumsum(jnp.tanh(x)), jnp.prod(x), jnp.arange(2)

    def sums(x):
        return alone(x)[0]

    with compiled() as names:
        pulled = jax.vjp(sums, X)[1](X)[0]
        jax.vjp(sums, 2 * X)[1](X)
    programs = [name for name in names if "alone" in name or "_by" in name]
    assert programs == ["jit(alone_linearised)", "jit(_pulled_by)"]
    with compiled() as names:
        pushed = jax.jvp(sums, (X,), (X,))[1]
    assert [name for name in names if "alone" in name or "_by" in name] == ["jit(_pushed_by)"]
    slope = jnp.tril(jnp.ones((3, 3))) / jnp.cosh(X)[None] ** 2
    np.testing.assert_allclose(pulled, slope.T @ X)
    np.testing.assert_allclose(pushed, slope @ X)


def test_lanes_that_go_one_after_the_other():
    def steps(x, limit):
        """As many as a lane needs."""
        return jax.lax.while_loop(lambda x: jnp.sum(x) < limit, lambda x: x + 0.3, x)

    apart = two_programs(steps, lanes_apart=True, kernels=True)
    many, limits = jnp.linspace(0.1, 1.0, 15).reshape(5, 3), jnp.linspace(1.0, 30.0, 5)
    for axes in ((0, None), (None, 0), (0, 0)):
        given = [x if a == 0 else x[2] for a, x in zip(axes, (many, limits), strict=True)]
        found, known = (jax.vmap(f, axes)(*given) for f in (apart, steps))
        np.testing.assert_allclose(found, known, rtol=1e-13)
    twice = jax.vmap(jax.vmap(apart, (0, None)), (None, 0))(many, limits)
    np.testing.assert_allclose(twice[1], jax.vmap(apart, (0, None))(many, limits[1]))
    with compiled() as names:
        jax.vmap(apart, (0, None))(many[:4], limits[0])
    if small_kernels.status() == "on":
        assert "jit(steps_lanes)" in names


@pytest.mark.parametrize("keeps", [False, True])
@pytest.mark.parametrize("way", [jax.grad, jax.jacfwd])
def test_functions_that_close_over_what_is_differentiated(keeps, way):
    @functools.partial(two_programs, keeps=keeps, lanes_apart=True)
    def applied(x, function):
        return function(x)

    def both(y):
        return applied(2 * y, lambda x: jnp.sin(x) * y)

    want = 2 * jnp.cos(2.0) + jnp.sin(2.0)
    assert float(way(both)(1.0)) == pytest.approx(float(want))
    np.testing.assert_allclose(jax.vmap(both)(X), jnp.sin(2 * X) * X)


def test_the_derivative_may_have_other_static_arguments():
    seen = []

    def power(x, count):
        seen.append(count)
        return x**2, jnp.full((), 2)

    few = two_programs(power, lambda found, x, count: (x, int(found[1])))
    slope = jax.grad(lambda x: few(x, 100)[0])(X[1])
    assert float(slope) == pytest.approx(2.0)
    assert set(seen) == {100, 2}


def test_a_linear_program_and_its_transpose():
    @linear_program
    def product(given, rates):
        matrix, (x, y) = given, rates
        return matrix @ x if y is None else matrix @ x + y

    matrix = jnp.arange(6.0).reshape(2, 3)

    def f(x, y=None):
        return product(matrix, (x, y), X[:2])

    np.testing.assert_allclose(f(X, X[:2]), matrix @ X + X[:2])
    np.testing.assert_allclose(jax.jacrev(f)(X), matrix)
    np.testing.assert_allclose(
        jax.grad(lambda x: jnp.sum(f(x) ** 2))(X), 2 * matrix.T @ matrix @ X
    )
    np.testing.assert_allclose(jax.jit(jax.jacfwd(f))(X), matrix)
