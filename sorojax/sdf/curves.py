"""Bodies along curves in the plane or in space: polyline, Bezier, spline, helix."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.sdf.bars import segment_square
from sorojax.sdf.base import AbstractSdf, Box, Exactness, check_lengths
from sorojax.sdf.nearest import nearest, take
from sorojax.sdf.scalar import clip, maximum, minimum, norm, quotient, root

TUBE = Exactness(outside=True, inside=False)  # where a tube meets itself it is deeper


def check_points(shape: AbstractSdf, points: Array, least: int) -> None:
    where = type(shape).__name__
    size = jnp.shape(points)
    if len(size) != 2 or size[1] not in (2, 3) or size[0] < least:
        raise ValueError(
            f"{where}: `points` has shape {size}, need at least {least} rows of (x, y) or "
            "(x, y, z). One row per point, in order."
        )


class Polyline(AbstractSdf):
    """All points within `width` / 2 of the line through `points` [m]; a tube in space."""

    points: Float[Array, "points dim"] = eqx.field(converter=real)
    width: Float[Array, ""] = eqx.field(converter=real)
    closed: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_points(self, self.points, 2)
        check_lengths(self, "width")

    @property
    def dim(self) -> int:
        return self.points.shape[1]

    @property
    def exactness(self) -> Exactness:
        return TUBE

    def distance(self, *x):
        a = self.points
        b = jnp.roll(a, -1, axis=0)
        table = (a, b) if self.closed else (a[:-1], b[:-1])
        index = nearest(lambda row, *x: segment_square(x, *row), table, x)
        return root(segment_square(x, *take(table, index))) - self.width / 2

    def bounding_box(self) -> Box:
        half = self.width / 2
        return jnp.min(self.points, axis=0) - half, jnp.max(self.points, axis=0) + half


class Bezier(AbstractSdf):
    """Quadratic Bezier curve of three control `points` [m], `width` [m] across."""

    points: Float[Array, "3 dim"] = eqx.field(converter=real)
    width: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_points(self, self.points, 3)
        if self.points.shape[0] != 3:
            raise ValueError(
                f"Bezier: `points` has {self.points.shape[0]} rows, need 3. Join several "
                "curves by `|`, or use a Spline."
            )
        check_lengths(self, "width")

    @property
    def dim(self) -> int:
        return self.points.shape[1]

    @property
    def exactness(self) -> Exactness:
        return TUBE

    def distance(self, *x):
        return bezier_distance(self.points, x) - self.width / 2

    def bounding_box(self) -> Box:
        half = self.width / 2
        return jnp.min(self.points, axis=0) - half, jnp.max(self.points, axis=0) + half


class Parabola(AbstractSdf):
    """The piece |x| <= `half_width` of y = `bend` x^2, `width` [m] across; bend in 1/m."""

    bend: Float[Array, ""] = eqx.field(converter=real)
    half_width: Float[Array, ""] = eqx.field(converter=real)
    width: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "half_width", "width")

    @property
    def dim(self) -> int:
        return 2

    @property
    def exactness(self) -> Exactness:
        return TUBE

    def distance(self, x, y):
        return bezier_distance(self._control(), (x, y)) - self.width / 2

    def _control(self) -> Float[Array, "3 2"]:
        w, rise = self.half_width, self.bend * self.half_width**2
        return jnp.stack(
            [jnp.stack([-w, rise]), jnp.stack([0 * w, -rise]), jnp.stack([w, rise])]
        )

    def bounding_box(self) -> Box:
        half, rise = self.width / 2, self.bend * self.half_width**2
        lower = jnp.stack([-self.half_width, jnp.minimum(rise, 0)]) - half
        return lower, jnp.stack([self.half_width, jnp.maximum(rise, 0)]) + half


def bezier_distance(points: Float[Array, "3 dim"], x: tuple[Array, ...]) -> Array:
    """Distance [m] to a quadratic Bezier curve: the nearer foot seen from either end.

    The slope of the squared distance is a cubic; Newton's method from outside its
    roots runs to the first and to the last of them without passing.
    """
    curve = [
        (points[0, i], 2 * (points[1, i] - points[0, i]),
         points[0, i] - 2 * points[1, i] + points[2, i])
        for i in range(len(x))
    ]  # fmt: skip

    def slope(t, x):
        first = second = jnp.zeros_like(t)
        for c, (p, q, r) in zip(x, curve, strict=True):
            gap, speed = p + t * (q + t * r) - c, q + 2 * t * r
            first = first + gap * speed
            second = second + speed * speed + 2 * gap * r
        return first, second

    best = None
    for end in (0.0, 1.0):
        t = foot(slope, jnp.full_like(x[0], end), x, 12)
        square = sum(
            ((p + t * (q + t * r) - c) ** 2 for c, (p, q, r) in zip(x, curve, strict=True)),
            start=jnp.zeros_like(t),
        )
        best = square if best is None else minimum(best, square)
    return root(best)


def foot(
    slope, start: Array, x: tuple[Array, ...], steps: int, end: Array | float = 1.0
) -> Array:
    """Parameter in [0, end] where `slope(t, x)` = (s, ds/dt) has s = 0, or the nearer end.

    The last step alone carries derivatives: that is the implicit-function rule.
    """

    def newton(t, x):
        first, second = slope(t, x)
        return t - quotient(first, jnp.where(second > 0, second, jnp.zeros_like(second)))

    held = jax.lax.stop_gradient(x)
    last = jax.lax.stop_gradient(end)

    def step(_, t):
        return clip(newton(t, held), 0.0, last)

    start = clip(jax.lax.stop_gradient(start), 0.0, last)
    t = jax.lax.stop_gradient(jax.lax.fori_loop(0, steps, step, start))
    return clip(newton(t, x), 0.0, end)


class Helix(AbstractSdf):
    """Wire of `width` [m] wound about z at `radius` [m], `pitch` [m] per turn, from z = 0."""

    radius: Float[Array, ""] = eqx.field(converter=real)
    pitch: Float[Array, ""] = eqx.field(converter=real)
    turns: Float[Array, ""] = eqx.field(converter=real)
    width: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "radius", "pitch", "turns", "width")

    @property
    def dim(self) -> int:
        return 3

    @property
    def exactness(self) -> Exactness:
        return TUBE

    def distance(self, x, y, z):
        lead, whole = self.pitch / (2 * math.pi), 2 * math.pi
        end = whole * self.turns

        def slope(t, x):
            c, s = self.radius * jnp.cos(t), self.radius * jnp.sin(t)
            first = x[0] * s - x[1] * c + lead * (lead * t - x[2])
            return first, x[0] * c + x[1] * s + lead * lead

        def gap(t):
            c, s = self.radius * jnp.cos(t), self.radius * jnp.sin(t)
            return norm(x - c, y - s, z - lead * t)

        # The closest point lies on the winding just below or just above the point;
        # from the angle of the point Newton's method runs up to it without passing.
        px, py, pz = jax.lax.stop_gradient((x, y, z))
        angle = jnp.arctan2(py, px)
        below = jnp.floor((pz / jax.lax.stop_gradient(lead) - angle) / whole)
        first = jnp.ceil(-angle / whole)
        last = jnp.floor((jax.lax.stop_gradient(end) - angle) / whole)
        best = minimum(gap(jnp.zeros_like(x)), gap(end + jnp.zeros_like(x)))
        for turn in (below, below + 1):
            start = angle + whole * clip(turn, first, maximum(first, last))
            best = minimum(best, gap(foot(slope, start, (x, y, z), 12, end)))
        return best - self.width / 2

    def bounding_box(self) -> Box:
        reach, half = self.radius + self.width / 2, self.width / 2
        lower = jnp.stack([-reach, -reach, -half])
        return lower, jnp.stack([reach, reach, self.pitch * self.turns + half])
