"""Bodies along curves in the plane or in space: polyline, Bezier, spline, helix.

The nearest piece of a curve is found without derivatives, since it does not change with small
changes, and only that piece is differentiated; a tie takes the first.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax._types import real
from sorojax.sdf.base import (
    OUTSIDE,
    AbstractSdf,
    Box,
    Exactness,
    clip,
    maximum,
    minimum,
    norm,
    positive,
    quotient,
    root,
)
from sorojax.sdf.shapes.bars import segment_square


def nearest(
    measure: Callable[..., Array], table: Any, x: tuple[Array, ...]
) -> Int[Array, "..."]:
    """Index of the row of `table` (a pytree of arrays) with the least `measure(row, *x)`."""
    return scan_rows(measure, table, x, lambda _, *x: jnp.zeros_like(x[0]))[0]


def scan_rows(
    measure: Callable[..., Array], table: Any, x: tuple[Array, ...], extra: Callable
) -> tuple[Int[Array, "..."], Array]:
    """Nearest row and the sum of `extra(row, *x)` over all rows, in one pass."""
    table, x = jax.lax.stop_gradient((table, x))
    count = jax.tree.leaves(table)[0].shape[0]
    start = (
        jnp.full_like(x[0], jnp.inf),
        jnp.zeros(x[0].shape, jnp.int32),
        jnp.zeros_like(x[0]),
    )

    def visit(i, state):
        best, index, total = state
        row = jax.tree.map(lambda a: a[i], table)
        value = measure(row, *x)
        closer = value < best
        index = jnp.where(closer, jnp.asarray(i, jnp.int32), index)
        return jnp.where(closer, value, best), index, total + extra(row, *x)

    _, index, total = jax.lax.fori_loop(0, count, visit, start)
    return index, total


def take(table: Any, index: Int[Array, "..."]) -> tuple[tuple[Array, ...], ...]:
    """Rows of `table` at `index`: for each (n, dim) array one array per axis."""
    return tuple(tuple(a[index, i] for i in range(a.shape[1])) for a in table)


# Bodies along curves in the plane or in space: polyline, Bezier, spline, helix


class AbstractTube(AbstractSdf):
    """All points within `width` / 2 of a curve given by `points` [m], `least` of them or more.

    Where a tube meets itself it is deeper than half its width.
    """

    points: Float[Array, "points dim"] = eqx.field(converter=real)
    width: Float[Array, ""] = eqx.field(converter=positive)
    least: ClassVar[int] = 3
    exactness: ClassVar[Exactness] = OUTSIDE

    def __check_init__(self):
        size = jnp.shape(self.points)
        if len(size) != 2 or size[1] not in (2, 3) or size[0] < self.least:
            raise ValueError(
                f"{type(self).__name__}: `points` has shape {size}, need at least {self.least} "
                "rows of (x, y) or (x, y, z). One row per point, in order."
            )

    @property
    def dim(self) -> int:
        return self.points.shape[1]

    def bounding_box(self) -> Box:
        half = self.width / 2
        return jnp.min(self.points, axis=0) - half, jnp.max(self.points, axis=0) + half


class Polyline(AbstractTube):
    """All points within `width` / 2 of the line through `points` [m]; a tube in space.
    Where it is `closed` it goes on from the last point to the first."""

    closed: bool = eqx.field(static=True, default=False)
    least: ClassVar[int] = 2

    def distance(self, *x):
        a = self.points
        b = jnp.roll(a, -1, axis=0)
        table = (a, b) if self.closed else (a[:-1], b[:-1])
        index = nearest(lambda row, *x: segment_square(x, *row), table, x)
        return root(segment_square(x, *take(table, index))) - self.width / 2


class Bezier(AbstractTube):
    """Quadratic Bezier curve of three control `points` [m], `width` [m] across."""

    def __check_init__(self):
        if self.points.shape[0] > 3:
            raise ValueError(
                f"Bezier: `points` has {self.points.shape[0]} rows, need 3. Join several "
                "curves by `|`, or use a Spline."
            )

    def distance(self, *x):
        return bezier_distance(self.points, x) - self.width / 2


class Parabola(AbstractSdf):
    """The piece |x| <= `half_width` of y = `bend` x^2, `width` [m] across; bend in 1/m."""

    bend: Float[Array, ""] = eqx.field(converter=real)
    half_width: Float[Array, ""] = eqx.field(converter=positive)
    width: Float[Array, ""] = eqx.field(converter=positive)
    dim: ClassVar[int] = 2
    exactness: ClassVar[Exactness] = OUTSIDE

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
    curve = [(a, 2 * (b - a), a - 2 * b + c) for a, b, c in points.T]
    ends = (jnp.full_like(x[0], end) for end in (0.0, 1.0))
    feet = (foot(lambda t, x: curve_slope(t, x, curve), end, x, 12) for end in ends)
    return functools.reduce(minimum, (norm(*curve_gap(t, x, curve)) for t in feet))


def polynomial(t: Array, coefficients: Sequence[Array]) -> Array:
    """Its value at t, the constant coefficient first."""
    return functools.reduce(lambda total, c: c + t * total, reversed(coefficients))


def curve_gap(t: Array, x: tuple[Array, ...], curve: Sequence[Sequence[Array]]) -> list[Array]:
    """From x to the point t of a curve, for each axis a polynomial."""
    return [polynomial(t, row) - c for c, row in zip(x, curve, strict=True)]


def curve_slope(t: Array, x: tuple[Array, ...], curve: Sequence[Sequence[Array]]):
    """First and second derivative in t of half the squared distance to a curve."""
    first = second = jnp.zeros_like(t)
    for gap, row in zip(curve_gap(t, x, curve), curve, strict=True):
        rate = [k * c for k, c in enumerate(row)][1:]
        bend = [k * c for k, c in enumerate(rate)][1:]
        speed = polynomial(t, rate)
        first = first + gap * speed
        second = second + speed * speed + gap * polynomial(t, bend)
    return first, second


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
    """Wire of `width` [m] wound about z at `radius` [m], `pitch` [m] per turn, from z = 0 on;
    `turns` [-] need not be a whole number."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    pitch: Float[Array, ""] = eqx.field(converter=positive)
    turns: Float[Array, ""] = eqx.field(converter=positive)
    width: Float[Array, ""] = eqx.field(converter=positive)
    dim: ClassVar[int] = 3
    exactness: ClassVar[Exactness] = OUTSIDE

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


# A tube along a smooth curve through points


_PARTS = 6  # of each piece, short enough to hold one closest point


def _nearest_time(pieces, start, x):
    """Parameter of the closest point within one part, from that of its chord."""
    curve = tuple(zip(*pieces, strict=True))
    end = start + 1 / _PARTS

    a, b = ([polynomial(t, row) for row in curve] for t in (start, end))
    zero = jnp.zeros_like(x[0])
    dot = sum(((c - p) * (q - p) for c, p, q in zip(x, a, b, strict=True)), start=zero)
    square = sum(((q - p) ** 2 for p, q in zip(a, b, strict=True)), start=zero)
    t = start + clip(quotient(dot, square), 0.0, 1.0) / _PARTS
    for _ in range(3):
        first, second = curve_slope(t, x, curve)
        t = t - quotient(first, jnp.where(second > 0, second, zero))
        t = jnp.where(t < start, start, jnp.where(t > end, end, t))
    return t


def _square(pieces, start, x):
    curve = tuple(zip(*pieces, strict=True))
    t = _nearest_time(pieces, start, x)
    return sum((g * g for g in curve_gap(t, x, curve)), start=jnp.zeros_like(t))


class Spline(AbstractTube):
    """Tube of `width` [m] along the cubic curve (Catmull-Rom) through `points` [m]. Where it is
    `closed` the curve goes on from the last point to the first.

    The closest point is searched on six parts of every piece by Newton's method: exact
    outside unless one part bends around a point with two closest points.
    """

    closed: bool = eqx.field(static=True, default=False)

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
        at = foot(lambda t, x: curve_slope(t, x, curve), near, x, 8)
        return norm(*curve_gap(at, x, curve)) - self.width / 2

    def bounding_box(self) -> Box:
        # A piece lies in the hull of its four Bezier points.
        start, leave, square, cube = self._pieces()
        end = start + leave + square + cube
        arrive = leave + 2 * square + 3 * cube
        hull = jnp.concatenate([start, end, start + leave / 3, end - arrive / 3])
        half = self.width / 2
        return jnp.min(hull, axis=0) - half, jnp.max(hull, axis=0) + half
