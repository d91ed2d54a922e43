"""Products of a few numbers as sums: the same numbers, derivatives and lanes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from sorojax._jax import small_products
from sorojax._jax.small_products import LARGEST, LARGEST_BATCH, product_p, with_sums
from sorojax.math.compiled import chunked_lanes
from sorojax.math.ode.explicit import RK4, explicit_step

pytestmark = [
    pytest.mark.versions,
    pytest.mark.skipif(product_p is None, reason=small_products.status()),
]

SHAPES = {
    "dot": ((3,), (3,), "i,i->"),
    "matrix by vector": ((3, 2), (2,), "ij,j->i"),
    "vector by matrix": ((3,), (3, 2), "i,ij->j"),
    "matrices": ((2, 3), (3, 2), "ij,jk->ik"),
    "outer": ((3,), (2,), "i,j->ij"),
    "two axes, crossed": ((2, 3, 2), (3, 2, 2), "ijk,jim->km"),
    "shared axis": ((2, 3), (3, 2, 2), "ij,jki->ik"),
}


def example(case):
    rng = np.random.default_rng(3)
    first, second, how = SHAPES[case]
    a, b = (jnp.asarray(rng.normal(size=shape)) for shape in (first, second))
    return a, b, lambda a, b: jnp.einsum(how, a, b)


def names(function, *args):
    return str(jax.make_jaxpr(function)(*args))


def summed(function):
    return jax.jit(lambda *args: with_sums(function, *args)(*args))


@pytest.mark.parametrize("case", SHAPES)
def test_sums_are_products(case):
    a, b, product = example(case)
    new = summed(product)
    assert "small_product" in names(new, a, b) and "dot_general" not in names(new, a, b)
    np.testing.assert_allclose(new(a, b), product(a, b), rtol=1e-14)
    check_grads(new, (a, b), order=2, modes=("fwd", "rev"), atol=1e-7, rtol=1e-7)


@pytest.mark.parametrize("axes", [(0, None), (None, 1), (1, 0)])
@pytest.mark.parametrize("case", SHAPES)
def test_lanes_are_products_one_by_one(case, axes):
    a, b, product = example(case)
    a, b = (
        x if axis is None else jnp.stack([x, 2 * x, x - 1], axis)
        for x, axis in zip((a, b), axes, strict=True)
    )
    got = jax.vmap(summed(product), axes)(a, b)
    np.testing.assert_allclose(got, jax.vmap(product, axes)(a, b), rtol=1e-13)


def test_large_products_and_many_lanes_stay_with_the_library():
    small, large = jnp.ones((2, 3)), jnp.ones((LARGEST, 2))
    assert "small_product" not in names(summed(jnp.dot), large, jnp.ones(2))
    few, many = (jnp.ones((count, 3)) for count in (2, LARGEST_BATCH))
    lanes = jax.vmap(summed(jnp.dot), (None, 0))
    assert "dot_general" not in names(lanes, small, few)
    assert "dot_general" in names(lanes, small, many)


def test_empty_products_stay_with_the_library():
    empty = jnp.ones((2, 0))
    np.testing.assert_array_equal(summed(jnp.dot)(empty, jnp.ones(0)), np.zeros(2))
    assert "small_product" not in names(summed(jnp.dot), empty, jnp.ones(0))


def test_run_one_by_one_a_field_stays_as_it_is():
    def field(t, y):
        return jnp.ones((2, 2)) @ y + t

    assert with_sums(field, 0.0, jnp.ones(2)) is field


def test_a_field_is_traced_once():
    calls = []

    def field(t, y):
        calls.append(t)
        return {"q": -y["q"], "none": None}

    start = {"q": jnp.ones(2), "none": None}
    zero, h = jnp.zeros(()), jnp.asarray(0.1)
    end = jax.jit(lambda y: explicit_step(RK4, field, zero, y, h))(start)
    assert len(calls) == 1 and end["none"] is None
    np.testing.assert_allclose(end["q"], np.exp(-0.1), rtol=1e-6)


def test_derivatives_keep_their_products():
    """Products keep compilers from computing factors again in every lane."""
    slope = names(jax.jacfwd(summed(jnp.dot), 1), jnp.ones((2, 3)), jnp.ones(3))
    assert "dot_general" in slope and "small_product" not in slope


def test_products_within_compiled_functions_count_too():
    inner = jax.jit(lambda a, y: a @ y)
    program = names(summed(lambda a, y: inner(a, y) + y), jnp.eye(2), jnp.ones(2))
    assert "small_product" in program and "dot_general" not in program


def test_a_product_outside_of_jit_is_the_library_one():
    numbers = dict(dimension_numbers=(((1,), (0,)), ((), ())), precision=None)
    numbers |= dict(preferred_element_type=None, out_sharding=None)
    a, b = jnp.arange(6.0).reshape(2, 3), jnp.ones(3)
    np.testing.assert_array_equal(product_p.bind(a, b, **numbers), a @ b)


def test_products_behind_rules_for_derivatives_and_lanes_become_sums_too():
    """As those of a rod's acceleration."""
    verb = chunked_lanes(lambda x, y: y @ x)
    x, y = jnp.arange(3.0), jnp.ones((2, 3))
    program = jax.make_jaxpr(lambda x, y: with_sums(verb, x, y)(x, y))(x, y)
    assert "small_product" in str(program) and "dot_general" not in str(program)
    every = jax.vmap(lambda x: with_sums(verb, x, y)(x, y))(jnp.stack([x, 2 * x]))
    np.testing.assert_allclose(every, [y @ x, 2 * y @ x])
    np.testing.assert_allclose(jax.jacrev(lambda x: with_sums(verb, x, y)(x, y))(x), y)
