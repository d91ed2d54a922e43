"""Contact of points, each with an area of its own, with one static obstacle."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.contact.penalty import Penalty
from sorojax.sdf.base import AbstractSdf


class Contacts(NamedTuple):
    """State of contact points: gap [m], pressure [Pa], outward normal of the obstacle, and
    force of the obstacle on each point [N]."""

    position: Float[Array, "points dim"]
    gap: Float[Array, " points"]
    pressure: Float[Array, " points"]
    normal: Float[Array, "points dim"]
    force: Float[Array, "points dim"]

    @property
    def active(self) -> Bool[Array, " points"]:
        """Points that touch."""
        return self.gap < 0

    @property
    def total(self) -> Float[Array, " dim"]:
        """Force of the obstacle on all points [N]."""
        return jnp.sum(self.force, axis=0)


def gaps(
    obstacle: AbstractSdf, points: Float[Array, "*points dim"], shift=None
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
) -> Contacts:
    """Contact of `points` [m] that stand for `areas` [m^2] with `obstacle`.

    The force is pressure times area along the slope of the field, minus the derivative of
    the energy `sum(areas * law.energy(gaps))`.
    """

    def one(point):
        return gaps(obstacle, point, shift)

    gap, slope = jax.vmap(jax.value_and_grad(one))(points)
    pressure = law.pressure(gap)
    size = jnp.sqrt(jnp.sum(slope**2, axis=1, keepdims=True))
    normal = slope / jnp.where(size > 0, size, jnp.ones_like(size))
    return Contacts(points, gap, pressure, normal, (areas * pressure)[:, None] * slope)
