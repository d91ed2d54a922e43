"""A tube along a smooth curve through points."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.sdf.base import AbstractSdf, Box, Exactness, check_lengths
from sorojax.sdf.curves import check_points, foot
from sorojax.sdf.nearest import nearest, take
from sorojax.sdf.scalar import norm

_STARTS = 8  # places on each piece where the search for the closest point begins


class Spline(AbstractSdf):
    """Tube of `width` [m] along the cubic curve (Catmull-Rom) through `points` [m].

    The closest point is searched at 8 places per piece and refined by Newton's method:
    exact outside as long as no piece turns more than once between two of them.
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
        t = (jnp.arange(_STARTS, dtype=x[0].dtype) + 0.5) / _STARTS
        repeated = tuple(jnp.repeat(c, _STARTS, axis=0) for c in pieces)
        times = jnp.tile(t, count)

        def square(row, *x):
            k, t = row
            at = k[0] + t * (k[1] + t * (k[2] + t * k[3]))
            gaps = (c - at[i] for i, c in enumerate(x))
            return sum((g * g for g in gaps), start=jnp.zeros_like(x[0]))

        index = nearest(square, (repeated, times), x)
        curve = tuple(zip(*take(pieces, index // _STARTS), strict=True))

        def slope(t, x):
            first = second = jnp.zeros_like(t)
            for c, (p, q, r, s) in zip(x, curve, strict=True):
                gap, speed = p + t * (q + t * (r + t * s)) - c, q + t * (2 * r + 3 * t * s)
                first = first + gap * speed
                second = second + speed * speed + gap * (2 * r + 6 * t * s)
            return first, second

        at = foot(slope, times[index], x, 8)
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
