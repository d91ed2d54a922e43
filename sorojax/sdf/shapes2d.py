"""Plane shapes; every field here is the exact distance."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax import _check
from sorojax._types import real
from sorojax.sdf.base import EXACT, AbstractSdf, Box, Exactness
from sorojax.sdf.scalar import (
    absolute,
    maximum,
    minimum,
    norm,
    positive_part,
    quotient,
    root,
)
from sorojax.sdf.simple import touching_edges


class AbstractPlaneShape(AbstractSdf):
    """A shape in the plane with an exact distance."""

    @property
    def dim(self) -> int:
        return 2

    @property
    def exactness(self) -> Exactness:
        return EXACT


class Circle(AbstractPlaneShape):
    """Disc of `radius` [m] about `center` [m]."""

    center: Float[Array, "2"] = eqx.field(converter=real)
    radius: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        _check.shape("Circle", "center", self.center, (2,), "Give (x, y).")
        _check.positive("Circle", "radius", self.radius, "m", "Give a length above zero.")

    def distance(self, x, y):
        return norm(x - self.center[0], y - self.center[1]) - self.radius

    def bounding_box(self) -> Box:
        return self.center - self.radius, self.center + self.radius


class Rectangle(AbstractPlaneShape):
    """Box from `lower` to `upper` [m]; `radius` [m] rounds its corners inside it."""

    lower: Float[Array, "2"] = eqx.field(converter=real)
    upper: Float[Array, "2"] = eqx.field(converter=real)
    radius: Float[Array, ""] = eqx.field(converter=real, default=0.0)

    def __check_init__(self):
        check_box("Rectangle", self.lower, self.upper, self.radius, 2)

    def distance(self, x, y):
        center, half = (self.lower + self.upper) / 2, (self.upper - self.lower) / 2
        a = absolute(x - center[0]) - half[0] + self.radius
        b = absolute(y - center[1]) - half[1] + self.radius
        inner = minimum(maximum(a, b), jnp.zeros_like(a))
        return inner + norm(positive_part(a), positive_part(b)) - self.radius

    def bounding_box(self) -> Box:
        return self.lower, self.upper


def check_box(where: str, lower, upper, radius, dim: int) -> None:
    """Raise a `ValueError` unless the corners and the rounding make a box."""
    for name, corner in (("lower", lower), ("upper", upper)):
        _check.shape(where, name, corner, (dim,), f"Give {dim} coordinates.")
    if not all(_check.is_concrete(v) for v in (lower, upper, radius)):
        return
    sides = np.asarray(upper) - np.asarray(lower)
    if not np.all(sides > 0):
        raise ValueError(
            f"{where}: `upper` must lie above `lower`, got {np.asarray(lower)} m and "
            f"{np.asarray(upper)} m. Swap them or give a positive extent."
        )
    if not 0 <= float(radius) <= sides.min() / 2 * (1 + 1e-12):
        raise ValueError(
            f"{where}: `radius` must lie between 0 and half the shorter side "
            f"({sides.min() / 2:g} m), got {float(radius):g} m. Round it less."
        )


class HalfPlane(AbstractPlaneShape):
    """Everything behind the line through `point` [m] whose outward normal is `normal`."""

    point: Float[Array, "2"] = eqx.field(converter=real)
    normal: Float[Array, "2"] = eqx.field(converter=real)

    def __check_init__(self):
        _check.shape("HalfPlane", "point", self.point, (2,), "Give (x, y).")
        _check.shape("HalfPlane", "normal", self.normal, (2,), "Give (x, y).")
        if _check.is_concrete(self.normal) and not np.any(np.asarray(self.normal)):
            raise ValueError("HalfPlane: `normal` is zero. Give the outward direction.")

    def distance(self, x, y):
        n = self.normal / norm(self.normal[0], self.normal[1])
        return (x - self.point[0]) * n[0] + (y - self.point[1]) * n[1]

    def bounding_box(self) -> Box:
        # Only a line along an axis bounds a coordinate.
        across = self.normal[::-1] == 0
        infinity = jnp.full_like(self.point, jnp.inf)
        lower = jnp.where(across & (self.normal < 0), self.point, -infinity)
        return lower, jnp.where(across & (self.normal > 0), self.point, infinity)


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
