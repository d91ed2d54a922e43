"""Networks of assemblies with closures: ends that the network moves, and what they bear."""

import jax
import jax.numpy as jnp
import pytest

from sorojax import SE2, Status, rod, systems
from sorojax.math.lie import homogeneous

SOFT = {"young_modulus": 1e6, "poisson_ratio": 0.5, "density": 1000}
BEAM = rod.rod(
    SE2(), rod.chebyshev(kappa_z=2, sigma_x=1), rod.circle(5e-3), length=0.1, nodes=6, **SOFT
)
STROKE, PULSE = 2e-3, 30.0  # m, rad/s
DAMPED = (rod.Damping(0.02), rod.Gravity())


def place(t):
    return homogeneous(jnp.eye(2), jnp.stack([0 * t, STROKE * (1 - jnp.cos(PULSE * t))]))


class Lift(systems.AbstractReference):
    """Velocity of the base: it rises and falls."""

    def __call__(self, t):
        return jnp.stack([0 * t, 0 * t, STROKE * PULSE * jnp.sin(PULSE * t)])


def held(motion=None):
    """A rod that nothing but its base holds."""
    tree = rod.assembly(SE2(), rod=rod.Part(BEAM, rod.Free()))
    return rod.with_closures(tree, base=rod.Closure("rod", at=0.0, motion=motion))


def shaken(body=None):
    body = body or systems.AssemblyBody(held(), DAMPED, moved=("base",))
    source = systems.Source(Lift())
    return systems.Network({"rod": body, "lift": source}, {"rod.base_velocity": "lift.value"})


def test_a_base_that_a_network_moves_follows_as_one_that_moves_in_time():
    model = held(place)
    zero = jnp.zeros(6)
    options = {"step": 1e-3, "saves": 10, "every": 10}
    want = rod.rollout(model, zero, zero, DAMPED, **options)
    film = systems.simulate(shaken(), 0.1, save=11, rtol=1e-6)
    assert film.status == Status.successful
    base = film.state["rod"]["q"][:, 2]
    lag = jnp.max(jnp.abs(base - jax.vmap(place)(film.time)[:, 1, 2])) / STROKE
    assert lag < 0.1 * PULSE / 100  # of the servo at its rate
    strains, found = want.q[:, 3:], film.state["rod"]["q"][:, 3:]
    size = jnp.max(jnp.abs(strains), axis=0, keepdims=True)
    assert jnp.max(jnp.abs(found - strains) / size) < 0.01
    bears, should = film.outputs["rod.base_wrench"], want.reactions["base"]
    # the servo does not know the acceleration that the motion begins with
    assert jnp.max(jnp.abs(bears - should)[1:, 2]) < 0.01 * jnp.max(should[:, 2])


def test_what_cannot_be_moved_is_refused():
    with pytest.raises(ValueError, match="`moved` names `tip`, need a closure"):
        systems.AssemblyBody(held(), DAMPED, moved=("tip",))
    with pytest.raises(ValueError, match="without a motion of its own"):
        systems.AssemblyBody(held(place), DAMPED, moved=("base",))
