"""Solid shapes; every field here is the exact distance."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.sdf.base import (
    EXACT,
    AbstractSdf,
    Box as Bounds,
    Exactness,
    absolute,
    box_distance,
    check_lengths,
    maximum,
    minimum,
    norm,
    positive_part,
    sector,
    segment_side,
)
from sorojax.sdf.shapes.plane import check_box


class AbstractSolidShape(AbstractSdf):
    """A shape in space with an exact distance."""

    @property
    def dim(self) -> int:
        return 3

    @property
    def exactness(self) -> Exactness:
        return EXACT


class Sphere(AbstractSolidShape):
    """Ball of `radius` [m] about `center` [m]."""

    center: Float[Array, "3"] = eqx.field(converter=real)
    radius: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        _check.shape("Sphere", "center", self.center, (3,), "Give (x, y, z).")
        _check.positive("Sphere", "radius", self.radius, "m", "Give a length above zero.")

    def distance(self, x, y, z):
        c = self.center
        return norm(x - c[0], y - c[1], z - c[2]) - self.radius

    def bounding_box(self) -> Bounds:
        return self.center - self.radius, self.center + self.radius


class Box(AbstractSolidShape):
    """Cuboid from `lower` to `upper` [m]; `radius` [m] rounds its edges inside it."""

    lower: Float[Array, "3"] = eqx.field(converter=real)
    upper: Float[Array, "3"] = eqx.field(converter=real)
    radius: Float[Array, ""] = eqx.field(converter=real, default=0.0)

    def __check_init__(self):
        check_box("Box", self.lower, self.upper, self.radius, 3)

    def distance(self, x, y, z):
        center, half = (self.lower + self.upper) / 2, (self.upper - self.lower) / 2
        a = absolute(x - center[0]) - half[0] + self.radius
        b = absolute(y - center[1]) - half[1] + self.radius
        c = absolute(z - center[2]) - half[2] + self.radius
        inner = minimum(maximum(a, maximum(b, c)), jnp.zeros_like(a))
        outer = norm(positive_part(a), positive_part(b), positive_part(c))
        return inner + outer - self.radius

    def bounding_box(self) -> Bounds:
        return self.lower, self.upper


# Solids with their centre at the origin and their axis along z, with exact distances


def centred(*half: Array) -> Bounds:
    upper = jnp.stack(half)
    return -upper, upper


class BoxFrame(AbstractSolidShape):
    """The twelve edges of a cuboid of `size` [m] as square bars of `thickness` [m] inside."""

    size: Float[Array, "3"] = eqx.field(converter=real)
    thickness: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        _check.shape("BoxFrame", "size", self.size, (3,), "Give (x, y, z).")
        _check.positive("BoxFrame", "size", self.size, "m", "Give lengths above zero.")
        check_lengths(self, "thickness")

    def distance(self, x, y, z):
        half, t = self.size / 2, self.thickness / 2
        p = tuple(absolute(c) - half[i] for i, c in enumerate((x, y, z)))
        q = tuple(absolute(c + t) - t for c in p)
        bars = [box_distance(*(p[j] if j == i else q[j] for j in range(3))) for i in range(3)]
        return minimum(minimum(bars[0], bars[1]), bars[2])

    def bounding_box(self) -> Bounds:
        return -self.size / 2, self.size / 2

    @property
    def exactness(self) -> Exactness:
        return Exactness(outside=True, inside=False)


class Torus(AbstractSolidShape):
    """Ring about z: circle of `radius` [m], thickened by `tube_radius` [m]."""

    radius: Float[Array, ""] = eqx.field(converter=real)
    tube_radius: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "radius", "tube_radius")

    def distance(self, x, y, z):
        return norm(norm(x, y) - self.radius, z) - self.tube_radius

    def bounding_box(self) -> Bounds:
        reach = self.radius + self.tube_radius
        return centred(reach, reach, self.tube_radius)


class CappedTorus(AbstractSolidShape):
    """The part of a torus within `half_angle` [rad] of +x, with round ends."""

    radius: Float[Array, ""] = eqx.field(converter=real)
    tube_radius: Float[Array, ""] = eqx.field(converter=real)
    half_angle: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "radius", "tube_radius")
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

    @property
    def exactness(self) -> Exactness:
        return Exactness(outside=True, inside=False)


class InfiniteCylinder(AbstractSolidShape):
    """Cylinder of `radius` [m] without ends about the `axis` "x", "y" or "z"."""

    radius: Float[Array, ""] = eqx.field(converter=real)
    axis: str = eqx.field(static=True, default="z")

    def __check_init__(self):
        check_lengths(self, "radius")
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

    radius: Float[Array, ""] = eqx.field(converter=real)
    height: Float[Array, ""] = eqx.field(converter=real)
    rounding: Float[Array, ""] = eqx.field(converter=real, default=0.0)

    def __check_init__(self):
        check_lengths(self, "radius", "height")
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
    """Truncated cone about z: `radius` at the bottom, `top_radius` at the top [m]."""

    radius: Float[Array, ""] = eqx.field(converter=real)
    top_radius: Float[Array, ""] = eqx.field(converter=real)
    height: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "radius", "top_radius", "height")

    def distance(self, x, y, z):
        return cone_distance(norm(x, y), z, self.radius, self.top_radius, self.height / 2)

    def bounding_box(self) -> Bounds:
        reach = jnp.maximum(self.radius, self.top_radius)
        return centred(reach, reach, self.height / 2)


class Cone(AbstractSolidShape):
    """Cone about z of `radius` and `height` [m], its tip on top."""

    radius: Float[Array, ""] = eqx.field(converter=real)
    height: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "radius", "height")

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

    radius: Float[Array, ""] = eqx.field(converter=real)
    height: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "radius", "height")

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
