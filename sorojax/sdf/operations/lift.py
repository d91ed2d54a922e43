"""Solids from plane shapes, and shapes mirrored, stretched and arranged in a circle."""

import functools
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.trace_state import is_traced
from sorojax._types import Numbers, real
from sorojax.sdf.base import (
    AbstractByLevel,
    AbstractSdf,
    Box,
    Exactness,
    Number,
    absolute,
    box_distance,
    clip,
    minimum,
    norm,
    positive_part,
)
from sorojax.sdf.operations.booleans import hull
from sorojax.sdf.operations.transform import AbstractWrapped, repeat, turned_box
from sorojax.sdf.shapes.bars import check_direction


class AbstractFromProfile(AbstractByLevel):
    """A solid made of a plane shape, `profile`, as steep as it."""

    profile: AbstractSdf
    dim: ClassVar[int] = 3

    @property
    def lipschitz(self) -> Number:
        return self.profile.lipschitz


class Extruded(AbstractFromProfile):
    """A plane shape drawn out along z from 0 to `height` [m]."""

    height: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        _check_plane("extrude", self.profile)
        _check.positive("extrude", "height", self.height, "m", "Give a length above zero.")

    @property
    def exactness(self) -> Exactness:
        return self.profile.exactness

    def distance(self, x, y, z):
        across, half = self.profile.distance(x, y), self.height / 2
        beyond = jnp.where(z >= half, z - self.height, -z)
        return box_distance(across, beyond)

    def level_box(self, level) -> Box:
        lower, upper = self.profile.level_box(level)
        zero = jnp.zeros((1,), lower.dtype)
        return (
            jnp.concatenate([lower, zero - level]),
            jnp.concatenate([upper, zero + self.height + level]),
        )


class Revolved(AbstractFromProfile):
    """A plane shape turned about z: its x is the distance from the axis, its y is z.

    What the profile holds at negative x is left out; the distance is exact where the
    profile lies at x >= 0 or is symmetric, and a bound otherwise.
    `clear` says that its box lies at x >= 0.
    """

    clear: bool = eqx.field(static=True)

    def __check_init__(self):
        _check_plane("revolve", self.profile)

    @property
    def exactness(self) -> Exactness:
        outside, inside = self.profile.exactness
        return Exactness(outside and self.clear, inside and self.clear)

    def distance(self, x, y, z):
        return self.profile.distance(norm(x, y), z)

    def level_box(self, level) -> Box:
        lower, upper = self.profile.level_box(level)
        r = jnp.maximum(upper[0], 0)
        return jnp.stack([-r, -r, lower[1]]), jnp.stack([r, r, upper[1]])


def _check_plane(where: str, profile: AbstractSdf) -> None:
    if profile.dim != 2:
        raise ValueError(
            f"{where}: the profile is {profile.dim}-D, need a plane shape. Draw it in the "
            "plane, or use `translate` and `|` on solids."
        )


class Mirrored(AbstractWrapped):
    """`shape` together with its image behind the plane through `point` [m] with `normal`."""

    shape: AbstractSdf
    normal: Float[Array, " dim"] = eqx.field(converter=real)
    point: Float[Array, " dim"] = eqx.field(converter=real)

    def __check_init__(self):
        _check.shape("mirror", "normal", self.normal, (self.shape.dim,), "One per axis.")
        _check.shape("mirror", "point", self.point, (self.shape.dim,), "One per axis.")
        check_direction("mirror", self.normal)

    @property
    def exactness(self) -> Exactness:
        return Exactness(self.shape.exactness.outside, False)

    def _unit(self) -> tuple[Array, ...]:
        n = tuple(self.normal[i] for i in range(self.dim))
        length = norm(*n)
        return tuple(c / length for c in n)

    def distance(self, *x):
        n = self._unit()
        zero = jnp.zeros_like(x[0])
        height = sum(((c - self.point[i]) * n[i] for i, c in enumerate(x)), start=zero)
        image = (c - 2 * height * n[i] for i, c in enumerate(x))
        return minimum(self.shape.distance(*x), self.shape.distance(*image))

    def level_box(self, level) -> Box:
        lower, upper = self.shape.level_box(level)
        n = jnp.stack(self._unit())
        reflect = jnp.eye(self.dim, dtype=n.dtype) - 2 * n[:, None] * n[None, :]
        shift = 2 * jnp.sum(self.point * n) * n
        return hull(
            [(lower, upper), turned_box((lower, upper), reflect, shift)],
            jnp.minimum,
            jnp.maximum,
        )


class Elongated(AbstractWrapped):
    """`shape` cut at the origin along each axis and drawn apart by `amount` [m].

    A bound: exact outside only for shapes that are symmetric about the cuts. Between
    cuts along all axes lies a block around which the shape is drawn; there the depth
    in the block adds to the field at the origin.
    """

    shape: AbstractSdf
    amount: Float[Array, " dim"] = eqx.field(converter=real)

    def __check_init__(self):
        _check.shape("elongate", "amount", self.amount, (self.shape.dim,), "One per axis.")
        if _check.is_concrete(self.amount) and not np.all(np.asarray(self.amount) >= 0):
            raise ValueError(
                f"elongate: `amount` must not be negative, got {np.asarray(self.amount)} m. "
                "Cut the shape with `&` to shorten it."
            )

    def distance(self, *x):
        half = self.amount / 2
        f = self.shape.distance(*(c - clip(c, -half[i], half[i]) for i, c in enumerate(x)))
        room = (half[i] - absolute(c) for i, c in enumerate(x))
        depth = positive_part(functools.reduce(minimum, room))
        return jnp.where(f > 0, f + depth, f - depth)

    def level_box(self, level) -> Box:
        lower, upper = self.shape.level_box(level)
        return lower - self.amount / 2, upper + self.amount / 2


class PolarRepeated(AbstractWrapped):
    """`count` copies of `shape` around the origin, in space around z.

    A copy within `reach` sectors of that of the point is always the closest.
    """

    shape: AbstractSdf
    count: int = eqx.field(static=True)
    reach: int = eqx.field(static=True)

    def __check_init__(self):
        if self.count < 1:
            raise ValueError(f"polar_repeat: `count` must be at least 1, got {self.count}.")

    @property
    def exactness(self) -> Exactness:
        return Exactness(self.shape.exactness.outside, False)

    def distance(self, x, y, *z):
        step = 2 * math.pi / self.count
        if 2 * self.reach + 1 >= self.count:
            copies = [jnp.full_like(x, i) for i in range(self.count)]
        else:
            lower, upper = self.shape.bounding_box()
            px, py, cx, cy = jax.lax.stop_gradient(
                (x, y, (lower[0] + upper[0]) / 2, (lower[1] + upper[1]) / 2)
            )
            angle = jnp.arctan2(cx * py - cy * px, cx * px + cy * py)
            nearest = jnp.round(angle / step)
            copies = [nearest + i for i in range(-self.reach, self.reach + 1)]
        turn = jnp.stack(copies) * step
        c, s = jnp.cos(turn), jnp.sin(turn)
        local = (c * x[None] + s * y[None], c * y[None] - s * x[None])
        heights = (jnp.broadcast_to(h[None], turn.shape) for h in z)
        values = self.shape.distance(*local, *heights)
        return functools.reduce(minimum, (values[i] for i in range(len(copies))))

    def level_box(self, level) -> Box:
        lower, upper = self.shape.level_box(level)
        far = jnp.maximum(jnp.abs(lower[:2]), jnp.abs(upper[:2]))
        radius = jnp.sqrt(jnp.sum(far**2))[None].repeat(2)
        return (jnp.concatenate([-radius, lower[2:]]), jnp.concatenate([radius, upper[2:]]))


def extrude(profile: AbstractSdf, height: Numbers) -> Extruded:
    """A plane shape as a prism along z.

    Args:
        profile: Plane shape in x and y.
        height: Extent of the prism, from z = 0 on [m]; positive.

    Returns:
        The solid; its field is as exact as that of `profile`.

    Raises:
        ValueError: If the profile is not plane, or `height` is not positive.

    Example:
        >>> pin = sdf.extrude(sdf.Circle([0, 0], 4 * mm), 50 * mm)
        >>> print(f"{float(pin(jnp.array([0.0, 0.0, 60 * mm]))) / mm:.1f} mm")
        10.0 mm
    """
    return Extruded(profile, height)


def revolve(profile: AbstractSdf) -> Revolved:
    """A plane shape as a solid of revolution: x becomes the radius, y becomes z.

    Args:
        profile: Plane shape; only its part at x >= 0 counts.

    Returns:
        The solid. Its field is as exact as that of `profile` where the profile lies at x >= 0
        and is not traced, and a bound of the distance otherwise.

    Raises:
        ValueError: If the profile is not plane.

    Example:
        >>> ring = sdf.revolve(sdf.Circle([20 * mm, 0], 5 * mm))  # a torus
        >>> print(f"{float(ring(jnp.array([0.0, 20 * mm, 0.0]))) / mm:.1f} mm")
        -5.0 mm
    """
    if is_traced(profile):
        return Revolved(profile, clear=False)
    return Revolved(profile, clear=bool(profile.bounding_box()[0][0] >= 0))


def mirror(shape: AbstractSdf, normal: Numbers, point: Numbers | None = None) -> Mirrored:
    """`shape` together with its mirror image at the plane through `point` [m].

    Args:
        shape: The shape.
        normal: Of the plane.
        point: On the plane [m]; the origin if omitted.

    Returns:
        Both as one shape.
    """
    return Mirrored(shape, normal, [0.0] * shape.dim if point is None else point)


def elongate(shape: AbstractSdf, amount: Numbers) -> Elongated:
    """`shape` cut at the origin and drawn apart by `amount` [m] per axis.

    Args:
        shape: The shape.
        amount: Length of the straight part along each axis [m].

    Returns:
        The longer shape.
    """
    return Elongated(shape, amount)


def polar_repeat(shape: AbstractSdf, count: int) -> PolarRepeated:
    """`count` copies of `shape` around the origin, in space around z.

    Right for parts without symmetry: as many neighbours are looked at as the part is
    wide, seen from the centre; all of them for a bound or under a trace.

    Args:
        shape: The first copy.
        count: Number of copies.

    Returns:
        The copies as one shape.
    """
    everything = PolarRepeated(shape, int(count), reach=int(count))
    if is_traced(shape) or not shape.exactness.outside:
        return everything
    lower, upper = (np.asarray(c, dtype=float)[:2] for c in shape.bounding_box())
    if not np.all(np.isfinite([lower, upper])) or np.all((lower <= 0) & (upper >= 0)):
        return everything
    corners = np.array([(x, y) for x in (lower[0], upper[0]) for y in (lower[1], upper[1])])
    middle = (lower + upper) / 2
    turn = np.arctan2(middle[0] * corners[:, 1] - middle[1] * corners[:, 0], corners @ middle)
    width = float(np.abs(turn).max()) * count / (2 * math.pi)
    return PolarRepeated(shape, int(count), reach=1 + math.floor(width))


def grid_repeat(
    shape: AbstractSdf,
    spacing: Numbers,
    counts: tuple[int, ...],
    *,
    separate: bool | None = None,
) -> AbstractSdf:
    """Copies of `shape` in rows along all axes: a row of rows, in space of layers.

    Right for parts without symmetry and for parts wider than the spacing, as `repeat`.

    Args:
        shape: The copy at the origin; the others lie at positive coordinates.
        spacing: Distance [m] between copies, one per axis.
        counts: Number of copies along each axis.
        separate: As in `repeat`, along every axis.

    Returns:
        The copies as one shape.
    """
    spacing = real(spacing)
    _check.shape("grid_repeat", "spacing", spacing, (shape.dim,), "One per axis.")
    if len(counts) != shape.dim:
        raise ValueError(
            f"grid_repeat: got {len(counts)} counts, need {shape.dim}. Give one per axis; 1 "
            "leaves an axis alone."
        )
    for axis, count in enumerate(counts):
        if count != 1:
            along = jnp.zeros_like(spacing).at[axis].set(spacing[axis])
            shape = repeat(shape, along, count, separate=separate)
    return shape
