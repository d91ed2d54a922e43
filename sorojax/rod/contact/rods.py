"""Contact between two rods of an assembly, or of a rod with one that is held, at the points of
one centre line that are closest to those of another.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax import _check
from sorojax._types import real
from sorojax.contact.law import LinePenalty
from sorojax.contact.swept import crosses, products
from sorojax.math.quadrature import integration_rows, interpolation_rows
from sorojax.rod.contact.obstacle import (
    AbstractContact,
    AbstractPairContact,
    Side,
    Touch,
    check_line,
    is_now,
    line,
    reach_of,
    stations,
    travel,
)
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.points import Points, curvature, safe_norm
from sorojax.rod.model.link import LinkState

_NEWTON = 2
_STEEPEST = 0.2  # least curvature of the distance that a Newton step may lean on


class Curve(NamedTuple):
    """A centre line as cubics between `count` + 1 equally spaced places.

    The cubics are linear in the fields of the rod, so forces put on them do exactly the
    work that the distances say. Against the rod they are off by the fourth power of the
    spacing.

    Attributes:
        places, slopes: Weights of the fields at the nodes, per unit of rod length.
        count: Number of cubics.
    """

    places: np.ndarray
    slopes: np.ndarray
    count: int


def curve(motion: RodState, count: int) -> Curve:
    """The centre line of the rod in `count` cubics."""
    rule, ends = motion.rod.quadrature, np.linspace(0.0, 1.0, count + 1)
    places, slopes = integration_rows(rule, ends), interpolation_rows(rule, ends)
    return Curve(np.asarray(places), np.asarray(slopes), count)


def ends(motion: RodState, count: int) -> Float[Array, "ends dim"]:
    """The ends of the `count` cubics of a rod [m]."""
    table = jnp.asarray(curve(motion, count).places, motion.q.dtype)
    place = motion.rod.length * (table @ motion.tangent)
    return place if motion.base is None else place + motion.base.position[None]


def closest(
    motion: RodState,
    line: Curve,
    to: Float[Array, "points dim"],
    allowed: Bool[Array, "points ends"] | None = None,
    low: Float[Array, " points"] | None = None,
    high: Float[Array, " points"] | None = None,
) -> Points:
    """The point of `motion` closest to each point of `to`.

    A search over the ends of the cubics starts a Newton iteration on them, whose last step
    carries the derivative of the minimiser: distances are as smooth as the curve.

    Args:
        motion: The rod to search.
        line: Its centre line.
        to: Points [m].
        allowed: Which ends each point may take.
        low, high: Limits of s for each point; 0 and 1 if omitted.
    """
    dtype = to.dtype
    tables = jnp.asarray(line.places, dtype), jnp.asarray(line.slopes, dtype)
    place, slope = (motion.rod.length * (table @ motion.tangent) for table in tables)
    if motion.base is not None:
        place = place + motion.base.position[None]
    held = jax.lax.stop_gradient((place, slope, to))
    square = products(held[2], held[0], held[2], held[0])
    if allowed is not None:
        square = jnp.where(allowed, square, jnp.inf)
    s = jnp.argmin(square, axis=1).astype(dtype) / line.count
    low = jnp.zeros_like(s) if low is None else low
    high = jnp.ones_like(s) if high is None else high
    for _ in range(_NEWTON):
        s = jnp.clip(_improve(line.count, *held, s), low, high)
    s = jax.lax.stop_gradient(s)
    s = jnp.clip(_improve(line.count, place, slope, to, s), low, high)
    index, u = _cell(line.count, s)
    rows = _blend(_hermite(u), *tables, index, line.count)
    return Points(motion, motion.rod.length * rows)


def _improve(count: int, place: Array, slope: Array, to: Array, s: Array) -> Array:
    """One Newton step on half the square of the distance."""
    index, u = _cell(count, s)
    first = count * _blend(_hermite_slope(u), place, slope, index, count)
    second = count**2 * _blend(_hermite_bend(u), place, slope, index, count)
    away = to - _blend(_hermite(u), place, slope, index, count)
    speed = jnp.sum(first**2, axis=1)
    bend = speed - jnp.sum(away * second, axis=1)
    bend = jnp.where(bend > _STEEPEST * speed, bend, _STEEPEST * speed)
    return s + jnp.sum(away * first, axis=1) / bend


def _cell(count: int, s: Array) -> tuple[Array, Array]:
    """Index of the cubic that holds `s`, and where it is inside."""
    index = jnp.clip(jnp.floor(jax.lax.stop_gradient(s) * count), 0, count - 1)
    return index.astype(jnp.int32), s * count - index


def _blend(weights, place: Array, slope: Array, index: Array, count: int) -> Array:
    """Sum of end values and end slopes [per unit of s] with Hermite weights."""
    a, b, c, d = (weight[:, None] for weight in weights)
    ends = a * place[index] + b * place[index + 1]
    return ends + (c * slope[index] + d * slope[index + 1]) / count


def _hermite(u: Array) -> tuple[Array, Array, Array, Array]:
    """Weights of both end values, then of both end slopes."""
    rise = u * u * (3 - 2 * u)
    return 1 - rise, rise, u * (1 - u) ** 2, u * u * (u - 1)


def _hermite_slope(u: Array) -> tuple[Array, Array, Array, Array]:
    rise = 6 * u * (1 - u)
    return -rise, rise, (1 - u) * (1 - 3 * u), u * (3 * u - 2)


def _hermite_bend(u: Array) -> tuple[Array, Array, Array, Array]:
    rise = 6 - 12 * u
    return -rise, rise, 6 * u - 4, 6 * u - 2


# Contact of a rod with itself


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
        total = safe_norm(curvature(motion))
        if not is_now(h):
            total = total + 2 * h * safe_norm(bends)
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


def meeting(
    first: Points,
    second: Points,
    radius: Array,
    other_radius: Array,
    weights: Array,
    bodies: tuple[int, int] = (0, 0),
) -> Touch:
    """Contacts between points and their closest points on another centre line."""
    away = first.position - second.position
    distance = safe_norm(away)
    unit = away / jnp.where(distance > 0, distance, jnp.ones_like(distance))[:, None]
    sides = (
        Side(first, -radius[:, None] * unit, 1.0, bodies[0]),
        Side(second, other_radius * unit, -1.0, bodies[1]),
    )
    return Touch(distance - radius - other_radius, unit, weights, sides)


# Contact between two rods of an assembly, or of a rod with one that is held


class RodContact(AbstractPairContact):
    """Contact between two rods: `PairForce("left", "right", RodContact(...))`.

    Points of each meet the closest point of the other, with half of the force each, so
    neither is the master.

    Attributes:
        radii: Of the first and of the second rod [m].
        law: Force per length.
        points: Number of points along each rod. Take two or more per radius where rods
            cross.
        caps: Which ends are half balls: "tip", "both" for free rods, or "none".
    """

    radii: Float[Array, "2"] = eqx.field(converter=real)
    law: LinePenalty
    points: int = eqx.field(static=True, default=64)
    caps: str = eqx.field(static=True, default="tip")

    def __check_init__(self):
        do = "Give the radius of each rod, (first, second)."
        _check.shape("RodContact", "radii", self.radii, (2,), do)
        _check.positive("RodContact", "radii", self.radii, "m", do)

    @property
    def narrowest(self):
        return jnp.min(self.radii)

    def is_near(self, first, second, h):
        first, second = rod_of(first), rod_of(second)
        (a, reach_a), (b, reach_b) = reach_of(first), reach_of(second)
        reach = reach_a + reach_b + jnp.sum(self.radii)
        reach = reach + travel(first, h) + travel(second, h)
        return jnp.sum((a - b) ** 2) <= reach**2

    def touches(self, first, second):
        """Contacts of the points of the first rod, then of the second; each has the sides
        (searching rod, searched rod)."""
        first, second = rod_of(first), rod_of(second)
        return _search(self, 0, first, second), _search(self, 1, second, first)

    def passed(self, before, after):
        lines = (ends(motion, self.points) for motion in (*before, *after))
        first, second, first_after, second_after = lines
        return crosses(first, first_after, second, second_after, jnp.sum(self.radii))


class HeldRod(AbstractContact):
    """Contact of a rod with another rod that does not move.

    Attributes:
        pair: Radii of the moving and of the held rod, law and points.
        held: Where the held rod is.
    """

    pair: RodContact
    held: RodState

    @property
    def law(self) -> LinePenalty:  # type: ignore[override]
        return self.pair.law

    @property
    def narrowest(self):
        return self.pair.narrowest

    def is_near(self, motion, h):
        return self.pair.is_near(motion, self.held, h)

    def passed(self, before, after):
        return self.pair.passed((*before, self.held), (*after, self.held))

    def touch(self, motion):
        one, two = self.pair.touches(motion, self.held)
        mine, its = one.sides[0], two.sides[1]
        at = Points(motion, jnp.concatenate([mine.points.rows, its.points.rows]))
        side = Side(at, jnp.concatenate([mine.arm, its.arm]), 1.0)
        normal = jnp.concatenate([one.normal, -two.normal])
        gap, weights = (jnp.concatenate([getattr(x, k) for x in (one, two)]) for k in _FIELDS)
        return Touch(gap, normal, weights, (side,))


_FIELDS = ("gap", "weights")


def _search(pair: RodContact, index: int, mine: RodState, other: RodState) -> Touch:
    at, weights, radius = line(mine, pair.radii[index], pair.points, pair.caps)
    found = closest(other, curve(other, pair.points), at.position)
    return meeting(at, found, radius, pair.radii[1 - index], weights / 2, (index, 1 - index))


def rod_of(body: RodState | LinkState) -> RodState:
    """The motion of a part that must be a rod."""
    if not isinstance(body, RodState):
        raise ValueError(
            "RodContact: one of the parts is a rigid link, need two rods. Give the shape of "
            "a link that does not move as an obstacle: PartForce(name, ObstacleContact(...))."
        )
    return body
