"""Contact of points, each with an area of its own, with one static obstacle."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.contact.penalty import Penalty
from sorojax.sdf.base import AbstractSdf


class Contacts(NamedTuple):
    """State of contact points: gap [m], pressure [Pa], outward normal of the obstacle, force
    of the obstacle on each point [N] and the part of it that is friction."""

    position: Float[Array, "points dim"]
    gap: Float[Array, " points"]
    pressure: Float[Array, " points"]
    normal: Float[Array, "points dim"]
    force: Float[Array, "points dim"]
    friction: Float[Array, "points dim"]

    @property
    def active(self) -> Bool[Array, " points"]:
        """Points that touch."""
        return self.gap < 0

    @property
    def total(self) -> Float[Array, " dim"]:
        """Force of the obstacle on all points [N]."""
        return jnp.sum(self.force, axis=0)

    @property
    def penetration(self) -> Float[Array, ""]:
        """Largest overlap [m]; zero without contact."""
        return jnp.maximum(-jnp.min(self.gap), jnp.zeros((), self.gap.dtype))

    def torque(self, about: Float[Array, " dim"] | None = None) -> Float[Array, "..."]:
        """Torque of the obstacle on all points [N m] about the point `about` [m], the origin
        when omitted: a number in the plane, a vector in space."""
        arm = self.position if about is None else self.position - about[None]
        if arm.shape[1] == 2:
            return jnp.sum(arm[:, 0] * self.force[:, 1] - arm[:, 1] * self.force[:, 0])
        return jnp.sum(jnp.cross(arm, self.force), axis=0)

    def power(self, velocity: Float[Array, "*points dim"]) -> Float[Array, ""]:
        """Power [W] of the obstacle on points of this velocity [m/s], one for all or one
        each."""
        return jnp.sum(self.force * jnp.broadcast_to(velocity, self.force.shape))


def gaps(
    obstacle: AbstractSdf,
    points: Float[Array, "*points dim"],
    shift: Float[Array, " dim"] | None = None,
) -> Float[Array, "*points"]:
    """Distance of `points` [m] from `obstacle` moved by `shift` (dim,) [m]; negative
    inside. Differentiable in points, obstacle and shift."""
    if shift is not None:
        points = points - jnp.broadcast_to(shift, points.shape)
    return obstacle(points)


def contacts(
    law: Penalty,
    obstacle: AbstractSdf,
    points: Float[Array, "points dim"],
    areas: Float[Array, " points"],
    shift: Float[Array, " dim"] | None = None,
    offset: Float[Array, " points"] | None = None,
) -> Contacts:
    """Contact of `points` [m] that stand for `areas` [m^2] with `obstacle`, whose pressure
    starts `offset` [m] before its surface.

    The force is pressure times area along the slope of the field, minus the derivative of
    the energy `sum(areas * law.energy(gaps))`.
    """

    def one(point):
        return gaps(obstacle, point, shift)

    gap, slope = jax.vmap(jax.value_and_grad(one))(points)
    pressure = law.pressure(gap if offset is None else gap - offset)
    size = jnp.sqrt(jnp.sum(slope**2, axis=1, keepdims=True))
    normal = slope / jnp.where(size > 0, size, jnp.ones_like(size))
    force = (areas * pressure)[:, None] * slope
    return Contacts(points, gap, pressure, normal, force, jnp.zeros_like(force))
