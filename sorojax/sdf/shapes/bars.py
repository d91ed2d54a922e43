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
    check_numbers,
    clip,
    norm,
    positive,
    quotient,
    root,
)


def check_places(shape: AbstractSdf, *names: str) -> None:
    """Raise a `ValueError` unless the named fields have one number per axis: two or three."""
    where = type(shape).__name__
    sizes = [jnp.shape(getattr(shape, name)) for name in names]
    dim = type(shape).dim
    fitting = [(dim,)] if isinstance(dim, int) else [(2,), (3,)]
    if len(set(sizes)) != 1 or sizes[0] not in fitting:
        raise ValueError(
            f"{where}: {', '.join(f'`{n}`' for n in names)} have shape "
            f"{', '.join(map(str, sizes))}, need all {' or all '.join(map(str, fitting))}. "
            f"Give {' or '.join('(x, y)' if n == 2 else '(x, y, z)' for (n,) in fitting)}."
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


class AbstractAcross(AbstractSdf):
    """A shape bounded by lines or planes across `normal`, one of which may hold `point` [m]."""

    point: Float[Array, " dim"] = eqx.field(converter=real)
    normal: Float[Array, " dim"] = eqx.field(converter=real)
    exactness: ClassVar[Exactness] = EXACT

    def __check_init__(self):
        check_places(self, "point", "normal")
        check_direction(type(self).__name__, self.normal)

    def _height(self, x: tuple[Array, ...]) -> Array:
        """Distance along the normal from the one through `point` [m]."""
        n = self.normal / norm(*(self.normal[i] for i in range(len(x))))
        heights = ((c - self.point[i]) * n[i] for i, c in enumerate(x))
        return sum(heights, start=jnp.zeros_like(x[0]))

    def _bounded(self, below: Array, above: Array) -> Box:
        """The box from `below` to `above` on the axis that `normal` is along, if any."""
        axis = (self.normal != 0) & (jnp.sum(self.normal != 0) == 1)
        infinity = jnp.full_like(self.point, jnp.inf)
        return jnp.where(axis, below, -infinity), jnp.where(axis, above, infinity)


class Slab(AbstractAcross):
    """Layer of `thickness` [m] centred on the line or plane through `point` [m]."""

    thickness: Float[Array, ""] = eqx.field(converter=positive)

    @property
    def dim(self) -> int:
        return self.point.shape[0]

    def distance(self, *x):
        return absolute(self._height(x)) - self.thickness / 2

    def bounding_box(self) -> Box:
        return self._bounded(self.point - self.thickness / 2, self.point + self.thickness / 2)


class AbstractHalf(AbstractAcross):
    """Everything behind the line or plane through `point` whose outward normal is `normal`."""

    def distance(self, *x):
        return self._height(x)

    def bounding_box(self) -> Box:
        below = jnp.where(self.normal < 0, self.point, -jnp.inf)
        return self._bounded(below, jnp.where(self.normal > 0, self.point, jnp.inf))


class HalfSpace(AbstractHalf):
    """Everything behind the plane through `point` [m] whose outward normal is `normal`."""

    dim: ClassVar[int] = 3


def check_direction(where: str, normal: Array) -> None:
    if _check.is_concrete(normal) and not np.any(np.asarray(normal)):
        raise ValueError(f"{where}: the direction is zero. Give a vector along it.")


class AbstractBar(AbstractSdf):
    """A body about the straight line from `start` to `end` [m]."""

    start: Float[Array, " dim"] = eqx.field(converter=real)
    end: Float[Array, " dim"] = eqx.field(converter=real)
    exactness: ClassVar[Exactness] = EXACT

    def __check_init__(self):
        check_places(self, "start", "end")

    @property
    def dim(self) -> int:
        return self.start.shape[0]

    def _box(self, start_reach: Array, end_reach: Array) -> Box:
        """The box of what reaches as far [m] from either end along the axes."""
        lower = jnp.minimum(self.start - start_reach, self.end - end_reach)
        return lower, jnp.maximum(self.start + start_reach, self.end + end_reach)


class Strut(AbstractBar):
    """Bar with flat ends from `start` to `end` [m], round in space, `width` [m] across."""

    width: Float[Array, ""] = eqx.field(converter=positive)

    def __check_init__(self):
        check_apart("Strut", self.start, self.end)

    def distance(self, *x):
        along, across, length = along_and_across(x, self.start, self.end)
        return box_distance(absolute(along - length / 2) - length / 2, across - self.width / 2)

    def bounding_box(self) -> Box:
        u = self.end - self.start
        u = u / norm(*u)
        reach = self.width / 2 * root(1 - u * u)
        return self._box(reach, reach)


class Capsule(AbstractBar):
    """All points within `radius` [m] of the segment from `start` to `end` [m]."""

    radius: Float[Array, ""] = eqx.field(converter=positive)

    def distance(self, *x):
        a = tuple(self.start[i] for i in range(self.dim))
        b = tuple(self.end[i] for i in range(self.dim))
        return segment_distance(x, a, b) - self.radius

    def bounding_box(self) -> Box:
        return self._box(self.radius, self.radius)


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
    """Plane stadium along x about the origin, `length` [m] over all, `width` [m] high.

    Args:
        length: Over all [m].
        width: Height, twice the radius of the ends [m].

    Returns:
        The stadium.
    """
    width = real(width)
    half = jnp.stack([(real(length) - width) / 2, jnp.zeros_like(width)])
    return Capsule(-half, half, width / 2)


class RoundCone(AbstractBar):
    """Convex hull of two balls, in the plane of two discs (uneven capsule): one of
    `start_radius` about `start` and one of `end_radius` about `end` [m]."""

    start_radius: Float[Array, ""] = eqx.field(converter=positive)
    end_radius: Float[Array, ""] = eqx.field(converter=positive)

    def __check_init__(self):
        check_places(self, "start", "end")
        check_numbers(self)
        if all(_check.is_concrete(leaf) for leaf in jax.tree.leaves(self)):
            gap = float(np.linalg.norm(np.asarray(self.end) - np.asarray(self.start)))
            change = abs(float(self.start_radius) - float(self.end_radius))
            if change >= gap:
                raise ValueError(
                    f"RoundCone: one ball holds the other (radii differ by {change:g} m, "
                    f"centres by {gap:g} m). Use a Circle or a Sphere."
                )

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
        return self._box(self.start_radius, self.end_radius)
