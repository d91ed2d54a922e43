"""Solid shapes; every field here is the exact distance."""

import functools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.sdf.base import (
    EXACT,
    OUTSIDE,
    AbstractSdf,
    Box as Bounds,
    Exactness,
    absolute,
    box_distance,
    maximum,
    minimum,
    norm,
    positive,
    positive_part,
    sector,
    segment_side,
)
from sorojax.sdf.shapes.plane import AbstractBall, AbstractBlock


class AbstractSolidShape(AbstractSdf):
    """A shape in space with an exact distance."""

    dim: ClassVar[int] = 3
    exactness: ClassVar[Exactness] = EXACT


class Sphere(AbstractBall):
    """Ball of `radius` [m] about `center` [m]."""

    dim: ClassVar[int] = 3


class Box(AbstractBlock):
    """Cuboid from `lower` to `upper` [m]; `radius` [m] rounds its edges inside it."""

    dim: ClassVar[int] = 3


# Solids with their centre at the origin and their axis along z, with exact distances


def centred(*half: Array) -> Bounds:
    upper = jnp.stack(half)
    return -upper, upper


class BoxFrame(AbstractSolidShape):
    """The twelve edges of a cuboid of `size` [m] as square bars of `thickness` [m] inside."""

    size: Float[Array, "3"] = eqx.field(converter=real)
    thickness: Float[Array, ""] = eqx.field(converter=positive)
    exactness: ClassVar[Exactness] = OUTSIDE

    def __check_init__(self):
        _check.shape("BoxFrame", "size", self.size, (3,), "Give (x, y, z).")
        _check.positive("BoxFrame", "size", self.size, "m", "Give lengths above zero.")

    def distance(self, x, y, z):
        half, t = self.size / 2, self.thickness / 2
        p = tuple(absolute(c) - half[i] for i, c in enumerate((x, y, z)))
        q = tuple(absolute(c + t) - t for c in p)
        bars = [box_distance(*(p[j] if j == i else q[j] for j in range(3))) for i in range(3)]
        return minimum(minimum(bars[0], bars[1]), bars[2])

    def bounding_box(self) -> Bounds:
        return -self.size / 2, self.size / 2


class Torus(AbstractSolidShape):
    """Ring about z: circle of `radius` [m], thickened by `tube_radius` [m]."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    tube_radius: Float[Array, ""] = eqx.field(converter=positive)

    def distance(self, x, y, z):
        return norm(norm(x, y) - self.radius, z) - self.tube_radius

    def bounding_box(self) -> Bounds:
        reach = self.radius + self.tube_radius
        return centred(reach, reach, self.tube_radius)


class CappedTorus(AbstractSolidShape):
    """The part of a torus about z within `half_angle` [rad] of +x, with round ends: a tube of
    `tube_radius` [m] whose centre line has `radius` [m]."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    tube_radius: Float[Array, ""] = eqx.field(converter=positive)
    half_angle: Float[Array, ""] = eqx.field(converter=real)
    exactness: ClassVar[Exactness] = OUTSIDE

    def __check_init__(self):
        _check.between(
            "CappedTorus", "half_angle", self.half_angle, 0, np.pi, "rad", "Use a Torus."
        )

    def distance(self, x, y, z):
        y = absolute(y)
        c, s = jnp.cos(self.half_angle), jnp.sin(self.half_angle)
        end = norm(x - c * self.radius, y - s * self.radius, z)
        ring = norm(norm(x, y) - self.radius, z)
        return jnp.where(c * y <= s * x, ring, end) - self.tube_radius

    def bounding_box(self) -> Bounds:
        reach = self.radius + self.tube_radius
        return centred(reach, reach, self.tube_radius)


class InfiniteCylinder(AbstractSolidShape):
    """Cylinder of `radius` [m] without ends about the `axis` "x", "y" or "z"."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    axis: str = eqx.field(static=True, default="z")

    def __check_init__(self):
        if self.axis not in ("x", "y", "z"):
            raise ValueError(
                f"InfiniteCylinder: `axis` is {self.axis!r}, need 'x', 'y' or 'z'. Use `turn` "
                "for other directions."
            )

    def distance(self, x, y, z):
        across = {"x": (y, z), "y": (x, z), "z": (x, y)}[self.axis]
        return norm(*across) - self.radius

    def bounding_box(self) -> Bounds:
        r, infinity = self.radius, jnp.full_like(self.radius, jnp.inf)
        return centred(*(infinity if self.axis == name else r for name in "xyz"))


class Cylinder(AbstractSolidShape):
    """Cylinder of `radius` and `height` [m] about z; `rounding` [m] of its edges inside it."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    height: Float[Array, ""] = eqx.field(converter=positive)
    rounding: Float[Array, ""] = eqx.field(converter=real, default=0.0)

    def __check_init__(self):
        if all(_check.is_concrete(v) for v in (self.radius, self.height, self.rounding)):
            most = min(float(self.radius), float(self.height) / 2)
            if not 0 <= float(self.rounding) <= most * (1 + 1e-12):
                raise ValueError(
                    f"Cylinder: `rounding` must lie between 0 and {most:g} m, got "
                    f"{float(self.rounding):g} m. Round it less."
                )

    def distance(self, x, y, z):
        flank = norm(x, y) - self.radius + self.rounding
        ends = absolute(z) - self.height / 2 + self.rounding
        return box_distance(flank, ends) - self.rounding

    def bounding_box(self) -> Bounds:
        return centred(self.radius, self.radius, self.height / 2)


class CappedCone(AbstractSolidShape):
    """Truncated cone of `height` about z: `radius` below and `top_radius` above [m]."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    top_radius: Float[Array, ""] = eqx.field(converter=positive)
    height: Float[Array, ""] = eqx.field(converter=positive)

    def distance(self, x, y, z):
        return cone_distance(norm(x, y), z, self.radius, self.top_radius, self.height / 2)

    def bounding_box(self) -> Bounds:
        reach = jnp.maximum(self.radius, self.top_radius)
        return centred(reach, reach, self.height / 2)


class Cone(AbstractSolidShape):
    """Cone about z of `radius` and `height` [m], its tip on top."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    height: Float[Array, ""] = eqx.field(converter=positive)

    def distance(self, x, y, z):
        zero = jnp.zeros_like(self.radius)
        return cone_distance(norm(x, y), z, self.radius, zero, self.height / 2)

    def bounding_box(self) -> Bounds:
        return centred(self.radius, self.radius, self.height / 2)


def cone_distance(r: Array, z: Array, low: Array, high: Array, half: Array) -> Array:
    """Distance to a trapezoid of half widths `low`, `high` and half height `half` [m]."""
    flank = segment_side(r, z, (high, half), (low, -half))
    above = z >= 0
    past = positive_part(r - jnp.where(above, high, low))
    ends = absolute(z) - half
    end = jnp.where(past > 0, norm(past, ends), ends)
    # Inside both are negative; outside the nearer of the two surfaces counts.
    inside = (flank <= 0) & (ends <= 0)
    nearer = minimum(absolute(flank), absolute(end))
    return jnp.where(inside, maximum(flank, _beside(end, past, ends)), nearer)


def _beside(end: Array, past: Array, ends: Array) -> Array:
    """Depth below an end face; beside its rim the distance to the rim, still negative."""
    return jnp.where(past > 0, -end, ends)


class HexagonalPrism(AbstractSolidShape):
    """Hexagonal prism about z: corners at `radius` [m], `height` [m] high."""

    radius: Float[Array, ""] = eqx.field(converter=positive)
    height: Float[Array, ""] = eqx.field(converter=positive)

    def distance(self, x, y, z):
        across, along = sector(x, y, 6)
        across = across - self.radius * np.sqrt(0.75).item()
        past = absolute(along) - self.radius / 2
        plane = jnp.where(
            (past <= 0) | (across <= 0), across, norm(across, positive_part(past))
        )
        return box_distance(plane, absolute(z) - self.height / 2)

    def bounding_box(self) -> Bounds:
        return centred(self.radius, self.radius, self.height / 2)


# Ellipse and ellipsoid with their exact distance


_STEPS = 26


class Ellipsoid(AbstractSdf):
    """Ellipse (two `radii` [m]) or ellipsoid (three) about the origin, along the axes.

    The closest point solves one equation of a multiplier, by Newton's method on a
    convex function: from its left end it never passes the root. Points are kept 1e-9 of
    the radii off the symmetry planes (1e-5 in float32), which is the error there.
    """

    radii: Float[Array, " dim"] = eqx.field(converter=real)
    exactness: ClassVar[Exactness] = EXACT

    def __check_init__(self):
        _check.positive("Ellipsoid", "radii", self.radii, "m", "Give lengths above zero.")
        if jnp.shape(self.radii) not in ((2,), (3,)):
            raise ValueError(
                f"Ellipsoid: `radii` has shape {jnp.shape(self.radii)}, need (2,) for an "
                "ellipse or (3,). Give one semi-axis per coordinate."
            )

    @property
    def dim(self) -> int:
        return self.radii.shape[0]

    def distance(self, *x):
        radii = tuple(self.radii[i] for i in range(self.dim))
        # Off the symmetry planes by a hair: there the multiplier sits on a pole.
        tiny = 1e-9 if x[0].dtype == jnp.float64 else 1e-5
        p = tuple(absolute(c) + tiny * r for c, r in zip(x, radii, strict=True))
        t = _multiplier(p, radii)
        foot = tuple(r * r * c / (t + r * r) for c, r in zip(p, radii, strict=True))
        slope = tuple(f / (r * r) for f, r in zip(foot, radii, strict=True))
        return t * norm(*slope)

    def bounding_box(self) -> Bounds:
        return -self.radii, self.radii


@jax.custom_jvp
def _multiplier(p: tuple[Array, ...], radii: tuple[Array, ...]) -> Array:
    """The t with sum (r p / (t + r^2))^2 = 1 that belongs to the closest point [m^2]."""
    # Any single term alone gives a lower end, where the excess is not negative.
    low = functools.reduce(jnp.maximum, (r * c - r * r for c, r in zip(p, radii, strict=True)))

    def step(_, t):
        value, rate = _excess(t, p, radii)
        return t - value / rate

    return jax.lax.fori_loop(0, _STEPS + 1, step, low)


@_multiplier.defjvp
def _(primals, tangents):
    t = _multiplier(*primals)
    change = jax.jvp(lambda p, radii: _excess(t, p, radii)[0], primals, tangents)[1]
    return t, -change / _excess(t, *primals)[1]


def _excess(t: Array, p: tuple[Array, ...], radii: tuple[Array, ...]) -> tuple[Array, Array]:
    """The excess of the sum over 1, and its slope in t."""
    terms = [(r * c / (t + r * r)) ** 2 for c, r in zip(p, radii, strict=True)]
    rates = [-2 * q / (t + r * r) for q, r in zip(terms, radii, strict=True)]
    return sum(terms[1:], start=terms[0]) - 1, sum(rates[1:], start=rates[0])
