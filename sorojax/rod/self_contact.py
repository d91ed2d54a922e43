"""Contact of a rod with itself."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.contact.line import LinePenalty
from sorojax.contact.swept import crosses
from sorojax.rod.closest import closest, curve, ends
from sorojax.rod.contact_force import AbstractContact, check_line, line, stations
from sorojax.rod.points import Points, curvature, safe_norm
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
        caps: Which ends are half balls: "tip", "both" for a free rod, or "none".
    """

    radius: Float[Array, ""] = eqx.field(converter=real)
    law: LinePenalty
    points: int = eqx.field(static=True, default=64)
    apart: float = eqx.field(static=True, default=5.0)
    caps: str = eqx.field(static=True, default="tip")

    def __check_init__(self):
        check_line(self, self.radius)
        do = "Two radii are the diameter; 5 suit a rod that bends as tight as it can."
        _check.between("SelfContact", "apart", self.apart, 2, np.inf, "radii", do)

    @property
    def narrowest(self):
        return self.radius

    def is_near(self, motion, h):
        # A curve that turns by less than this keeps its chords longer than a diameter.
        turn = 2 * np.arccos(2 / self.apart) * _TURN_MARGIN
        bends = motion.angular_rate @ motion.v
        total = safe_norm(curvature(motion)) + 2 * h * safe_norm(bends)
        return motion.operators.weights @ total > turn

    def passed(self, before, after):
        lines = [ends(motion, self.points) for (motion,) in (before, after)]
        places = np.linspace(0.0, 1.0, self.points + 1)
        apart = np.abs(places[:, None] - places[None, :])
        allowed = apart > self.apart * self.radius / before[0].rod.length
        return crosses(*lines, *lines, 2 * self.radius, allowed)

    def touch(self, motion):
        s, shape = stations(self.points, self.caps), curve(motion, self.points)
        at, weights, radius = line(motion, self.radius, self.points, self.caps)
        places = np.linspace(0.0, 1.0, self.points + 1)
        least = self.apart * self.radius / motion.rod.length
        ahead = places[None, :] - s[:, None] > least
        behind = s[:, None] - places[None, :] > least
        low = jnp.concatenate([jnp.clip(s + least, 0, 1), jnp.zeros(s.shape)])
        high = jnp.concatenate([jnp.ones(s.shape), jnp.clip(s - least, 0, 1)])
        first = Points(motion, jnp.concatenate([at.rows, at.rows]))
        allowed = jnp.concatenate([ahead, behind])
        found = closest(motion, shape, first.position, allowed, low, high)
        weights, radius = (jnp.concatenate([x, x]) for x in (weights / 2, radius))
        touch = meeting(first, found, radius, self.radius, weights)
        exists = jnp.any(allowed, axis=1)  # nothing is ahead of the tip
        return touch._replace(gap=jnp.where(exists, touch.gap, motion.rod.length))


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
