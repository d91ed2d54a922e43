"""What is read from the program of a function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax._jax import programs
from sorojax._jax.programs import Remainder, depends, is_one_loop, split

X = jnp.ones(3)
readable = pytest.mark.skipif(programs.status() != "on", reason=programs.status())
pytestmark = pytest.mark.versions


@readable
@pytest.mark.parametrize(
    ("function", "reads"),
    [
        (lambda x: 2.0 * x, True),
        (lambda x: x, True),
        (lambda x: jnp.where(x > 0, 1.0, 2.0), True),
        (jax.jit(jnp.sin), True),
        (lambda x: jnp.full(x.shape, 2.0), False),
        (lambda x: jnp.zeros_like(x) + 1.0, False),
        (jax.grad(lambda x: jnp.sum(3.0 * x)), False),
        (jax.grad(lambda x: jnp.sum(x**2)), True),
    ],
)
def test_only_what_is_computed_from_the_argument_depends_on_it(function, reads):
    assert depends(function, X) is reads


@readable
@pytest.mark.parametrize(
    ("function", "one"),
    [
        (lambda x: jnp.sin(x) + 2 * x, True),
        (jax.jit(lambda x: jnp.where(x > 0, x, -x)), True),
        (lambda x: jnp.min(x[:, None] - x[None], axis=1), False),
        (lambda x: jax.lax.fori_loop(0, 3, lambda _, y: jnp.cos(y), x), False),
        (jax.jit(lambda x: x[jnp.argsort(x)]), False),
    ],
)
def test_a_table_or_a_search_for_each_entry_is_more_than_one_loop(function, one):
    assert is_one_loop(function, X) is one


def test_where_programs_cannot_be_read_the_answer_is_right_for_all(monkeypatch):
    monkeypatch.setattr(programs, "_READABLE", False)
    assert depends(lambda x: jnp.zeros_like(x), X)
    assert not is_one_loop(jnp.sin, X)


# Functions in two parts: the same numbers and derivatives


POINT, SCALE = jnp.array([0.3, -0.2]), jnp.array([2.0, 3.0])


def inner(x, scale):
    return jnp.sin(scale) @ jnp.exp(scale) * jnp.tanh(x)


def rate(x, scale):
    """Fixed work in an inner program, a branch on `x`, and the same product twice."""
    twice = jax.jit(inner)(x, scale) + jax.jit(inner)(x, scale)
    return jax.lax.cond(x[0] > 0, lambda: twice * scale, lambda: twice - scale)


def through(x, scale):
    constants, remainder = split(lambda x: rate(x, scale), jnp.zeros(2))
    return remainder(constants, x)


def test_the_two_parts_are_the_function():
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(
            jax.jit(through)(sign * POINT, SCALE), rate(sign * POINT, SCALE)
        )


@readable
def test_fixed_work_is_done_before_and_equal_work_once():
    kept = []

    def noted(x, scale):
        constants, remainder = split(lambda x: rate(x, scale), jnp.zeros(2))
        kept.append(remainder)
        return remainder(constants, x)

    jax.make_jaxpr(noted)(POINT, SCALE)
    assert isinstance(kept[0], Remainder)
    names = [step.equation.primitive.name for step in kept[0].steps]
    assert names.count("tanh") == 1
    assert not {"sin", "exp", "dot_general"} & set(names)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivatives_by_both_parts(derivative):
    found = jax.jit(derivative(through, (0, 1)))(POINT, SCALE)
    for ours, plain in zip(found, derivative(rate, (0, 1))(POINT, SCALE), strict=True):
        np.testing.assert_allclose(ours, plain, rtol=1e-12)


def test_lanes():
    both = jnp.stack([POINT, -POINT]), jnp.stack([SCALE, 2 * SCALE])
    np.testing.assert_allclose(jax.vmap(through)(*both), jax.vmap(rate)(*both), rtol=1e-12)
    fixed = jax.vmap(through, (0, None))(both[0], SCALE)
    np.testing.assert_allclose(fixed, jax.vmap(rate, (0, None))(both[0], SCALE), rtol=1e-12)


def test_outputs_and_inputs_may_be_trees_and_need_not_depend_on_the_arguments():
    def tree(x, scale):
        return {"fixed": jnp.cos(scale), "same": x["a"], "number": jnp.ones(())}

    def parts(x, scale):
        constants, remainder = split(lambda x: tree(x, scale), x)
        return remainder(constants, x)

    found = jax.jit(parts)({"a": POINT}, SCALE)
    np.testing.assert_array_equal(found["same"], POINT)
    np.testing.assert_allclose(found["fixed"], jnp.cos(SCALE))
    assert found["number"] == 1


def test_random_numbers_and_single_precision():
    def noisy(x, key):
        return x + jax.random.normal(key, x.shape, x.dtype)

    def parts(x, key):
        constants, remainder = split(lambda x: noisy(x, key), x)
        return remainder(constants, x)

    x, key = POINT.astype(jnp.float32), jax.random.key(0)
    np.testing.assert_array_equal(jax.jit(parts)(x, key), jax.jit(noisy)(x, key))
