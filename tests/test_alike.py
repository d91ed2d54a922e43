"""Programs that hold equal work once, and that compile quickly."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax._jax.jit import once
from sorojax.rod.dynamics.tree import each


class Spring(eqx.Module):
    stiffness: jax.Array
    kind: str = eqx.field(static=True, default="linear")


def force(spring, x):
    force.traced += 1
    power = 1 if spring.kind == "linear" else 3
    return spring.stiffness * x**power, jnp.sum(x)


def test_equal_rows_share_a_loop_and_keep_their_order():
    x = jnp.arange(3.0)
    springs = [Spring(jnp.array(2.0)), Spring(jnp.array(3.0), "cubic"), Spring(jnp.array(5.0))]
    rows = [(spring, x + k) for k, spring in enumerate(springs)] + [(springs[0], x[:2])]
    force.traced = 0
    found = jax.jit(lambda rows: each(force, rows))(rows)
    assert force.traced == 3  # two are alike; another kind and another shape are not
    for answer, row in zip(found, rows, strict=True):
        for one, other in zip(answer, force(*row), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-15)


def test_what_is_compiled_once_works_within_other_programs():
    def energy(spring, x):
        return jnp.sum(spring.stiffness * jnp.sin(x) ** 2)

    quick, spring, x = once(energy), Spring(jnp.array(2.0)), jnp.linspace(0.1, 1.0, 2000)
    np.testing.assert_allclose(quick(spring, x), energy(spring, x), rtol=1e-14)
    for change in (jax.grad, jax.jit, lambda f: jax.vmap(f), lambda f: jax.jit(jax.hessian(f))):
        asked = x[:3]
        ours, plain = (change(lambda x, f=f: f(spring, x))(asked) for f in (quick, energy))
        np.testing.assert_allclose(ours, plain, rtol=1e-13)
