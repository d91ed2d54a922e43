"""Solids with triangular faces: octahedron, pyramid, any closed triangle mesh."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._jax.trace_state import is_traced
from sorojax._types import integers, real
from sorojax.sdf.base import Box as Bounds, check_lengths
from sorojax.sdf.nearest import scan_rows, take
from sorojax.sdf.scalar import absolute, maximum, minimum, ordered
from sorojax.sdf.shapes3d import AbstractSolidShape
from sorojax.sdf.solids import centred
from sorojax.sdf.triangle_tree import TriangleTree, triangle_tree
from sorojax.sdf.triangles import Vector, solid_angle, triangle_side, triangle_square

MOST_FACES = 20_000


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
        y, x = ordered(absolute(x), absolute(y))
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


_ON_SURFACE = 16  # of rounding: points that near to the surface are on it


class TriangleMesh(AbstractSolidShape):
    """Solid inside a closed triangle mesh, by the nearest of its triangles.

    A watertight mesh is searched by a tree of boxes and its sign is that of the normal at
    the closest face, edge or corner. A mesh with gaps, or one built under a trace, is
    searched face by face and takes the winding number for its sign, to which small gaps
    and overlaps do no harm.

    `lists=True` prepares a watertight mesh for a million points and more: it takes seconds
    to list, by cubes of space, what may be closest, and then a point in the box of a mesh
    of 10,000 triangles is found about 25 times faster. Beyond 10,000 some cubes stay
    without a list. Once `vertices` move, the tree is searched again.

    Reference: Baerentzen and Aanaes, Signed distance computation using the angle weighted
        pseudonormal, IEEE Trans. Vis. Comput. Graph. 11 (2005).
    """

    vertices: Float[Array, "vertices 3"] = eqx.field(converter=real)
    faces: Int[Array, "faces 3"] = eqx.field(converter=integers)
    tree: TriangleTree | None

    def __init__(self, vertices, faces, *, lists: bool = False):
        self.vertices, self.faces = real(vertices), integers(faces)
        _check_mesh(self.vertices, self.faces)
        self.tree = None
        if not is_traced((self.vertices, self.faces)):
            held = np.asarray(self.vertices), np.asarray(self.faces)
            self.tree = triangle_tree(*held, lists)
        if self.tree is None and self.faces.shape[0] > MOST_FACES:
            raise ValueError(
                f"TriangleMesh: got {self.faces.shape[0]} faces that leave gaps, need at "
                f"most {MOST_FACES} unless every edge joins two. Repair or decimate the mesh."
            )

    def distance(self, x, y, z):
        p = tuple(c.reshape(-1) for c in jnp.broadcast_arrays(x, y, z))
        corners = tuple(self.vertices[self.faces[:, i]] for i in range(3))
        if self.tree is None:
            index, inside = _every_face(corners, p)
        else:
            held, at = jax.lax.stop_gradient((self.vertices, p))
            index = self.tree.nearest(held, self.faces, at)
            inside = self.tree.inside(held, self.faces, index, at)
        # Over a face its plane gives the distance; the sign stays as found.
        side = triangle_side(p, *take(corners, index), inside)
        found = jax.lax.stop_gradient(side)
        outward = jnp.where(found < 0, inside, ~inside)
        # On the surface rounding decides the sign, but not which way the faces look.
        a, b, c = jax.lax.stop_gradient(corners)
        tiny = _ON_SURFACE * float(jnp.finfo(found.dtype).eps) * jnp.max(absolute(a))
        looks_out = jnp.sum(a * jnp.cross(b, c)) > 0
        outward = jnp.where(absolute(found) <= tiny, looks_out, outward)
        return jnp.where(outward, side, -side).reshape(x.shape)

    def bounding_box(self) -> Bounds:
        used = self.vertices[self.faces.reshape(-1)]
        return jnp.min(used, axis=0), jnp.max(used, axis=0)


def _every_face(corners: tuple, p: Vector) -> tuple[Array, Array]:
    """The nearest of all triangles, and whether the winding number is that of inside."""

    def square(row, *p):
        return triangle_square(p, *(tuple(a) for a in row))

    def turn(row, *p):
        return solid_angle(p, *(tuple(a) for a in row))

    index, turns = scan_rows(square, corners, p, turn)
    return index, absolute(turns) > 2 * np.pi


def _check_mesh(vertices: Array, faces: Array) -> None:
    _check.shape("TriangleMesh", "vertices", vertices, (None, 3), "One row each.")
    _check.shape("TriangleMesh", "faces", faces, (None, 3), "Give triangles.")
    if faces.shape[0] < 4:
        raise ValueError(
            f"TriangleMesh: got {faces.shape[0]} faces, need at least 4. Give a closed mesh."
        )
    if _check.is_concrete(faces):
        low, high = int(jnp.min(faces)), int(jnp.max(faces))
        if low < 0 or high >= vertices.shape[0]:
            raise ValueError(
                f"TriangleMesh: `faces` names vertices {low} to {high}, need 0 to "
                f"{vertices.shape[0] - 1}. Number them from zero."
            )
