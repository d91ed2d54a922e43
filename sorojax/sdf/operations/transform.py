"""Shapes moved, scaled, thickened, hollowed and repeated."""

import functools
import math
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.trace_state import is_traced
from sorojax._types import Numbers, real
from sorojax.sdf.base import (
    BOUND,
    AbstractByLevel,
    AbstractSdf,
    Box,
    Exactness,
    Number,
    absolute,
    minimum,
    norm,
)
from sorojax.sdf.shapes.bars import check_direction


class AbstractWrapped(AbstractByLevel):
    """A shape made of one other, `shape`, of the same dimension and slope."""

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        shape: ClassVar[AbstractSdf]

    @property
    def dim(self) -> int:
        return self.shape.dim

    @property
    def lipschitz(self) -> Number:
        return self.shape.lipschitz


class AbstractMoved(AbstractWrapped):
    """A shape similar to another one: its field is as exact."""

    @property
    def exactness(self) -> Exactness:
        return self.shape.exactness


class Translated(AbstractMoved):
    """`shape` moved by `offset` [m]."""

    shape: AbstractSdf
    offset: Float[Array, " dim"] = eqx.field(converter=real)

    def __check_init__(self):
        _check.shape(
            "translate", "offset", self.offset, (self.shape.dim,), "One entry per axis."
        )

    def distance(self, *x):
        return self.shape.distance(*(c - self.offset[i] for i, c in enumerate(x)))

    def level_box(self, level) -> Box:
        lower, upper = self.shape.level_box(level)
        return lower + self.offset, upper + self.offset


class Rotated(AbstractMoved):
    """`shape` turned by `angle` [rad] about `center` [m], in space about the z axis."""

    shape: AbstractSdf
    angle: Float[Array, ""] = eqx.field(converter=real)
    center: Float[Array, "2"] = eqx.field(converter=real)

    def distance(self, *x):
        c, s = jnp.cos(self.angle), jnp.sin(self.angle)
        dx, dy = x[0] - self.center[0], x[1] - self.center[1]
        turned = (self.center[0] + c * dx + s * dy, self.center[1] - s * dx + c * dy)
        return self.shape.distance(*turned, *x[2:])

    def level_box(self, level) -> Box:
        lower, upper = self.shape.level_box(level)
        c, s = jnp.cos(self.angle), jnp.sin(self.angle)
        matrix = jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
        shift = self.center - matrix @ self.center
        low, high = turned_box((lower[:2], upper[:2]), matrix, shift)
        return jnp.concatenate([low, lower[2:]]), jnp.concatenate([high, upper[2:]])


class Scaled(AbstractMoved):
    """`shape` scaled by `factor` about the origin."""

    shape: AbstractSdf
    factor: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        _check.positive("scale", "factor", self.factor, "", "Mirror is another operation.")

    def distance(self, *x):
        return self.factor * self.shape.distance(*(c / self.factor for c in x))

    def level_box(self, level) -> Box:
        lower, upper = self.shape.level_box(level / self.factor)
        return lower * self.factor, upper * self.factor


class Offset(AbstractWrapped):
    """`shape` grown by `thickness` [m] on all sides, or shrunk where it is negative."""

    shape: AbstractSdf
    thickness: Float[Array, ""] = eqx.field(converter=real)

    @property
    def exactness(self) -> Exactness:
        # Growth keeps the distance outside, shrinking the one inside.
        if not _check.is_concrete(self.thickness):
            return BOUND
        outside, inside = self.shape.exactness
        grows = float(self.thickness) >= 0
        return Exactness(outside and grows, inside and not grows)

    def distance(self, *x):
        return self.shape.distance(*x) - self.thickness

    def level_box(self, level) -> Box:
        return self.shape.level_box(level + self.thickness)


class Shell(AbstractWrapped):
    """A wall of `thickness` [m] centred on the surface of `shape`."""

    shape: AbstractSdf
    thickness: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        _check.positive("shell", "thickness", self.thickness, "m", "Give the wall thickness.")

    @property
    def exactness(self) -> Exactness:
        return Exactness(self.shape.exact, False)

    def distance(self, *x):
        return absolute(self.shape.distance(*x)) - self.thickness / 2

    def level_box(self, level) -> Box:
        return self.shape.level_box(level + self.thickness / 2)


class Repeated(AbstractWrapped):
    """`count` copies of `shape`, each `step` [m] from the one before.

    Only the copies within `reach` of the nearest cell are evaluated: with a shape that is `w`
    wide along the step, 1 + w/|step| cells always hold the closest one. `separate` says that
    boxes of copies do not overlap along the step.
    """

    shape: AbstractSdf
    step: Float[Array, " dim"] = eqx.field(converter=real)
    count: int = eqx.field(static=True)
    reach: int = eqx.field(static=True)
    separate: bool = eqx.field(static=True)

    def __check_init__(self):
        _check.shape("repeat", "step", self.step, (self.shape.dim,), "One entry per axis.")
        if self.count < 1:
            raise ValueError(f"repeat: `count` must be at least 1, got {self.count}.")

    @property
    def exactness(self) -> Exactness:
        outside, inside = self.shape.exactness
        return Exactness(outside, inside and self.separate)

    def distance(self, *x):
        zero = jnp.zeros_like(x[0])
        if 2 * self.reach + 1 >= self.count:
            cells = [zero + i for i in range(self.count)]
        else:
            lower, upper = self.shape.bounding_box()
            center = (lower + upper) / 2
            along = sum((c - center[i]) * self.step[i] for i, c in enumerate(x))
            cell = along / jnp.sum(self.step**2)
            if self.separate:  # the copies on either side hold the closest one
                near = [jnp.floor(cell), jnp.floor(cell) + 1]
            else:
                near = [jnp.round(cell) + i for i in range(-self.reach, self.reach + 1)]
            # The end copies come again, not new ones beyond the array.
            cells = [jnp.clip(i, 0, self.count - 1) for i in near]
        # One evaluation over a leading axis: the program stays as small as one copy.
        index = jnp.stack(cells)
        local = (c[None] - index * self.step[i] for i, c in enumerate(x))
        values = self.shape.distance(*local)
        return functools.reduce(minimum, (values[i] for i in range(len(cells))))

    def level_box(self, level) -> Box:
        lower, upper = self.shape.level_box(level)
        last = (self.count - 1) * self.step
        zero = jnp.zeros_like(last)
        return lower + jnp.minimum(zero, last), upper + jnp.maximum(zero, last)


def translate(shape: AbstractSdf, offset: Numbers) -> Translated:
    """`shape` moved: f(x - offset).

    Args:
        shape: Any shape.
        offset: Displacement [m], one entry per axis.

    Returns:
        The moved shape; its field is as exact as that of `shape`.

    Raises:
        ValueError: If `offset` has not one entry per axis.

    Example:
        >>> moved = sdf.translate(sdf.Circle([0, 0], 4 * mm), [10 * mm, 0])
        >>> print(f"{float(moved(jnp.array([10 * mm, 0.0]))) / mm:.1f} mm")
        -4.0 mm
    """
    return Translated(shape, offset)


def rotate(shape: AbstractSdf, angle: Numbers, center=(0.0, 0.0)) -> Rotated:
    """`shape` turned counter-clockwise; a solid about an axis parallel to z.

    Args:
        shape: Any shape; `turn` takes solids about any other axis.
        angle: Angle [rad].
        center: Point (x, y) that stays where it is [m]; the origin by default.

    Returns:
        The turned shape; its field is as exact as that of `shape`.

    Example:
        >>> upright = sdf.rotate(sdf.Rectangle([0, 0], [20 * mm, 4 * mm]), np.pi / 2)
        >>> print(f"{float(upright(jnp.array([-2 * mm, 10 * mm]))) / mm:.1f} mm")
        -2.0 mm
    """
    return Rotated(shape, angle, center)


def scale(shape: AbstractSdf, factor: Numbers) -> Scaled:
    """`shape` scaled by `factor` about the origin; distances scale along.

    Args:
        shape: The shape.
        factor: Ratio of lengths [-].

    Returns:
        The scaled shape.
    """
    return Scaled(shape, factor)


def offset(shape: AbstractSdf, thickness: Numbers) -> Offset:
    """`shape` grown on all sides, its level set at `thickness`: f(x) - thickness.

    Convex corners of an exact distance become round. Growing keeps the distance exact outside,
    shrinking keeps it inside.

    Args:
        shape: Any shape.
        thickness: How far the surface moves outward [m]; inward where negative.

    Returns:
        The grown shape.

    Example:
        >>> grown = sdf.offset(sdf.Circle([0, 0], 10 * mm), 2 * mm)
        >>> print(f"{float(grown(jnp.array([0.0, 0.0]))) / mm:.1f} mm")
        -12.0 mm
    """
    return Offset(shape, thickness)


def shell(shape: AbstractSdf, thickness: Numbers) -> Shell:
    """A wall of `thickness` [m] centred on the surface of `shape`.

    Args:
        shape: The shape.
        thickness: Of the wall [m].

    Returns:
        The wall.
    """
    return Shell(shape, thickness)


def repeat(
    shape: AbstractSdf, step: Numbers, count: int, *, separate: bool | None = None
) -> Repeated:
    """A row of `count` copies of `shape`, each `step` [m] from the one before.

    Args:
        shape: The first copy.
        step: From one copy to the next [m].
        count: Number of copies.
        separate: Whether the boxes of the copies stay apart along the step, which makes
            two copies per point enough. Found from the boxes if omitted, which needs their
            sizes: under a trace it must be stated. False evaluates every copy.

    Returns:
        The copies as one shape.

    Raises:
        ValueError: If `step` is zero, copies stated to be separate overlap, or `separate`
            is left out under a trace.
    """
    step = real(step)
    if is_traced((shape, step)):
        if separate is None:
            raise ValueError(
                "repeat: got traced sizes and no `separate`, need it under a trace: whether "
                "copies overlap decides how many are evaluated. Pass `separate=True` if they "
                "stay apart along `step`, else `separate=False`."
            )
        reach = 1 if separate else int(count)
        return Repeated(shape, step, int(count), reach, bool(separate))
    stride = np.asarray(step, dtype=float)
    if not np.all(np.isfinite(stride)) or not np.any(stride):
        raise ValueError(f"repeat: `step` must be finite and not zero, got {stride} m.")
    lower, upper = (np.asarray(corner, dtype=float) for corner in shape.bounding_box())
    # Half width of the box along the step, in steps.
    width = float(np.abs(stride) @ (upper - lower) / 2 / (stride @ stride))
    if separate and not width <= 0.5:
        raise ValueError(
            f"repeat: the shape is {2 * width:.3g} steps wide, need at most 1 for "
            "`separate=True`. Leave `separate` out, or enlarge `step`."
        )
    if separate is False or not math.isfinite(width):
        return Repeated(shape, step, int(count), reach=int(count), separate=False)
    return Repeated(shape, step, int(count), 1 + math.floor(width), width <= 0.5)


# Rotation in space about any axis


class Turned(AbstractMoved):
    """A solid turned by `angle` [rad] about `axis` through `center` [m]."""

    shape: AbstractSdf
    axis: Float[Array, "3"] = eqx.field(converter=real)
    angle: Float[Array, ""] = eqx.field(converter=real)
    center: Float[Array, "3"] = eqx.field(converter=real)

    def __check_init__(self):
        if self.shape.dim != 3:
            raise ValueError(
                f"turn: the shape is {self.shape.dim}-D, need 3-D. Use `rotate` in the plane."
            )
        _check.shape("turn", "axis", self.axis, (3,), "Give (x, y, z).")
        _check.shape("turn", "center", self.center, (3,), "Give (x, y, z).")
        check_direction("turn", self.axis)

    def _matrix(self) -> Float[Array, "3 3"]:
        u = self.axis / norm(*(self.axis[i] for i in range(3)))
        c, s = jnp.cos(self.angle), jnp.sin(self.angle)
        zero = jnp.zeros_like(c)
        cross = jnp.stack([zero, -u[2], u[1], u[2], zero, -u[0], -u[1], u[0], zero])
        outer = u[:, None] * u[None, :]
        return c * jnp.eye(3, dtype=c.dtype) + s * cross.reshape(3, 3) + (1 - c) * outer

    def distance(self, *x):
        r = self._matrix()
        d = tuple(c - self.center[i] for i, c in enumerate(x))
        local = (
            self.center[j] + r[0, j] * d[0] + r[1, j] * d[1] + r[2, j] * d[2] for j in range(3)
        )
        return self.shape.distance(*local)

    def level_box(self, level) -> Box:
        r = self._matrix()
        shift = self.center - jnp.sum(r * self.center[None, :], axis=1)
        return turned_box(self.shape.level_box(level), r, shift)


def turned_box(box: Box, matrix: Float[Array, "dim dim"], shift: Array) -> Box:
    """Box around the image of `box` under x -> matrix x + shift; open sides stay open."""
    lower, upper = box

    def side(towards, away):
        # 0 * inf is a NaN: an axis that does not take part adds nothing.
        picked = jnp.where(matrix > 0, towards[None], away[None])
        return jnp.sum(jnp.where(matrix == 0, 0, matrix * picked), axis=1) + shift

    return side(lower, upper), side(upper, lower)


def turn(shape: AbstractSdf, axis: Numbers, angle: Numbers, center=(0.0, 0.0, 0.0)) -> Turned:
    """A solid turned by `angle` [rad] about `axis` through `center` [m].

    Args:
        shape: A solid.
        axis: Direction of the axis.
        angle: Angle [rad].
        center: A point of the axis [m].

    Returns:
        The turned solid.
    """
    return Turned(shape, axis, angle, center)
