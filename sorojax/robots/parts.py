"""Parts that the printable robots share: round bellows, and shapes laid along an axis."""

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import real
from sorojax.sdf import (
    AbstractSdf,
    Rectangle,
    SmoothUnion,
    offset,
    repeat,
    rotate,
    translate,
)
from sorojax.sdf.base import minimum
from sorojax.sdf.operations.booleans import hull
from sorojax.sdf.operations.lift import revolve
from sorojax.sdf.operations.transform import AbstractWrapped
from sorojax.sdf.shapes.solid import Cylinder
from sorojax.units import mm


@displayed
class Bellows(eqx.Module):
    """A round bellows standing on z = 0, closed at both ends [m].

    `num_folds` folds of `outer_radius` stand `pitch` apart on a tube of `inner_radius`;
    the wall is at least `wall_thickness` everywhere, the ends are `cap` thick.
    """

    outer_radius: Float[Array, ""] = eqx.field(converter=real, default=12 * mm)
    inner_radius: Float[Array, ""] = eqx.field(converter=real, default=7 * mm)
    pitch: Float[Array, ""] = eqx.field(converter=real, default=8 * mm)
    fold_height: Float[Array, ""] = eqx.field(converter=real, default=4.8 * mm)
    wall_thickness: Float[Array, ""] = eqx.field(converter=real, default=1.2 * mm)
    cap: Float[Array, ""] = eqx.field(converter=real, default=3 * mm)
    fillet: Float[Array, ""] = eqx.field(converter=real, default=1.5 * mm)
    num_folds: int = eqx.field(static=True, default=7)

    def __check_init__(self):
        for name in ("outer_radius", "inner_radius", "pitch", "wall_thickness", "cap"):
            _check.between(
                "Bellows", name, getattr(self, name), 0.0, 1.0, "m",
                "Lengths are in metres: write 2 * mm.",
            )  # fmt: skip
        if _check.is_concrete(self.fold_height) and _check.is_concrete(self.wall_thickness):
            hollow = float(self.fold_height - 2 * self.wall_thickness)
            open_ = float(self.pitch - self.fold_height)
            if hollow <= 0 or open_ <= 0:
                raise ValueError(
                    f"Bellows: folds are hollow by {hollow * 1e3:.3g} mm and stand "
                    f"{open_ * 1e3:.3g} mm apart, need both above zero. Choose `fold_height` "
                    "between two walls and the pitch."
                )

    @property
    def length(self) -> Float[Array, ""]:
        return self.num_folds * self.pitch + 2 * self.cap

    def _profile(self) -> AbstractSdf:
        """Half section and its mirror image: x is the radius, y the height."""
        middle = self.cap + self.pitch / 2
        half = self.fold_height / 2
        fold = Rectangle(
            [-self.outer_radius, middle - half], [self.outer_radius, middle + half], 0.9 * half
        )
        zero = jnp.zeros_like(self.length)
        tube = Rectangle([-self.inner_radius, zero], [self.inner_radius, self.length])
        folds = repeat(fold, [0.0, self.pitch], self.num_folds, separate=True)
        return SmoothUnion(folds, tube, self.fillet)

    def solid(self) -> AbstractSdf:
        """The bellows without its hollow."""
        return revolve(self._profile())

    def chamber(self) -> AbstractSdf:
        """The hollow."""
        wide = 2 * self.outer_radius
        between = Rectangle([-wide, self.cap], [wide, self.length - self.cap])
        return revolve(offset(self._profile(), -self.wall_thickness) & between)


class LaidAlong(AbstractWrapped):
    """`shape` turned so that its z axis lies along `axis` (0: x, 1: y) of the world."""

    shape: AbstractSdf
    axis: int = eqx.field(static=True)

    @property
    def exactness(self):
        return self.shape.exactness

    def distance(self, *x):
        return self.shape.distance(*(x[(self.axis + 1 + i) % 3] for i in range(3)))

    def level_box(self, level):
        lower, upper = self.shape.level_box(level)
        return jnp.roll(lower, self.axis + 1), jnp.roll(upper, self.axis + 1)


class Placed(AbstractWrapped):
    """Copies of `shape`, each turned about z by an angle [rad] and then moved [m].

    One evaluation over a leading axis: the program stays as small as one copy.
    """

    shape: AbstractSdf
    angles: Float[Array, " copies"] = eqx.field(converter=real)
    offsets: Float[Array, "copies 3"] = eqx.field(converter=real)

    def distance(self, x, y, z):
        wide = (-1,) + (1,) * x.ndim
        c, s = jnp.cos(self.angles).reshape(wide), jnp.sin(self.angles).reshape(wide)
        dx, dy, dz = (
            a[None] - self.offsets[:, i].reshape(wide) for i, a in enumerate((x, y, z))
        )
        copies = self.shape.distance(c * dx + s * dy, c * dy - s * dx, dz)
        return functools.reduce(minimum, (copies[k] for k in range(len(self.angles))))

    def level_box(self, level):
        copies = [
            translate(rotate(self.shape, a), o).level_box(level)
            for a, o in zip(self.angles, self.offsets, strict=True)
        ]
        return hull(copies, jnp.minimum, jnp.maximum)


def pipe(radius, start, length, axis: int) -> AbstractSdf:
    """A cylinder [m] from `start` that runs `length` along `axis`, backwards if negative."""
    start, length = real(start), real(length)
    upright = Cylinder(radius, jnp.abs(length))
    turned = upright if axis == 2 else LaidAlong(upright, axis)
    along = jnp.zeros(3, start.dtype).at[axis].set(length / 2)
    return translate(turned, start + along)
