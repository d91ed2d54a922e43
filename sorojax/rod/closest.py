"""The point of one centre line that is closest to each point of another."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax.math.quadrature import integration_rows, interpolation_rows
from sorojax.rod.motion import Motion
from sorojax.rod.points import Points

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


def curve(motion: Motion, count: int) -> Curve:
    """The centre line of the rod in `count` cubics."""
    rule, ends = motion.rod.quadrature, np.linspace(0.0, 1.0, count + 1)
    places, slopes = integration_rows(rule, ends), interpolation_rows(rule, ends)
    return Curve(np.asarray(places), np.asarray(slopes), count)


def ends(motion: Motion, count: int) -> Float[Array, "ends dim"]:
    """The ends of the `count` cubics of a rod [m]."""
    table = jnp.asarray(curve(motion, count).places, motion.q.dtype)
    place = motion.rod.length * (table @ motion.tangent)
    return place if motion.base is None else place + motion.base.position[None]


def closest(
    motion: Motion,
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
    square = _squares(held[2], held[0])
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


def _squares(to: Array, ends: Array) -> Float[Array, "points ends"]:
    total = jnp.zeros((to.shape[0], ends.shape[0]), to.dtype)
    for axis in range(to.shape[1]):
        total = total + (to[:, None, axis] - ends[None, :, axis]) ** 2
    return total


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
