"""Solid shapes; every field here is the exact distance."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.sdf.base import EXACT, AbstractSdf, Box as Bounds, Exactness
from sorojax.sdf.scalar import absolute, maximum, minimum, norm, positive_part
from sorojax.sdf.shapes2d import check_box


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
