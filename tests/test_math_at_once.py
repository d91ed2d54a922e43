"""Functions whose derivative is one operation: the same numbers as `jax.jit` everywhere."""

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax.math.at_once import at_once

X, Y, K = jnp.arange(3.0) + 0.3, jnp.full(3, 1.7), jnp.arange(2)


def parts(x, y, k):
    return {"a": jnp.sum(x**2 * y), "b": 2 * y, "c": k + 1, "d": jnp.sin(x)}


def cost(function):
    def loss(x, y=Y):
        found = function(x, y, K)
        return found["a"] * jnp.sum(found["d"]) + jnp.sum(found["b"])

    return loss


def squared_slope(f):
    return jax.grad(lambda x: jnp.sum(jax.grad(f)(x) ** 2))


TRANSFORMATIONS = {
    "grad": jax.grad,
    "hessian": jax.hessian,
    "jacfwd": jax.jacfwd,
    "jit of grad": lambda f: jax.jit(jax.grad(f)),
    "grad of jit": lambda f: jax.grad(jax.jit(f)),
    "jit of hessian": lambda f: jax.jit(jax.hessian(f)),
    "grad of grad": squared_slope,
}


@pytest.mark.parametrize("name", TRANSFORMATIONS)
def test_transformations(name):
    change = TRANSFORMATIONS[name]
    want, found = change(cost(parts)), change(cost(at_once(parts)))
    np.testing.assert_allclose(found(X), want(X), rtol=1e-12)
    rows = jnp.stack([X, 2 * X])
    np.testing.assert_allclose(jax.vmap(found)(rows), jax.vmap(want)(rows), rtol=1e-12)


def test_both_arguments_and_along_a_way():
    want, found = cost(parts), cost(at_once(parts))
    for argnums in (0, 1, (0, 1)):
        slopes = jax.grad(found, argnums)(X, Y), jax.grad(want, argnums)(X, Y)
        np.testing.assert_allclose(*map(jnp.stack, map(jax.tree.leaves, slopes)), rtol=1e-12)
    along = [jax.jvp(f, (X, Y), (Y, X))[1] for f in (want, found)]
    np.testing.assert_allclose(*along, rtol=1e-12)


def test_what_does_not_move_has_no_derivative():
    """A result that only passes through is as still as under `jax.jit`."""
    seen = {}

    def loss(x):
        seen.update(at_once(parts)(x, Y, K))
        return seen["a"]

    jax.grad(loss)(X)
    still = {name for name, part in seen.items() if not isinstance(part, jax.core.Tracer)}
    assert still == {"b", "c"}


def test_numbers_do_not_compile_again():
    count = 0

    @at_once
    def function(x, y):
        nonlocal count
        count += 1
        return jnp.sum(x * y)

    jax.grad(function)(X, Y)
    once = count
    for scale in (2.0, 3.0):
        slope = jax.grad(function)(X * scale, Y + scale)
        np.testing.assert_allclose(slope, Y + scale, rtol=1e-15)
    assert count == once


def test_without_the_private_door_of_jax(monkeypatch):
    """Where a version of JAX has it no longer, or another, the derivative is traced."""
    ad = pytest.importorskip("jax._src.interpreters.ad")
    told = jax.grad(cost(at_once(parts)))(X)
    rules = getattr(ad, "primitive_linearizations", {})
    for rule in [r for r in rules if r.name == "at_once"]:
        monkeypatch.delitem(rules, rule)
    np.testing.assert_array_equal(jax.grad(cost(at_once(parts)))(X), told)
