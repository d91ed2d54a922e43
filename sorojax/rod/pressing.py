"""Forces between surfaces that touch, on the points of the bodies that carry them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.contact.line import LinePenalty
from sorojax.rod.points import Points, moment_of, safe_norm, spin_cross


class Side(NamedTuple):
    """One of the two bodies at a set of contacts.

    Attributes:
        points: Centres of the sections that touch.
        arm: From the centres to the points of contact [m].
        sign: 1 for the body that the normal points into, -1 for the other.
    """

    points: Points
    arm: Float[Array, "points dim"]
    sign: float


class Touch(NamedTuple):
    """Contacts between two bodies, or one body and a fixed obstacle.

    Attributes:
        gap: Distance of the surfaces [m], negative where they overlap.
        normal: Slope of the gap in the centres of the first body.
        weights: Length that each contact stands for [m].
        sides: The bodies that move.
    """

    gap: Float[Array, " points"]
    normal: Float[Array, "points dim"]
    weights: Float[Array, " points"]
    sides: tuple[Side, ...]


def energy(law: LinePenalty, touch: Touch) -> Float[Array, ""]:
    """Energy stored in the contacts [J]."""
    return touch.weights @ law.energy(touch.gap)


def press(law: LinePenalty, touch: Touch) -> tuple[Float[Array, " dof"], ...]:
    """Generalised force on each side."""
    force = touch.weights * law.pressure(touch.gap)
    if law.friction is None and law.damping is None:
        load = force[:, None] * touch.normal
        return tuple(side.points.generalised(side.sign * load) for side in touch.sides)
    velocity = _velocity(law, touch)
    force = force * law.approach(jnp.sum(touch.normal * velocity, axis=1))
    load = force[:, None] * touch.normal
    if law.friction is None:
        return tuple(side.points.generalised(side.sign * load) for side in touch.sides)
    sliding, size = _sliding(touch, velocity)
    load = load - law.drag(force * size, sliding)[:, None] * sliding
    return tuple(
        side.points.generalised(side.sign * load, side.sign * moment_of(side.arm, load))
        for side in touch.sides
    )


def tangent(
    law: LinePenalty, touch: Touch
) -> tuple[Float[Array, "dof dof"], Float[Array, "dof dof"] | None]:
    """Stiffness and damping of the contacts, for implicit steppers.

    Both are symmetric and positive, over the columns of the sides one after the other:
    the turn of the normal and the change of friction with pressure are left out.
    """
    normal_rows = _rows(touch, lambda side: side.points.linear_jacobian, touch.normal)
    weights = touch.weights
    stiffness, force = law.slope(touch.gap), law.pressure(touch.gap)
    viscous = None
    if law.friction is not None or law.damping is not None:
        velocity = _velocity(law, touch)
        approach = law.approach(jnp.sum(touch.normal * velocity, axis=1))
        stiffness = stiffness * approach
        if law.damping is not None:
            closing = law.damping * force * (approach > 0)
            viscous = _square(normal_rows, weights * closing)
        if law.friction is not None:
            sliding, size = _sliding(touch, velocity)
            drag = weights * law.drag(force * approach * size, sliding)
            term = _friction_square(touch, normal_rows, size, drag)
            viscous = term if viscous is None else viscous + term
    return _square(normal_rows, weights * stiffness), viscous


def coupling(law: LinePenalty, touch: Touch) -> Float[Array, "dof dof"] | float:
    """What friction adds to the stiffness as it grows with pressure; not symmetric."""
    if law.friction is None:
        return 0.0
    velocity = _velocity(law, touch)
    sliding, size = _sliding(touch, velocity)
    approach = law.approach(jnp.sum(touch.normal * velocity, axis=1))
    growth = touch.weights * law.slope(touch.gap) * approach * size
    load = law.drag(growth, sliding)[:, None] * sliding
    across = jnp.sum(_surface_rows(touch) * load[:, :, None], axis=1)
    along = _rows(touch, lambda side: side.points.linear_jacobian, touch.normal)
    return -(across.T @ along)


def _friction_square(touch: Touch, normal_rows, size, drag) -> Array:
    """Square of the sliding velocity per rate: of the whole, less that of its normal part."""
    rows = _surface_rows(touch)
    total = _square(rows, jnp.broadcast_to(drag[:, None], rows.shape[:2]))
    scale = jnp.where(size > 0, size, jnp.ones_like(size))
    return total - _square(normal_rows / scale[:, None], drag)


def _velocity(law: LinePenalty, touch: Touch) -> Float[Array, "points dim"]:
    """Velocity of the first surface against the second [m/s]."""
    total = jnp.zeros_like(touch.normal)
    for side in touch.sides:
        velocity = side.points.velocity
        if law.friction is not None:
            velocity = velocity + spin_cross(side.points.spin, side.arm)
        total = total + side.sign * velocity
    return total


def _sliding(touch: Touch, velocity: Array) -> tuple[Array, Array]:
    """Velocity along the surface, and the size of the normal."""
    size = safe_norm(touch.normal)
    unit = touch.normal / jnp.where(size > 0, size, jnp.ones_like(size))[:, None]
    return velocity - jnp.sum(unit * velocity, axis=1, keepdims=True) * unit, size


def _rows(touch: Touch, jacobian, normal: Array) -> Float[Array, "points dof"]:
    blocks = [
        side.sign * jnp.sum(normal[:, :, None] * jacobian(side), axis=1) for side in touch.sides
    ]
    return jnp.concatenate(blocks, axis=1)


def _surface_rows(touch: Touch) -> Float[Array, "points dim dof"]:
    """Velocity of the first surface against the second, per rate."""
    blocks = []
    for side in touch.sides:
        angular, arm = side.points.angular_jacobian, side.arm[:, :, None]
        if arm.shape[1] == 2:
            turn = jnp.concatenate([-arm[:, 1:], arm[:, :1]], axis=1) * angular
        else:
            turn = jnp.cross(angular, jnp.broadcast_to(arm, angular.shape), axis=1)
        blocks.append(side.sign * (side.points.linear_jacobian + turn))
    return jnp.concatenate(blocks, axis=2)


def _square(rows: Float[Array, "*rows dof"], weights: Float[Array, "*rows"]) -> Array:
    """rows' diag(weights) rows, over all axes but the last."""
    flat = rows.reshape(-1, rows.shape[-1])
    return flat.T @ (weights.reshape(-1)[:, None] * flat)
