"""A tube along a smooth curve through points."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.sdf.base import AbstractSdf, Box, Exactness, check_lengths
from sorojax.sdf.curves import check_points, foot
from sorojax.sdf.nearest import nearest, take
from sorojax.sdf.scalar import clip, norm, quotient

_PARTS = 6  # of each piece, short enough to hold one closest point


def _slope(t, x, curve):
    """First and second derivative in t of half the squared distance to the cubic."""
    first = second = jnp.zeros_like(t)
    for c, (p, q, r, s) in zip(x, curve, strict=True):
        gap, speed = p + t * (q + t * (r + t * s)) - c, q + t * (2 * r + 3 * t * s)
        first = first + gap * speed
        second = second + speed * speed + gap * (2 * r + 6 * t * s)
    return first, second


def _nearest_time(pieces, start, x):
    """Parameter of the closest point within one part, from that of its chord."""
    curve = tuple(zip(*pieces, strict=True))
    end = start + 1 / _PARTS

    def at(t):
        return tuple(p + t * (q + t * (r + t * s)) for p, q, r, s in curve)

    a, b = at(start), at(end)
    zero = jnp.zeros_like(x[0])
    dot = sum(((c - p) * (q - p) for c, p, q in zip(x, a, b, strict=True)), start=zero)
    square = sum(((q - p) ** 2 for p, q in zip(a, b, strict=True)), start=zero)
    t = start + clip(quotient(dot, square), 0.0, 1.0) / _PARTS
    for _ in range(3):
        first, second = _slope(t, x, curve)
        t = t - quotient(first, jnp.where(second > 0, second, zero))
        t = jnp.where(t < start, start, jnp.where(t > end, end, t))
    return t


def _square(pieces, start, x):
    curve = tuple(zip(*pieces, strict=True))
    t = _nearest_time(pieces, start, x)
    gaps = (p + t * (q + t * (r + t * s)) - c for c, (p, q, r, s) in zip(x, curve, strict=True))
    return sum((g * g for g in gaps), start=jnp.zeros_like(t))


class Spline(AbstractSdf):
    """Tube of `width` [m] along the cubic curve (Catmull-Rom) through `points` [m].

    The closest point is searched on six parts of every piece by Newton's method: exact
    outside unless one part bends around a point with two closest points.
    """

    points: Float[Array, "points dim"] = eqx.field(converter=real)
    width: Float[Array, ""] = eqx.field(converter=real)
    closed: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_points(self, self.points, 3)
        check_lengths(self, "width")

    @property
    def dim(self) -> int:
        return self.points.shape[1]

    @property
    def exactness(self) -> Exactness:
        return Exactness(outside=True, inside=False)

    def _pieces(self) -> tuple[Float[Array, "pieces dim"], ...]:
        """Coefficients of 1, t, t^2, t^3 of every piece, t in [0, 1]."""
        p = self.points
        if self.closed:
            before, after = jnp.roll(p, 1, axis=0), jnp.roll(p, -1, axis=0)
            start, end = p, after
            tangent = (after - before) / 2
            leave, arrive = tangent, jnp.roll(tangent, -1, axis=0)
        else:
            middle = (p[2:] - p[:-2]) / 2
            tangent = jnp.concatenate([(p[1] - p[0])[None], middle, (p[-1] - p[-2])[None]])
            start, end, leave, arrive = p[:-1], p[1:], tangent[:-1], tangent[1:]
        square = 3 * (end - start) - 2 * leave - arrive
        return start, leave, square, 2 * (start - end) + leave + arrive

    def distance(self, *x):
        pieces = self._pieces()
        count = pieces[0].shape[0]
        t = jnp.arange(_PARTS, dtype=x[0].dtype) / _PARTS
        table = (tuple(jnp.repeat(c, _PARTS, axis=0) for c in pieces), jnp.tile(t, count))
        index = nearest(lambda row, *x: _square(*row, x), table, x)
        held = jax.lax.stop_gradient((table, x))
        near = _nearest_time(take(held[0][0], index), held[0][1][index], held[1])
        curve = tuple(zip(*take(pieces, index // _PARTS), strict=True))

        at = foot(lambda t, x: _slope(t, x, curve), near, x, 8)
        gaps = (
            p + at * (q + at * (r + at * s)) - c
            for c, (p, q, r, s) in zip(x, curve, strict=True)
        )
        return norm(*gaps) - self.width / 2

    def bounding_box(self) -> Box:
        # A piece lies in the hull of its four Bezier points.
        start, leave, square, cube = self._pieces()
        end = start + leave + square + cube
        arrive = leave + 2 * square + 3 * cube
        hull = jnp.concatenate([start, end, start + leave / 3, end - arrive / 3])
        half = self.width / 2
        return jnp.min(hull, axis=0) - half, jnp.max(hull, axis=0) + half
