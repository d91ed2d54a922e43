"""Bodies along straight lines, in the plane or in space."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.sdf.base import (
    EXACT,
    AbstractSdf,
    Box,
    Exactness,
    absolute,
    box_distance,
    check_lengths,
    clip,
    norm,
    quotient,
    root,
)


def check_point(shape: AbstractSdf, *names: str) -> None:
    """Raise a `ValueError` unless the named fields are points of one dimension, 2 or 3."""
    where = type(shape).__name__
    shapes = {jnp.shape(getattr(shape, name)) for name in names}
    if len(shapes) != 1 or not shapes <= {(2,), (3,)}:
        raise ValueError(
            f"{where}: {', '.join(f'`{n}`' for n in names)} have shapes {sorted(shapes)}, "
            "need all (2,) or all (3,). Give (x, y) or (x, y, z)."
        )


def check_apart(where: str, a: Array, b: Array) -> None:
    """Raise a `ValueError` where two end points coincide."""
    if _check.is_concrete(a) and _check.is_concrete(b) and np.array_equal(a, b):
        raise ValueError(f"{where}: both ends lie at {np.asarray(a)} m. Give two points.")


def along_and_across(x: tuple[Array, ...], a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Coordinate along the line from a to b, distance from the line, length of a to b [m]."""
    e = tuple(b[i] - a[i] for i in range(len(x)))
    length = norm(*e)
    u = tuple(c / length for c in e)
    p = tuple(c - a[i] for i, c in enumerate(x))
    along = sum((c * d for c, d in zip(p[1:], u[1:], strict=True)), start=p[0] * u[0])
    if len(x) == 2:
        return along, absolute(u[0] * p[1] - u[1] * p[0]), length
    return along, norm(*(c - along * d for c, d in zip(p, u, strict=True))), length


class Slab(AbstractSdf):
    """Layer of `thickness` [m] centred on the line or plane through `point` [m]."""

    point: Float[Array, " dim"] = eqx.field(converter=real)
    normal: Float[Array, " dim"] = eqx.field(converter=real)
    thickness: Float[Array, ""] = eqx.field(converter=real)
    exactness: ClassVar[Exactness] = EXACT

    def __check_init__(self):
        check_point(self, "point", "normal")
        check_lengths(self, "thickness")
        check_direction("Slab", self.normal)

    @property
    def dim(self) -> int:
        return self.point.shape[0]

    def distance(self, *x):
        return absolute(_height(x, self.point, self.normal)) - self.thickness / 2

    def bounding_box(self) -> Box:
        axis = _axis(self.normal)
        infinity = jnp.full_like(self.point, jnp.inf)
        half = self.thickness / 2
        return (
            jnp.where(axis, self.point - half, -infinity),
            jnp.where(axis, self.point + half, infinity),
        )


class HalfSpace(AbstractSdf):
    """Everything behind the plane through `point` [m] whose outward normal is `normal`."""

    point: Float[Array, "3"] = eqx.field(converter=real)
    normal: Float[Array, "3"] = eqx.field(converter=real)
    dim: ClassVar[int] = 3
    exactness: ClassVar[Exactness] = EXACT

    def __check_init__(self):
        _check.shape("HalfSpace", "point", self.point, (3,), "Give (x, y, z).")
        _check.shape("HalfSpace", "normal", self.normal, (3,), "Give (x, y, z).")
        check_direction("HalfSpace", self.normal)

    def distance(self, *x):
        return _height(x, self.point, self.normal)

    def bounding_box(self) -> Box:
        axis = _axis(self.normal)
        infinity = jnp.full_like(self.point, jnp.inf)
        return (
            jnp.where(axis & (self.normal < 0), self.point, -infinity),
            jnp.where(axis & (self.normal > 0), self.point, infinity),
        )


def check_direction(where: str, normal: Array) -> None:
    if _check.is_concrete(normal) and not np.any(np.asarray(normal)):
        raise ValueError(f"{where}: the direction is zero. Give a vector along it.")


def _height(x: tuple[Array, ...], point: Array, normal: Array) -> Array:
    n = normal / norm(*(normal[i] for i in range(len(x))))
    return sum(((c - point[i]) * n[i] for i, c in enumerate(x)), start=jnp.zeros_like(x[0]))


def _axis(normal: Array) -> Array:
    """Mask of the axis that `normal` is along; all false where it is along none."""
    return (normal != 0) & (jnp.sum(normal != 0) == 1)


class Strut(AbstractSdf):
    """Bar with flat ends from `start` to `end` [m], round in space, `width` [m] across."""

    start: Float[Array, " dim"] = eqx.field(converter=real)
    end: Float[Array, " dim"] = eqx.field(converter=real)
    width: Float[Array, ""] = eqx.field(converter=real)
    exactness: ClassVar[Exactness] = EXACT

    def __check_init__(self):
        check_point(self, "start", "end")
        check_lengths(self, "width")
        check_apart("Strut", self.start, self.end)

    @property
    def dim(self) -> int:
        return self.start.shape[0]

    def distance(self, *x):
        along, across, length = along_and_across(x, self.start, self.end)
        return box_distance(absolute(along - length / 2) - length / 2, across - self.width / 2)

    def bounding_box(self) -> Box:
        u = self.end - self.start
        u = u / norm(*u)
        reach = self.width / 2 * root(1 - u * u)
        return jnp.minimum(self.start, self.end) - reach, jnp.maximum(
            self.start, self.end
        ) + reach


class Capsule(AbstractSdf):
    """All points within `radius` [m] of the segment from `start` to `end` [m]."""

    start: Float[Array, " dim"] = eqx.field(converter=real)
    end: Float[Array, " dim"] = eqx.field(converter=real)
    radius: Float[Array, ""] = eqx.field(converter=real)
    exactness: ClassVar[Exactness] = EXACT

    def __check_init__(self):
        check_point(self, "start", "end")
        check_lengths(self, "radius")

    @property
    def dim(self) -> int:
        return self.start.shape[0]

    def distance(self, *x):
        a = tuple(self.start[i] for i in range(self.dim))
        b = tuple(self.end[i] for i in range(self.dim))
        return segment_distance(x, a, b) - self.radius

    def bounding_box(self) -> Box:
        a, b = self.start, self.end
        return jnp.minimum(a, b) - self.radius, jnp.maximum(a, b) + self.radius


def segment_distance(x: tuple[Array, ...], a: tuple, b: tuple) -> Array:
    """Distance [m] to the segment from a to b, each one array per axis."""
    return root(segment_square(x, a, b))


def segment_square(x: tuple[Array, ...], a: tuple, b: tuple) -> Array:
    """Square of the distance to a segment [m^2]."""
    e = tuple(q - p for p, q in zip(a, b, strict=True))
    d = tuple(c - p for c, p in zip(x, a, strict=True))
    zero = jnp.zeros_like(d[0])
    dot = sum((c * k for c, k in zip(d, e, strict=True)), start=zero)
    t = clip(quotient(dot, sum((k * k for k in e), start=zero)), 0.0, 1.0)
    return sum(((c - t * k) ** 2 for c, k in zip(d, e, strict=True)), start=zero)


def stadium(length: Numbers, width: Numbers) -> Capsule:
    """Plane stadium along x about the origin, `length` [m] over all, `width` [m] high."""
    width = real(width)
    half = jnp.stack([(real(length) - width) / 2, jnp.zeros_like(width)])
    return Capsule(-half, half, width / 2)


class RoundCone(AbstractSdf):
    """Convex hull of two balls, in the plane of two discs (uneven capsule)."""

    start: Float[Array, " dim"] = eqx.field(converter=real)
    end: Float[Array, " dim"] = eqx.field(converter=real)
    start_radius: Float[Array, ""] = eqx.field(converter=real)
    end_radius: Float[Array, ""] = eqx.field(converter=real)
    exactness: ClassVar[Exactness] = EXACT

    def __check_init__(self):
        check_point(self, "start", "end")
        check_lengths(self, "start_radius", "end_radius")
        if all(_check.is_concrete(leaf) for leaf in jax.tree.leaves(self)):
            gap = float(np.linalg.norm(np.asarray(self.end) - np.asarray(self.start)))
            change = abs(float(self.start_radius) - float(self.end_radius))
            if change >= gap:
                raise ValueError(
                    f"RoundCone: one ball holds the other (radii differ by {change:g} m, "
                    f"centres by {gap:g} m). Use a Circle or a Sphere."
                )

    @property
    def dim(self) -> int:
        return self.start.shape[0]

    def distance(self, *x):
        along, across, length = along_and_across(x, self.start, self.end)
        s = (self.start_radius - self.end_radius) / length
        c = root(1 - s * s)
        foot = c * along - s * across
        flank = c * across + s * along - self.start_radius
        low = norm(across, along) - self.start_radius
        high = norm(across, along - length) - self.end_radius
        return jnp.where(foot < 0, low, jnp.where(foot > c * length, high, flank))

    def bounding_box(self) -> Box:
        lower = jnp.minimum(self.start - self.start_radius, self.end - self.end_radius)
        upper = jnp.maximum(self.start + self.start_radius, self.end + self.end_radius)
        return lower, upper
