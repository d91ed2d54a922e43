"""What is read from the program of a function."""

import jax
import jax.numpy as jnp
import pytest

from sorojax._jax import programs
from sorojax._jax.programs import depends, is_one_loop

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
