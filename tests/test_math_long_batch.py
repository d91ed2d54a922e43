"""Many lanes of `jax.vmap` run in chunks and give what they give at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax.math.long_batch import long_batches

MANY, FEW = 301, 100
rng = np.random.default_rng(0)
X, Y = jnp.asarray(rng.normal(size=(MANY, 3))), jnp.asarray(rng.normal(size=(3, MANY)))
MIX = jnp.asarray(rng.normal(size=(3, 3)))


def plain(model, x, y=None):
    moved = jnp.sin(model["mix"] @ x)
    return {"sum": jnp.sum(moved), "both": moved if y is None else moved * y}


verb = long_batches(plain)


def agree(function, *args):
    """Of the two verbs, whatever transformations are around them."""
    found, want = function(verb)(*args), function(plain)(*args)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), found, want)


def loops(function, *args) -> int:
    return str(jax.make_jaxpr(function)(*args)).count("scan[")


def over_states(f):
    return jax.vmap(lambda x: f({"mix": MIX}, x))


def test_only_many_lanes_make_chunks():
    assert loops(over_states(verb), X) == 1
    assert loops(over_states(verb), X[:FEW]) == 0
    assert loops(over_states(plain), X) == 0


@pytest.mark.parametrize("count", [1, FEW, 129, 256, MANY])
def test_lanes_of_any_number(count):
    agree(over_states, X[:count])
    agree(lambda f: jax.jit(over_states(f)), X[:count])


def test_arguments_that_move_differently():
    def mixed(f):
        return jax.vmap(lambda x, y: f({"mix": MIX}, x, y=y), in_axes=(0, 1))

    def models(f):
        return jax.vmap(lambda scale: f({"mix": scale * MIX}, X[0]))

    agree(mixed, X, Y)
    agree(models, X[:, 0])
    agree(lambda f: jax.vmap(lambda scale: over_states(f)(scale * X)), jnp.arange(1.0, 3.0))
    agree(lambda f: jax.vmap(lambda x: over_states(f)(x * X[:4])), X[:, 0])


def test_derivatives_take_all_lanes_at_once():
    def total(f):
        return jax.grad(lambda x: jnp.sum(over_states(f)(x)["both"]))

    def slopes(f):
        return jax.vmap(jax.grad(lambda x: f({"mix": MIX}, x)["sum"]))

    for derivative in (total, slopes, lambda f: jax.jit(total(f)), lambda f: total(jax.jit(f))):
        agree(derivative, X)
        assert loops(derivative(verb), X) == 0
    agree(lambda f: lambda x: jax.jvp(over_states(f), (x,), (x[::-1],)), X)
    agree(lambda f: jax.grad(lambda x: jnp.sum(jax.jit(over_states(f))(x)["sum"])), X)


def test_lanes_that_a_loop_closes_over():
    """The loop is traced before its lanes are seen, so the call has to wait inside."""

    def around(f):
        def one(x):
            def step(carry, _):
                return carry + f({"mix": MIX}, x)["both"], None

            return jax.lax.scan(step, jnp.zeros(3), None, 3)[0]

        return jax.vmap(one)

    agree(around, X)
    agree(lambda f: jax.jit(around(f)), X)
    agree(lambda f: jax.grad(lambda x: jnp.sum(around(f)(x))), X)
