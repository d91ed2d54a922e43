"""Solids with triangular faces: octahedron, pyramid, any closed triangle mesh."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._types import integers, real
from sorojax.sdf.bars import segment_square
from sorojax.sdf.base import Box as Bounds, check_lengths
from sorojax.sdf.nearest import scan_rows, take
from sorojax.sdf.scalar import absolute, maximum, minimum, quotient, root
from sorojax.sdf.shapes3d import AbstractSolidShape
from sorojax.sdf.solids import centred

MOST_FACES = 20_000

Vector = tuple[Array, Array, Array]


def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _dot(a: Vector, b: Vector) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    )  # fmt: skip


def _over(p: Vector, a: Vector, b: Vector, c: Vector) -> tuple[Array, Array]:
    """Height of p over the plane of a triangle, and whether its foot is on the triangle."""
    n = _cross(_minus(b, a), _minus(c, a))
    within = None
    for start, end in ((a, b), (b, c), (c, a)):
        side = _dot(_cross(_minus(end, start), _minus(p, start)), n) >= 0
        within = side if within is None else within & side
    square = _dot(n, n)
    height = quotient(_dot(n, _minus(p, a)), root(square) + jnp.zeros_like(p[0]))
    return height, within & (square > 0)


def triangle_square(p: Vector, a: Vector, b: Vector, c: Vector) -> Array:
    """Square of the distance to a triangle [m^2]."""
    height, within = _over(p, a, b, c)
    edges = [segment_square(p, *ends) for ends in ((a, b), (b, c), (c, a))]
    return jnp.where(within, height * height, minimum(edges[0], minimum(edges[1], edges[2])))


def triangle_side(p: Vector, a: Vector, b: Vector, c: Vector, inside: Array) -> Array:
    """Signed distance to the nearest triangle; over its face it has a slope at zero too."""
    height, within = _over(p, a, b, c)
    edges = [segment_square(p, *ends) for ends in ((a, b), (b, c), (c, a))]
    far = root(minimum(edges[0], minimum(edges[1], edges[2])))
    return jnp.where(within, height, jnp.where(inside, -far, far))


class Octahedron(AbstractSolidShape):
    """Regular octahedron with its corners on the axes at `radius` [m]."""

    radius: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "radius")

    def distance(self, x, y, z):
        p = absolute(x), absolute(y), absolute(z)
        s, zero = self.radius, jnp.zeros_like(self.radius)
        corners = (s, zero, zero), (zero, s, zero), (zero, zero, s)
        return triangle_side(p, *corners, p[0] + p[1] + p[2] < s)

    def bounding_box(self) -> Bounds:
        return centred(self.radius, self.radius, self.radius)


class Pyramid(AbstractSolidShape):
    """Square pyramid: base of side `width` [m] at z = 0, tip at z = `height` [m]."""

    width: Float[Array, ""] = eqx.field(converter=real)
    height: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        check_lengths(self, "width", "height")

    def distance(self, x, y, z):
        half, zero = self.width / 2, jnp.zeros_like(self.width)
        x, y = absolute(x), absolute(y)
        x, y = maximum(x, y), minimum(x, y)
        inside = (z > 0) & (x * self.height + (z - self.height) * half < 0)
        flank = triangle_side(
            (x, y, z),
            (half, -half, zero),
            (half, half, zero),
            (zero, zero, self.height),
            inside,
        )
        base = jnp.where((x <= half) & (z <= 0), -z, jnp.full_like(x, jnp.inf))
        return jnp.where(inside, maximum(flank, -z), _smaller(base, flank))

    def bounding_box(self) -> Bounds:
        half = self.width / 2
        lower = jnp.stack([-half, -half, jnp.zeros_like(half)])
        return lower, jnp.stack([half, half, self.height])


def _smaller(base: Array, flank: Array) -> Array:
    # Below the base the flank may be seen from behind: only its size counts there.
    return minimum(base, absolute(flank))


class TriangleMesh(AbstractSolidShape):
    """Solid inside a closed triangle mesh, by the nearest of all its triangles.

    The sign is the winding number, so small gaps and overlaps do no harm. Every point
    looks at every face: meant for meshes of up to about ten thousand faces.
    """

    vertices: Float[Array, "vertices 3"] = eqx.field(converter=real)
    faces: Int[Array, "faces 3"] = eqx.field(converter=integers)

    def __check_init__(self):
        _check.shape("TriangleMesh", "vertices", self.vertices, (None, 3), "One row each.")
        _check.shape("TriangleMesh", "faces", self.faces, (None, 3), "Give triangles.")
        count = self.faces.shape[0]
        if not 4 <= count <= MOST_FACES:
            raise ValueError(
                f"TriangleMesh: got {count} faces, need 4 to {MOST_FACES}, because every "
                "point looks at all of them. Decimate the mesh, or sample it into a Sampled."
            )
        if _check.is_concrete(self.faces):
            faces = np.asarray(self.faces)
            if faces.min() < 0 or faces.max() >= self.vertices.shape[0]:
                raise ValueError(
                    f"TriangleMesh: `faces` names vertices {faces.min()} to {faces.max()}, "
                    f"need 0 to {self.vertices.shape[0] - 1}. Number them from zero."
                )

    def distance(self, x, y, z):
        corners = tuple(self.vertices[self.faces[:, i]] for i in range(3))

        def square(row, *p):
            return triangle_square(p, *(tuple(a) for a in row))

        def turn(row, *p):
            return _solid_angle(p, *(tuple(a) for a in row))

        index, turns = scan_rows(square, corners, (x, y, z), turn)
        inside = absolute(turns) > 2 * np.pi
        # Over a face its plane gives the distance; the sign stays that of the winding.
        side = triangle_side((x, y, z), *take(corners, index), inside)
        outward = jnp.where(jax.lax.stop_gradient(side) < 0, inside, ~inside)
        return jnp.where(outward | (side == 0), side, -side)

    def bounding_box(self) -> Bounds:
        used = self.vertices[self.faces.reshape(-1)]
        return jnp.min(used, axis=0), jnp.max(used, axis=0)


def _solid_angle(p: Vector, a: Vector, b: Vector, c: Vector) -> Array:
    """Signed solid angle of a triangle seen from p [sr] (Van Oosterom and Strackee)."""
    a, b, c = _minus(a, p), _minus(b, p), _minus(c, p)
    la, lb, lc = (root(_dot(v, v)) for v in (a, b, c))
    triple = _dot(a, _cross(b, c))
    rest = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
    return 2 * jnp.arctan2(triple, rest)
