"""How far bodies get within a step."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.rod.link import LinkMotion
from sorojax.rod.motion import Motion

_SURGE = 100.0  # acceleration that a broad phase allows for within a step [m/s^2]


def travel(moment: Motion | LinkMotion, h: Float[Array, ""]) -> Float[Array, ""]:
    """How far [m] any section, or the frame of a link, may move within a step of `h` [s]."""
    return twice_way(moment, h) + _SURGE * h**2


def twice_way(moment: Motion | LinkMotion, h: Float[Array, ""]) -> Float[Array, ""]:
    """Twice what the fastest section, or the frame of a link, moves in `h` [s] as it moves
    now [m]."""
    if isinstance(moment, LinkMotion):
        velocity = (moment.base.linear_jacobian @ moment.v)[None]
    else:
        velocity = moment.linear_jacobian.reshape(-1, moment.v.shape[0]) @ moment.v
        velocity = velocity.reshape(moment.tangent.shape)
    return 2 * h * jnp.sqrt(jnp.max(jnp.sum(velocity**2, axis=1)))


def twice_turn(moment: Motion | LinkMotion, h: Float[Array, ""]) -> Float[Array, ""]:
    """Twice what the section that spins fastest turns in `h` [s] as it moves now [rad]."""
    spin = moment.angular_jacobian.reshape(-1, moment.v.shape[0]) @ moment.v
    spin = spin.reshape(moment.angular_jacobian.shape[:2])
    return 2 * h * jnp.sqrt(jnp.max(jnp.sum(spin**2, axis=1)))
