"""Plane shapes with their centre at the origin; move them with `translate`."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.sdf.base import BOUND, AbstractSdf, Box, Exactness, check_lengths
from sorojax.sdf.scalar import (
    absolute,
    maximum,
    norm,
    positive_part,
    sector,
    segment_side,
)
from sorojax.sdf.shapes2d import AbstractPlaneShape, Polygon


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

    radius: Float[Array, ""] = eqx.field(converter=real)
    count: int = eqx.field(static=True)

    def __check_init__(self):
        check_lengths(self, "radius")
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

    radius: Float[Array, ""] = eqx.field(converter=real)
    inner_radius: Float[Array, ""] = eqx.field(converter=real)
    count: int = eqx.field(static=True)

    def __check_init__(self):
        check_lengths(self, "radius", "inner_radius")
        _check_count(self)
        if _check.is_concrete(self.radius) and _check.is_concrete(self.inner_radius):
            _check.between(
                "Star", "inner_radius", self.inner_radius, 0, float(self.radius), "m",
                "Exchange the two radii.",
            )  # fmt: skip

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

    inner_radius: Float[Array, ""] = eqx.field(converter=real)
    radius: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "radius", "inner_radius")

    def distance(self, x, y):
        r = norm(x, y)
        return maximum(r - self.radius, self.inner_radius - r)

    def bounding_box(self) -> Box:
        return _centred(self.radius, self.radius)


class Arc(AbstractPlaneShape):
    """Arc of `radius` [m] within `half_angle` [rad] of +x, `width` [m] thick, round ends."""

    radius: Float[Array, ""] = eqx.field(converter=real)
    half_angle: Float[Array, ""] = eqx.field(converter=real)
    width: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "radius", "width")
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

    @property
    def exactness(self) -> Exactness:
        # Where the ends meet, the inside is deeper than half a width.
        return Exactness(outside=True, inside=False)


def _check_half_angle(shape: "Arc | Pie") -> None:
    _check.between(
        type(shape).__name__, "half_angle", shape.half_angle, 0, math.pi, "rad",
        "Use a Ring or a Circle for a whole turn.",
    )  # fmt: skip


class Pie(AbstractPlaneShape):
    """Sector of a disc of `radius` [m] within `half_angle` [rad] of +x."""

    radius: Float[Array, ""] = eqx.field(converter=real)
    half_angle: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "radius")
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

    width: Float[Array, ""] = eqx.field(converter=real)
    height: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "width", "height")
        if _check.is_concrete(self.width) and _check.is_concrete(self.height):
            _check.between(
                "Vesica", "width", self.width, 0, float(self.height) * (1 + 1e-9), "m",
                "Exchange them and turn the shape by `rotate`.",
            )  # fmt: skip

    def distance(self, x, y):
        a, b = self.width / 2, self.height / 2
        x, y = absolute(x), absolute(y)
        shift = (b * b - a * a) / (2 * a)  # from the origin to the centre of an arc
        tip = (y - b) * shift > x * b
        return jnp.where(tip, norm(x, y - b), norm(x + shift, y) - (a + shift))

    def bounding_box(self) -> Box:
        return _centred(self.width / 2, self.height / 2)


class Squircle(AbstractSdf):
    """Superellipse |x|^n + |y|^n = radius^n, n = `power` above 2; a bound of the distance."""

    radius: Float[Array, ""] = eqx.field(converter=real)
    power: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "radius")
        _check.between(
            "Squircle", "power", self.power, 2, math.inf, "", "Use a Circle for power 2."
        )

    @property
    def dim(self) -> int:
        return 2

    @property
    def exactness(self) -> Exactness:
        return BOUND

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
    """Triangle of three corners [m]."""
    return Polygon(jnp.stack([real(a), real(b), real(c)]))


def trapezoid(width: Numbers, top_width: Numbers, height: Numbers) -> Polygon:
    """Symmetric trapezoid about the origin, `width` wide below, `top_width` above [m]."""
    low, high, rise = real(width) / 2, real(top_width) / 2, real(height) / 2
    corners = [(-low, -rise), (low, -rise), (high, rise), (-high, rise)]
    return Polygon(jnp.stack([jnp.stack(corner) for corner in corners]))
