"""Operations of our own, as primitives and by public names alone: the same numbers under
every transformation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax._jax import host_call as host_calls, operations
from sorojax._jax.host_call import host_call, tell_host
from sorojax._jax.operations import Rules
from sorojax.math import linear_map as linear_maps

pytestmark = pytest.mark.versions

X = jnp.linspace(0.5, 1.5, 3)
KINDS = ["primitive", "public"] if operations.status() == "on" else ["public"]


@pytest.fixture(params=KINDS)
def made(request):
    """Makes operations of one kind or the other."""
    if request.param == "public":
        return operations._public
    return lambda rules: operations._primitive("tried", rules)


def rules(runs):
    """Of `power * x`, which notes in `runs` how often it ran at once."""

    def run(x, power):
        runs.append(power)
        return [power * x]

    def stage(x, power):
        return [power * x]

    def shapes(x, power):
        return [jax.ShapeDtypeStruct(x.shape, x.dtype)]

    def batch(arrays, axes, power):
        return [power * jnp.moveaxis(arrays[0], axes[0], 0)]

    def derivative(primals, tangents, power):
        return stage(*primals, power), stage(*tangents, power)

    return Rules(
        run, stage, shapes, batch, derivative, lambda changes, power: stage(*changes, power)
    )


def test_concrete_arrays_run_at_once_and_traced_ones_are_staged(made):
    runs = []
    double = made(rules(runs))
    np.testing.assert_array_equal(double(X, power=2)[0], 2 * X)
    assert runs == [2]
    np.testing.assert_array_equal(jax.jit(lambda x: double(x, power=3)[0])(X), 3 * X)
    assert runs == [2]


def test_transformations(made):
    triple = made(rules([]))

    def cost(x):
        return jnp.sum(triple(x, power=3)[0] ** 2)

    np.testing.assert_allclose(jax.grad(cost)(X), 18 * X)
    np.testing.assert_allclose(jax.jit(jax.hessian(cost))(X), 18 * np.eye(3))
    rows = jnp.stack([X, 2 * X])
    np.testing.assert_allclose(jax.vmap(jax.grad(cost))(rows), 18 * rows)
    lanes = jax.vmap(lambda x: triple(x, power=3)[0], in_axes=1, out_axes=1)
    np.testing.assert_allclose(lanes(rows.T), 3 * rows.T)
    np.testing.assert_allclose(jax.grad(lambda x: jnp.sum(jax.vmap(cost)(x)))(rows), 18 * rows)


class Product:
    """x -> A x as a `LinearMap` that counts its work at concrete numbers."""

    def __init__(self, matrix):
        self.matrix, self.count = matrix, 0
        self.inputs = (jax.ShapeDtypeStruct(matrix.shape[1:], matrix.dtype),)
        self.outputs = (jax.ShapeDtypeStruct(matrix.shape[:1], matrix.dtype),)

    def push(self, x):
        return (self.matrix @ x,)

    def pull(self, y):
        return (y @ self.matrix,)

    def push_now(self, x):
        self.count += 1
        return self.push(x)

    def pull_now(self, y):
        self.count += 1
        return self.pull(y)


@pytest.mark.parametrize("kind", KINDS)
def test_a_linear_map_and_its_transpose(kind, monkeypatch):
    if kind == "public":
        for name, way in (("_push", ("push", "outputs")), ("_pull", ("pull", "inputs"))):
            both = (lambda: linear_maps._pull), (lambda: linear_maps._push)
            other, this = both if name == "_push" else both[::-1]
            made = operations._public(linear_maps._rules(*way, other, this))
            monkeypatch.setattr(linear_maps, name, made)
    by = Product(jnp.arange(6.0).reshape(2, 3))

    def f(x):
        return linear_maps.pushed([x], by)[0]

    slope = np.asarray(by.matrix)
    np.testing.assert_allclose(f(X), slope @ X)
    assert by.count == 1
    np.testing.assert_allclose(jax.jacfwd(f)(X), slope)
    np.testing.assert_allclose(jax.jacrev(f)(X), slope)
    np.testing.assert_allclose(jax.jit(jax.jacrev(f))(X), slope)
    np.testing.assert_allclose(
        jax.vmap(f)(jnp.stack([X, -X])), np.stack([slope @ X, -slope @ X])
    )
    np.testing.assert_allclose(
        jax.hessian(lambda x: jnp.sum(f(x) ** 2))(X), 2 * slope.T @ slope
    )
    transposed = jax.linear_transpose(f, X)(jnp.ones(2))[0]
    np.testing.assert_allclose(transposed, slope.sum(0))
    if kind == "primitive":
        assert str(jax.make_jaxpr(f)(X)).count("dot_general") == 0


def scaled(factor, x):
    """Each lane by its factor; arrays may have a leading axis of length one."""
    return (np.asarray(factor)[..., None] * np.asarray(x),)


@pytest.fixture(params=KINDS)
def call(request, monkeypatch):
    if request.param == "public":
        plain = Rules(
            host_calls._run,
            host_calls._by_pure_callback,
            host_calls._shapes,
            host_calls._batched,
        )
        monkeypatch.setattr(host_calls, "_host_call", operations._public(plain))
    return host_call


@pytest.mark.parametrize("sequential", [False, True])
def test_functions_of_the_host(call, sequential):
    shape = jax.ShapeDtypeStruct((3,), X.dtype)

    def f(factor, x):
        return call(scaled, (shape,), factor, x, sequential=sequential)[0]

    two = jnp.asarray(2.0)
    np.testing.assert_array_equal(f(two, X), 2 * X)
    np.testing.assert_array_equal(jax.jit(f)(two, X), 2 * X)
    factors, rows = jnp.arange(4.0), jnp.stack([X, -X, X, 2 * X])
    for over in (jax.vmap(f), jax.jit(jax.vmap(f))):
        np.testing.assert_array_equal(over(factors, rows), np.asarray(factors)[:, None] * rows)
    shared = jax.jit(jax.vmap(f, (0, None)))(factors, X)
    np.testing.assert_array_equal(shared, np.multiply.outer(factors, X))
    nested = jax.jit(jax.vmap(jax.vmap(f, (None, 0)), (0, None)))(factors, rows)
    np.testing.assert_array_equal(nested, np.multiply.outer(factors, rows))


def test_messages_to_the_host():
    heard = []
    jax.jit(lambda x: tell_host(lambda value: heard.append(float(value)), jnp.sum(x)))(X)
    jax.effects_barrier()
    assert heard == [3.0]
