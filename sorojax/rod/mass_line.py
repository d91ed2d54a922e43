"""Where the mass of the sections is, beside the axis of the rod."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.rod.moving import levers


def mass_arms(moment: Any) -> Float[Array, "quad dim"] | None:
    """From the centre line to the centres of mass [m]; None where they lie on it."""
    offset = moment.operators.mass_offset
    if offset is None:
        return None
    across = moment.directors[:, :, 1:]
    return jnp.sum(across * offset.T[:, None, :], axis=2)


def mass_jacobian(moment: Any) -> Float[Array, "quad dim dof"]:
    """Velocity of the centres of mass per rate."""
    return on_arms(moment, moment.linear_jacobian, mass_arms(moment))


def mass_position(moment: Any) -> Float[Array, "quad dim"]:
    """Centres of mass [m]."""
    arms = mass_arms(moment)
    return moment.position if arms is None else moment.position + arms


def on_arms(
    moment: Any, linear: Float[Array, "quad dim dof"], arms: Float[Array, "quad dim"] | None
) -> Float[Array, "quad dim dof"]:
    """Jacobians of the ends of arms."""
    if arms is None:
        return linear
    return linear + levers(arms) @ moment.angular_jacobian


def acceleration_on_arms(
    linear: Float[Array, "quad dim"],
    angular: Float[Array, "quad rot"],
    spin: Float[Array, "quad rot"],
    arms: Float[Array, "quad dim"] | None,
) -> Float[Array, "quad dim"]:
    """Acceleration of the ends of arms: a + alpha x arm + spin x (spin x arm)."""
    if arms is None:
        return linear
    velocity = (levers(arms) @ spin[:, :, None])[:, :, 0]
    tangential = (levers(arms) @ angular[:, :, None])[:, :, 0]
    return linear + tangential + (levers(velocity) @ spin[:, :, None])[:, :, 0]
