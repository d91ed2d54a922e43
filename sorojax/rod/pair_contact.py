"""Contact of a rod with itself and with another rod."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax import _check
from sorojax._types import real
from sorojax.contact.line import LinePenalty
from sorojax.rod.closest import closest
from sorojax.rod.contact_force import AbstractContact, check_line, line, reach_of, stations
from sorojax.rod.motion import Motion
from sorojax.rod.points import curvature, points, safe_norm
from sorojax.rod.pressing import Side, Touch

_TURN_MARGIN = 0.9  # share of the turn at which sections may first meet


class SelfContact(AbstractContact):
    """Contact of a rod with itself, sections along an arc shorter than `apart` left out.

    Each point meets the closest point ahead of it and the closest behind it, with half of
    the force each, so a turn of a coil feels both of its neighbours.

    Attributes:
        radius: Radius of the rod [m].
        law: Force per length.
        points: Number of points along the rod. Take two or more per radius where rods
            cross.
        apart: Least arc length between sections that can meet, in radii [-].
        tip: Whether the tip is a half ball.
    """

    radius: Float[Array, ""] = eqx.field(converter=real)
    law: LinePenalty
    points: int = eqx.field(static=True, default=64)
    apart: float = eqx.field(static=True, default=5.0)
    tip: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        check_line(self, self.radius)
        do = "Two radii are the diameter; 5 suit a rod that bends as tight as it can."
        _check.between("SelfContact", "apart", self.apart, 2, np.inf, "radii", do)

    def is_near(self, motion, margin):
        del margin  # what a step adds to the turn is within the margin of the turn
        # A curve that turns by less than this keeps its chords longer than a diameter.
        turn = 2 * np.arccos(2 / self.apart) * _TURN_MARGIN
        if motion.tangent.shape[1] == 3:
            total = motion.operators.weights @ safe_norm(curvature(motion))
        else:
            total = motion.operators.weights @ jnp.abs(curvature(motion)[:, 0])
        return total > turn

    def touch(self, motion):
        s = stations(self.points, self.tip)
        at, weights, radius = line(motion, self.radius, self.points, self.tip)
        gap_in_s = self.apart * self.radius / motion.rod.length
        sides = []
        for ahead in (True, False):
            sign = 1 if ahead else -1
            allowed = sign * (s[None, :] - s[:, None]) > gap_in_s
            low = jnp.clip(s + gap_in_s, 0, 1) if ahead else jnp.zeros(s.shape)
            high = jnp.ones(s.shape) if ahead else jnp.clip(s - gap_in_s, 0, 1)
            found = closest(motion, s, at.position, allowed, low, high)
            sides.append((found, jnp.any(allowed, axis=1)))
        to = jnp.concatenate([found for found, _ in sides])
        exists = jnp.concatenate([exists for _, exists in sides])
        first = points(motion, np.concatenate([s, s]))
        weights, radius = (jnp.concatenate([x, x]) for x in (weights / 2, radius))
        touch = meeting(first, points(motion, to), radius, self.radius, weights)
        gap = jnp.where(exists, touch.gap, motion.rod.length)  # nothing ahead or behind
        return touch._replace(gap=gap)


class RodPair(eqx.Module):
    """Contact between two rods.

    Points of each meet the closest point of the other, with half of the force each, so
    neither is the master.

    Attributes:
        radii: Of the first and of the second rod [m].
        law: Force per length.
        points: Number of points along each rod.
        tip: Whether the tips are half balls.
    """

    radii: Float[Array, "2"] = eqx.field(converter=real)
    law: LinePenalty
    points: int = eqx.field(static=True, default=64)
    tip: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        do = "Give the radius of each rod, (first, second)."
        _check.shape("RodPair", "radii", self.radii, (2,), do)
        _check.positive("RodPair", "radii", self.radii, "m", do)


def pair_near(pair: RodPair, first: Motion, second: Motion) -> Bool[Array, ""]:
    """Whether two rods may touch; `False` is certain."""
    (a, reach_a), (b, reach_b) = reach_of(first), reach_of(second)
    reach = reach_a + reach_b + jnp.sum(pair.radii)
    return jnp.sum((a - b) ** 2) <= reach**2


def pair_touches(pair: RodPair, first: Motion, second: Motion) -> tuple[Touch, Touch]:
    """Contacts of the points of the first rod, then of the second; each has the sides
    (searching rod, searched rod)."""
    s = stations(pair.points, pair.tip)
    touches = []
    for one, other, mine, its in (
        (first, second, pair.radii[0], pair.radii[1]),
        (second, first, pair.radii[1], pair.radii[0]),
    ):
        at, weights, radius = line(one, mine, pair.points, pair.tip)
        found = points(other, closest(other, s, at.position))
        touches.append(meeting(at, found, radius, its, weights / 2))
    return touches[0], touches[1]


def meeting(first, second, radius: Array, other_radius: Array, weights: Array) -> Touch:
    """Contacts between points and their closest points on another centre line."""
    away = first.position - second.position
    distance = safe_norm(away)
    unit = away / jnp.where(distance > 0, distance, jnp.ones_like(distance))[:, None]
    sides = (
        Side(first, -radius[:, None] * unit, 1.0),
        Side(second, other_radius * unit, -1.0),
    )
    return Touch(distance - radius - other_radius, unit, weights, sides)
