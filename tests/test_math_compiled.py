"""Functions of pytrees compiled: what is traced, what is static, when they compile again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax.math.compiled import jit_trees


@pytest.fixture
def scaled():
    """A function, and the list to which it adds whenever it is traced."""
    traces = []

    @jit_trees
    def scaled(x, factor=1, *more, name="x", **others):
        traces.append(name)
        return {name: x * factor + sum(more), "factor": factor, **others}

    return scaled, traces


def test_place_and_name_of_an_argument_share_a_program(scaled):
    function, traces = scaled
    x = jnp.arange(3.0)
    for answer in (function(x, 2), function(x, factor=2), function(factor=2, x=x)):
        assert answer["x"].tolist() == [0.0, 2.0, 4.0]
    assert len(traces) == 1
    assert function(x, 2, 1.0)["x"].tolist() == [1.0, 3.0, 5.0]


def test_what_is_no_array_is_static_and_comes_back_as_it_is(scaled):
    function, traces = scaled
    answer = function(np.arange(3.0), 2, name="y", told=("a", None))
    assert isinstance(answer["y"], jax.Array)
    assert answer["factor"] == 2 and type(answer["factor"]) is int
    assert answer["told"] == ("a", None)
    function(jnp.ones(3), 2, name="y", told=("a", None))
    assert len(traces) == 1


def test_values_that_are_equal_but_of_other_types_are_told_apart():
    function = jit_trees(lambda x, kind: (x, kind))
    found = [function(jnp.ones(1), kind)[1] for kind in (1, True, 1.0)]
    assert [type(value) for value in found] == [int, bool, float]


def test_arrays_are_traced_within_transformations(scaled):
    function, _ = scaled
    x = jnp.arange(3.0)
    slope = jax.grad(lambda x, k: jnp.sum(function(x, k)["x"]), argnums=1)(x, jnp.array(2.0))
    lanes = jax.vmap(lambda k: function(x, factor=k)["x"])(jnp.arange(2.0))
    assert float(slope) == 3.0 and lanes.tolist() == [[0.0] * 3, [0.0, 1.0, 2.0]]
    assert function.__name__ == "scaled"
