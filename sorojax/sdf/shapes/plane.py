"""Plane shapes, all with the exact distance as their field."""

import math
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.sdf.base import (
    BOUND,
    EXACT,
    OUTSIDE,
    AbstractSdf,
    Box,
    Exactness,
    absolute,
    box_distance,
    check_numbers,
    maximum,
    minimum,
    norm,
    positive,
    positive_part,
    quotient,
    root,
    sector,
    segment_side,
)
from sorojax.sdf.shapes.bars import AbstractHalf, check_places


def touching_edges(*loops: np.ndarray) -> tuple[int, int] | None:
    """Two edges of closed polygons that meet away from a shared corner, or None; edges are
    numbered from loop to loop."""
    a = np.concatenate(loops)
    starts = np.cumsum([0, *map(len, loops[:-1])])
    rows = [start + np.arange(len(loop)) for start, loop in zip(starts, loops, strict=True)]
    after = np.concatenate([np.roll(row, -1) for row in rows])
    b, way = a[after], a[after] - a
    lower, upper = np.minimum(a, b), np.maximum(a, b)
    for i in range(len(a)):
        later = np.arange(i + 1, len(a))
        j = later[np.all((lower[later] <= upper[i]) & (upper[later] >= lower[i]), axis=1)]
        mine = _cross(way[i], a[j] - a[i]) * _cross(way[i], b[j] - a[i])
        other = _cross(way[j], a[i] - a[j]) * _cross(way[j], b[i] - a[j])
        # Neighbours share a corner; they touch elsewhere where one folds back on the other.
        back = (_cross(way[i], way[j]) == 0) & (way[j] @ way[i] < 0)
        next_to = (j == after[i]) | (after[j] == i)
        touching = j[np.where(next_to, back, (mine <= 0) & (other <= 0))]
        if len(touching):
            return i, int(touching[0])
    return None


def _cross(u, v) -> np.ndarray:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


# Plane shapes; every field here is the exact distance


class AbstractPlaneShape(AbstractSdf):
    """A shape in the plane with an exact distance."""

    dim: ClassVar[int] = 2
    exactness: ClassVar[Exactness] = EXACT


class AbstractBall(AbstractSdf):
    """All points within `radius` [m] of `center` [m]."""

    center: Float[Array, " dim"] = eqx.field(converter=real)
    radius: Float[Array, ""] = eqx.field(converter=positive)
    exactness: ClassVar[Exactness] = EXACT

    def __check_init__(self):
        check_places(self, "center")

    def distance(self, *x):
        return norm(*(c - self.center[i] for i, c in enumerate(x))) - self.radius

    def bounding_box(self) -> Box:
        return self.center - self.radius, self.center + self.radius


class Circle(AbstractBall):
    """Disc of `radius` [m] about `center` [m]."""

    dim: ClassVar[int] = 2


class AbstractBlock(AbstractSdf):
    """Box from `lower` to `upper` [m]; `radius` [m] rounds its edges inside it."""

    lower: Float[Array, " dim"] = eqx.field(converter=real)
    upper: Float[Array, " dim"] = eqx.field(converter=real)
    radius: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    exactness: ClassVar[Exactness] = EXACT

    def __check_init__(self):
        check_places(self, "lower", "upper")
        if not all(_check.is_concrete(v) for v in (self.lower, self.upper, self.radius)):
            return
        where, radius = type(self).__name__, float(self.radius)
        lower, upper = np.asarray(self.lower), np.asarray(self.upper)
        sides = upper - lower
        if not np.all(sides > 0):
            raise ValueError(
                f"{where}: `upper` must lie above `lower`, got {lower} m and {upper} m. Swap "
                "them or give a positive extent."
            )
        if not 0 <= radius <= sides.min() / 2 * (1 + 1e-12):
            raise ValueError(
                f"{where}: `radius` must lie between 0 and half the shorter side "
                f"({sides.min() / 2:g} m), got {radius:g} m. Round it less."
            )

    def distance(self, *x):
        center, half = (self.lower + self.upper) / 2, (self.upper - self.lower) / 2
        excess = (absolute(c - center[i]) - half[i] + self.radius for i, c in enumerate(x))
        return box_distance(*excess) - self.radius

    def bounding_box(self) -> Box:
        return self.lower, self.upper


class Rectangle(AbstractBlock):
    """Box from `lower` to `upper` [m]; `radius` [m] rounds its corners inside it."""

    dim: ClassVar[int] = 2


class HalfPlane(AbstractHalf):
    """Everything behind the line through `point` [m] whose outward normal is `normal`."""

    dim: ClassVar[int] = 2


class Polygon(AbstractPlaneShape):
    """Simple polygon of `vertices` [m] in either orientation."""

    vertices: Float[Array, "corners 2"] = eqx.field(converter=real)

    def __check_init__(self):
        _check.shape("Polygon", "vertices", self.vertices, (None, 2), "One row per corner.")
        if self.vertices.shape[0] < 3:
            raise ValueError(
                f"Polygon: `vertices` has {self.vertices.shape[0]} rows, a polygon needs at "
                "least 3. List each corner once, in order."
            )
        if _check.is_concrete(self.vertices):
            edges = touching_edges(np.asarray(self.vertices))
            if edges is not None:
                raise ValueError(
                    f"Polygon: edges {edges[0]} and {edges[1]} touch, need a simple polygon. "
                    "Put its corners in order, or join several polygons by `|`."
                )

    def distance(self, x, y):
        shape = (1,) * x.ndim + (-1,)
        ax, ay = (self.vertices[:, i].reshape(shape) for i in (0, 1))
        bx, by = jnp.roll(ax, -1, -1), jnp.roll(ay, -1, -1)
        ex, ey = bx - ax, by - ay
        length = norm(ex, ey)
        px, py = x[..., None] - ax, y[..., None] - ay
        t = quotient(px * ex + py * ey, length**2 + jnp.zeros_like(px))
        clipped = minimum(maximum(t, jnp.zeros_like(t)), jnp.ones_like(t))
        square = (px - clipped * ex) ** 2 + (py - clipped * ey) ** 2
        turn = jnp.where(jnp.sum(ax * by - ay * bx) > 0, 1, -1).astype(x.dtype)
        side = turn * quotient(px * ey - py * ex, length + jnp.zeros_like(px))
        nearest = jnp.argmin(square, axis=-1, keepdims=True)

        def pick(a):
            return jnp.take_along_axis(a, nearest, axis=-1)[..., 0]

        # Beside an edge the side of its line gives distance and sign, with a slope on
        # the boundary itself, where the root has none.
        beside = pick((t >= 0) & (t <= 1))
        sign = jnp.where(_inside(py, px, ey, ex), -1, 1).astype(x.dtype)
        return jnp.where(beside, pick(side), sign * root(pick(square)))

    def bounding_box(self) -> Box:
        return jnp.min(self.vertices, axis=0), jnp.max(self.vertices, axis=0)


def _inside(py, px, ey, ex) -> Bool[Array, "..."]:
    """Whether a ray to the right crosses an odd number of edges."""
    # The height over the next corner by the same subtraction as there: rounding must agree.
    crosses = (py >= 0) != (jnp.roll(py, -1, -1) >= 0)
    right = (px * ey - py * ex) * jnp.where(ey > 0, 1, -1).astype(px.dtype) < 0
    return jnp.sum(crosses & right, axis=-1) % 2 == 1


# Plane shapes with their centre at the origin; move them with `translate`


def _centred(*half: Array) -> Box:
    upper = jnp.stack(half)
    return -upper, upper


def _check_count(shape: "RegularPolygon | Star") -> None:
    if shape.count < 3:
        raise ValueError(
            f"{type(shape).__name__}: `count` must be at least 3, got {shape.count}. "
            "Give the number of corners."
        )


class RegularPolygon(AbstractPlaneShape):
    """Polygon of `count` equal sides, its corners at `radius` [m], one side facing +x."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    count: int = eqx.field(static=True)

    def __check_init__(self):
        _check_count(self)

    def distance(self, x, y):
        half = math.pi / self.count
        across, along = sector(x, y, self.count)
        across = across - self.radius * math.cos(half)
        past = absolute(along) - self.radius * math.sin(half)
        corner = norm(across, positive_part(past))
        return jnp.where((past <= 0) | (across <= 0), across, corner)

    def bounding_box(self) -> Box:
        return _centred(self.radius, self.radius)


class Star(AbstractPlaneShape):
    """Star of `count` tips at `radius` [m], the first on +x, notches at `inner_radius`."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    inner_radius: Float[Array, ""] = eqx.field(converter=positive)
    count: int = eqx.field(static=True)

    def __check_init__(self):
        _check_count(self)
        check_numbers(self)
        if _check.is_concrete(self.radius) and _check.is_concrete(self.inner_radius):
            _check.between(
                "Star",
                "inner_radius",
                self.inner_radius,
                0,
                float(self.radius),
                "m",
                "Exchange the two radii.",
            )

    def distance(self, x, y):
        half = math.pi / self.count
        x, y = sector(x, y, self.count)
        zero = jnp.zeros_like(self.radius)
        notch = (self.inner_radius * math.cos(half), self.inner_radius * math.sin(half))
        return segment_side(x, absolute(y), notch, (self.radius, zero))

    def bounding_box(self) -> Box:
        return _centred(self.radius, self.radius)


class Ring(AbstractPlaneShape):
    """Annulus from `inner_radius` to `radius` [m]."""

    inner_radius: Float[Array, ""] = eqx.field(converter=positive)
    radius: Float[Array, ""] = eqx.field(converter=positive)

    def distance(self, x, y):
        r = norm(x, y)
        return maximum(r - self.radius, self.inner_radius - r)

    def bounding_box(self) -> Box:
        return _centred(self.radius, self.radius)


class Arc(AbstractPlaneShape):
    """Arc of `radius` [m] within `half_angle` [rad] of +x, `width` [m] thick, round ends."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    half_angle: Float[Array, ""] = eqx.field(converter=real)
    width: Float[Array, ""] = eqx.field(converter=positive)
    # Where the ends meet, the inside is deeper than half a width.
    exactness: ClassVar[Exactness] = OUTSIDE

    def __check_init__(self):
        _check_half_angle(self)

    def distance(self, x, y):
        y = absolute(y)
        c, s = jnp.cos(self.half_angle), jnp.sin(self.half_angle)
        end = norm(x - c * self.radius, y - s * self.radius)
        along = absolute(norm(x, y) - self.radius)
        return jnp.where(c * y <= s * x, along, end) - self.width / 2

    def bounding_box(self) -> Box:
        reach = self.radius + self.width / 2
        return _centred(reach, reach)


def _check_half_angle(shape: "Arc | Pie") -> None:
    _check.between(
        type(shape).__name__,
        "half_angle",
        shape.half_angle,
        0,
        math.pi,
        "rad",
        "Use a Ring or a Circle for a whole turn.",
    )


class Pie(AbstractPlaneShape):
    """Sector of a disc of `radius` [m] within `half_angle` [rad] of +x."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    half_angle: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        _check_half_angle(self)

    def distance(self, x, y):
        zero = jnp.zeros_like(self.radius)
        c, s = jnp.cos(self.half_angle), jnp.sin(self.half_angle)
        edge = segment_side(x, absolute(y), (zero, zero), (c * self.radius, s * self.radius))
        return maximum(norm(x, y) - self.radius, edge)

    def bounding_box(self) -> Box:
        return _centred(self.radius, self.radius)


class Vesica(AbstractPlaneShape):
    """Lens between two arcs, `width` [m] wide along x and `height` [m] high along y."""

    width: Float[Array, ""] = eqx.field(converter=positive)
    height: Float[Array, ""] = eqx.field(converter=positive)

    def __check_init__(self):
        check_numbers(self)
        if _check.is_concrete(self.width) and _check.is_concrete(self.height):
            _check.between(
                "Vesica",
                "width",
                self.width,
                0,
                float(self.height) * (1 + 1e-9),
                "m",
                "Exchange them and turn the shape by `rotate`.",
            )

    def distance(self, x, y):
        a, b = self.width / 2, self.height / 2
        x, y = absolute(x), absolute(y)
        shift = (b * b - a * a) / (2 * a)  # from the origin to the centre of an arc
        tip = (y - b) * shift > x * b
        return jnp.where(tip, norm(x, y - b), norm(x + shift, y) - (a + shift))

    def bounding_box(self) -> Box:
        return _centred(self.width / 2, self.height / 2)


class Squircle(AbstractSdf):
    """Superellipse |x|^n + |y|^n = r^n, r = `radius` [m], n = `power` [-] above 2; a bound of
    the distance."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    power: Float[Array, ""] = eqx.field(converter=real)
    dim: ClassVar[int] = 2
    exactness: ClassVar[Exactness] = BOUND

    def __check_init__(self):
        _check.between(
            "Squircle", "power", self.power, 2, math.inf, "", "Use a Circle for power 2."
        )

    def distance(self, x, y):
        # The n-norm has a slope of length 1 or less for n above 2, so this is a bound;
        # it is homogeneous, and scaling by the larger coordinate keeps powers small.
        x, y = absolute(x), absolute(y)
        large = maximum(x, y)
        some = large > 0
        safe = jnp.where(some, large, jnp.ones_like(large))
        u, v = (_power(c / safe, self.power) for c in (x, y))
        length = safe * jnp.exp(jnp.log(u + v) / self.power)
        return jnp.where(some, length, jnp.zeros_like(large)) - self.radius

    def bounding_box(self) -> Box:
        return _centred(self.radius, self.radius)

    def level_box(self, level) -> Box:
        return _centred(self.radius + level, self.radius + level)


def _power(base: Array, power: Array) -> Array:
    """base^power with zero slopes where the base is zero."""
    some = base > 0
    safe = jnp.where(some, base, jnp.ones_like(base))
    return jnp.where(some, jnp.exp(power * jnp.log(safe)), jnp.zeros_like(base))


def triangle(a: Numbers, b: Numbers, c: Numbers) -> Polygon:
    """Triangle of three corners [m].

    Args:
        a: First corner [m].
        b: Second corner [m].
        c: Third corner [m].

    Returns:
        The triangle.
    """
    return Polygon(jnp.stack([real(a), real(b), real(c)]))


def trapezoid(width: Numbers, top_width: Numbers, height: Numbers) -> Polygon:
    """Symmetric trapezoid about the origin, `width` wide below, `top_width` above [m].

    Args:
        width: Length of the lower side [m].
        top_width: Length of the upper side [m].
        height: Distance of both [m].

    Returns:
        The trapezoid.
    """
    low, high, rise = real(width) / 2, real(top_width) / 2, real(height) / 2
    corners = [(-low, -rise), (low, -rise), (high, rise), (-high, rise)]
    return Polygon(jnp.stack([jnp.stack(corner) for corner in corners]))
