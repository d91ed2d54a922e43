"""Which values are traced and whether a transformation runs, with and without names that JAX
does not promise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax._jax import trace_state
from sorojax._jax.trace_state import evaluated_now, is_traced, outside_transformations

pytestmark = pytest.mark.versions
X = jnp.arange(3.0)


@pytest.fixture(params=["found", "missing"])
def names(request, monkeypatch):
    if request.param == "missing":
        for name in ("_tracer", "_eval_context", "_state"):
            monkeypatch.setattr(trace_state, name, None)
    return request.param


def seen(transformation):
    """What is traced inside a transformation, of its argument and of a constant."""
    found = []

    def look(x):
        found.append((is_traced({"x": x}), is_traced(X), outside_transformations()))
        return jnp.sum(x)

    transformation(look)(X)
    return found[0]


@pytest.mark.parametrize("how", [jax.jit, jax.grad, jax.vmap, jax.jacfwd])
def test_arguments_of_transformations_are_traced(names, how):
    assert seen(how) == (True, False, False)


def test_concrete_numbers_are_not(names):
    assert not is_traced([X, 1.0, np.ones(2), jax.random.key(0), "word", None])
    known = names == "found" and trace_state._state is not None
    assert outside_transformations() is known


@pytest.mark.parametrize("how", [jax.jit, jax.grad])
def test_concrete_numbers_are_evaluated_inside_a_trace(names, how):
    found = []

    def look(x):
        with evaluated_now(X):
            found.append(is_traced(jnp.sin(X) + 1))
        with evaluated_now(X, x):
            found.append(is_traced(jnp.sin(x)))
        return jnp.sum(x)

    how(look)(X)
    assert found == [False, True]
