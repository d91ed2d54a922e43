"""Whether a function reads its argument."""

import jax
import jax.numpy as jnp
import pytest

from sorojax.math.depends import depends

X = jnp.ones(3)


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
