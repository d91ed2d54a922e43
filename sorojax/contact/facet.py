"""The gap of a point over a facet: sides in the plane, flat triangles in space.

A facet acts a little beyond its rim, with a weight that falls smoothly across it; the
weights of facets that continue each other add up to one. So the surface of many facets
has no kinks, and contact ends smoothly at a free rim.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.contact.law import Penalty
from sorojax.sdf.base import AbstractSdf

_RIM = 0.3  # of half a side, or of the height of a triangle, over which the weight falls


class Over(NamedTuple):
    """Signed height of a point over a facet [m], weight of the facet, and its normal."""

    height: Float[Array, ""]
    weight: Float[Array, ""]
    normal: Float[Array, " dim"]


def over(piece: Float[Array, "nodes dim"], point: Float[Array, " dim"]) -> Over:
    """How `point` [m] stands over a piece of a facet, twice differentiable."""
    return _over_triangle(piece, point) if point.shape[0] == 3 else _over_side(piece, point)


def shared(weights: Float[Array, " pieces"]) -> Float[Array, " pieces"]:
    """Weights whose sum is one where facets overlap, and below one past the last of them."""
    total = jnp.sum(weights)
    short = 2 * jnp.clip(total, 0.5, 1.0) - 1  # smooth between one and the sum
    return weights / jnp.where(total > 1, total, 1 + (short**3 - short**2) / 2)


def _over_side(side: Float[Array, "nodes 2"], point: Float[Array, "2"]) -> Over:
    t = _foot(*jax.lax.stop_gradient((side, point)))
    # the same place if it is within the rim, now with a derivative, then with a second one
    for _ in range(side.shape[0] - 1):
        away, slope, _ = _at(side, point, t)
        t = t - (away @ slope) / _curvature(side, point, t)
    away, slope, _ = _at(side, point, t)
    across = jnp.stack([slope[1], -slope[0]])
    normal = across / jnp.sqrt(across @ across)
    return Over(-(away @ normal), _ramp(1 - jnp.abs(t), _RIM), normal)


def _at(side, point, t):
    """From the point to the side at t in [-1, 1], and the slope of the side there."""
    middle, along = (side[0] + side[1]) / 2, (side[1] - side[0]) / 2
    if side.shape[0] == 2:
        return middle + t * along - point, along, along
    bow = middle - side[2]
    return side[2] + t * along + t**2 * bow - point, along + 2 * t * bow, along


def _curvature(side, point, t):
    """Second derivative of half the squared distance along a side, kept positive."""
    away, slope, along = _at(side, point, t)
    if side.shape[0] == 2:
        return along @ along
    bow = (side[0] + side[1]) / 2 - side[2]
    return jnp.maximum(slope @ slope + 2 * (away @ bow), 0.5 * (along @ along))


def _foot(side, point) -> Float[Array, ""]:
    """Where the point stands, up to the outer end of the rim."""
    bound = 1 + _RIM
    middle, along = (side[0] + side[1]) / 2, (side[1] - side[0]) / 2
    start = middle if side.shape[0] == 2 else side[2]
    t = jnp.clip((point - start) @ along / (along @ along), -bound, bound)
    if side.shape[0] == 2:
        return t

    def better(_, t):
        away, slope, _ = _at(side, point, t)
        return jnp.clip(t - (away @ slope) / _curvature(side, point, t), -bound, bound)

    return jax.lax.fori_loop(0, 5, better, t)


def _over_triangle(corners: Float[Array, "3 3"], point: Float[Array, "3"]) -> Over:
    first, second = corners[1] - corners[0], corners[2] - corners[0]
    across = jnp.cross(first, second)
    away = point - corners[0]
    square = across @ across
    at_second = jnp.cross(first, away) @ across / square
    at_first = jnp.cross(away, second) @ across / square
    normal = across / jnp.sqrt(square)
    weight = (
        _ramp(at_first, _RIM) * _ramp(at_second, _RIM) * _ramp(1 - at_first - at_second, _RIM)
    )
    return Over(away @ normal, weight, normal)


def _ramp(x, width: float):
    """From 0 at -width to 1 at +width, smooth, symmetric about 1/2."""
    s = jnp.clip((x + width) / (2 * width), 0.0, 1.0)
    return s**2 * (3 - 2 * s)


# Contact of points, each with an area of its own, with one static obstacle


class Contacts(NamedTuple):
    """State of contact points: `position` [m], `gap` [m], `pressure` [Pa], outward `normal` of
    the obstacle, `force` of the obstacle on each point [N] and the part of it that is
    `friction` [N]."""

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


def surface(
    obstacle: AbstractSdf, points: Float[Array, "points dim"]
) -> tuple[Float[Array, " points"], Float[Array, "points dim"], Float[Array, "points dim"]]:
    """Distances of `points` [m] from `obstacle`, their slopes and the unit normals there."""
    gap, slope = jax.vmap(jax.value_and_grad(obstacle))(points)
    square = jnp.sum(slope**2, axis=1, keepdims=True)
    return gap, slope, slope / jnp.sqrt(jnp.where(square > 0, square, jnp.ones_like(square)))


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
    local = points if shift is None else points - jnp.broadcast_to(shift, points.shape)
    gap, slope, normal = surface(obstacle, local)
    pressure = law.pressure(gap if offset is None else gap - offset)
    force = (areas * pressure)[:, None] * slope
    return Contacts(points, gap, pressure, normal, force, jnp.zeros_like(force))
