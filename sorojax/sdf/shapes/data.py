"""Shapes from data: outlines and text, solids with triangular faces, images, distances on a
grid and height maps.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax import _check
from sorojax._jax.trace_state import is_traced
from sorojax._types import Numbers, integers, real
from sorojax.sdf.base import (
    AbstractByLevel,
    Box,
    Box as Bounds,
    Number,
    absolute,
    clip,
    maximum,
    minimum,
    norm,
    number,
    ordered,
    positive,
    segment_side,
    steepest,
)
from sorojax.sdf.shapes.bars import segment_square
from sorojax.sdf.shapes.curves import scan_rows, take
from sorojax.sdf.shapes.plane import AbstractPlaneShape, touching_edges
from sorojax.sdf.shapes.solid import AbstractSolidShape, centred
from sorojax.sdf.trimesh.cells import Vector, solid_angle, triangle_side, triangle_square
from sorojax.sdf.trimesh.tree import TriangleTree, triangle_tree

_SIZE = 64.0
_ON_SURFACE = 16  # of rounding: points that near to the surface are on it


class Outlines(AbstractPlaneShape):
    """Region between closed outlines: one within another is a hole, by the even-odd rule.

    Outline k takes the rows of `vertices` [m] from entry k of `starts` to the next; outlines
    may not touch. A gradient costs one edge, however many there are.
    """

    vertices: Float[Array, "corners 2"] = eqx.field(converter=real)
    starts: tuple[int, ...] = eqx.field(static=True)

    def __check_init__(self):
        _check.shape("Outlines", "vertices", self.vertices, (None, 2), "One row per corner.")
        lengths = np.diff([*self.starts, self.vertices.shape[0]])
        if not self.starts or self.starts[0] != 0 or lengths.min() < 3:
            raise ValueError(
                f"Outlines: `starts` is {self.starts} for {self.vertices.shape[0]} corners, "
                "need outlines of at least 3 corners from row 0. Use `outlines` to join loops."
            )

    def distance(self, x, y):
        table = self._edges()
        square, cross = lambda row, *x: segment_square(x, *row), _crossing
        index, crossings = scan_rows(square, table, (x, y), cross)
        inside = jnp.round(crossings) % 2 == 1
        side = segment_side(x, y, *take(table, index))
        found, corners = jax.lax.stop_gradient((side, self.vertices))
        outward = jnp.where(found < 0, inside, ~inside)
        # On an edge rounding decides the sign, but not on which side the inside lies.
        tiny = _ON_SURFACE * float(jnp.finfo(found.dtype).eps) * jnp.max(absolute(corners))
        outward = jnp.where(absolute(found) <= tiny, ~self._inside_on_left()[index], outward)
        return jnp.where(outward, side, -side)

    def _edges(self) -> tuple[Array, Array]:
        """Corners (corners, 2) at which edges begin and end."""
        following = np.arange(1, self.vertices.shape[0] + 1)
        following[np.array([*self.starts[1:], len(following)]) - 1] = self.starts
        return self.vertices, self.vertices[following]

    def _inside_on_left(self) -> Bool[Array, " corners"]:
        """Whether the inside lies on the left of each edge: by the sense of its outline, and
        how many others that is within."""
        a, b = jax.lax.stop_gradient(self._edges())
        count = len(self.starts)
        owner = np.repeat(np.arange(count), np.diff([*self.starts, len(a)]))
        area = jnp.zeros(count, a.dtype).at[owner].add(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        firsts = a[np.array(self.starts)].T[:, None]
        crossed = _crossing((a.T[..., None], b.T[..., None]), *firsts)
        around = jnp.sum(jnp.where(owner[:, None] == np.arange(count), 0, crossed), axis=0)
        return ((area > 0) == (jnp.round(around) % 2 == 0))[owner]

    def bounding_box(self) -> Box:
        return jnp.min(self.vertices, axis=0), jnp.max(self.vertices, axis=0)


def _crossing(row: tuple[Array, Array], x: Array, y: Array) -> Array:
    """One where the ray to the right of a point crosses the edge, zero elsewhere."""
    (ax, ay), (bx, by) = row
    right = (bx - ax) * (y - ay) - (x - ax) * (by - ay)
    right = jnp.where(by > ay, right, -right) > 0
    return (((ay > y) != (by > y)) & right).astype(x.dtype)


def outlines(loops: Sequence[Numbers]) -> Outlines:
    """The region between closed `loops`, each an array of corners (n, 2) [m].

    Args:
        loops: Corners of each loop [m].

    Returns:
        The region.
    """
    loops = [real(loop) for loop in loops]
    if not loops:
        raise ValueError("outlines: got no loop, need at least one. Give arrays of corners.")
    for i, loop in enumerate(loops):
        edges = touching_edges(np.asarray(loop)) if _check.is_concrete(loop) else None
        if edges is not None:
            raise ValueError(
                f"outlines: edges {edges[0]} and {edges[1]} of loop {i} touch, need simple "
                "loops. Put its corners in order, or cut the loop in two."
            )
    starts = np.cumsum([0, *(loop.shape[0] for loop in loops[:-1])])
    return Outlines(jnp.concatenate(loops), tuple(int(i) for i in starts))


def text(line: str, height: Numbers, font: str = "DejaVu Sans") -> Outlines:
    """One `line` of text from the origin along x, as the polygons of its letters.

    Args:
        line: What to write.
        height: Size of the type, its em [m]; capitals are about 0.73 of it.
        font: Family of the font, as matplotlib finds it.

    Returns:
        The region of the letters.
    """
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    _check.positive("text", "height", height, "m", "Give the size of the type.")
    if not line.strip():
        raise ValueError(f"text: {line!r} has no outline, need letters. Write something.")
    # The size sets how finely matplotlib breaks curves into edges.
    path = TextPath((0, 0), line, size=_SIZE, prop=FontProperties(family=font))
    loops = [_thinned(loop) / _SIZE for loop in path.to_polygons(closed_only=True)]
    height = real(height)
    return outlines([height * jnp.asarray(loop, height.dtype) for loop in loops])


def _thinned(loop) -> np.ndarray:
    """Corners of a closed loop, without the repeated end and repeated points."""
    loop = np.asarray(loop, dtype=float)[:-1]
    apart = np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1) > 1e-9
    return loop[apart]


# Solids with triangular faces: octahedron, pyramid, any closed triangle mesh


MOST_FACES = 20_000
_MANY_FACES = 1000  # of a surface with gaps, from which searching all of them is felt


class Octahedron(AbstractSolidShape):
    """Regular octahedron with its corners on the axes at `radius` [m]."""

    radius: Float[Array, ""] = eqx.field(converter=positive)

    def distance(self, x, y, z):
        p = absolute(x), absolute(y), absolute(z)
        s, zero = self.radius, jnp.zeros_like(self.radius)
        corners = (s, zero, zero), (zero, s, zero), (zero, zero, s)
        return triangle_side(p, *corners, p[0] + p[1] + p[2] < s)

    def bounding_box(self) -> Bounds:
        return centred(self.radius, self.radius, self.radius)


class Pyramid(AbstractSolidShape):
    """Square pyramid: base of side `width` [m] at z = 0, tip at z = `height` [m]."""

    width: Float[Array, ""] = eqx.field(converter=positive)
    height: Float[Array, ""] = eqx.field(converter=positive)

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


class TriangleMesh(AbstractSolidShape):
    """Solid inside a closed triangle mesh, by the nearest of its triangles.

    `vertices` [m] are its points, `faces` their numbers, three each and all in one sense.
    `tree` is found from them: the boxes in which the nearest is searched, None for a mesh with
    gaps or one built under a trace.

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
        count = self.faces.shape[0]
        if self.tree is None and count > _MANY_FACES and not is_traced((vertices, faces)):
            _check.warn(
                f"TriangleMesh: got {count} faces that leave gaps, need a closed surface: each "
                "point now asks every face, and a mesh takes minutes instead of seconds. "
                "sdf.surface_report tells what is open, io.import_surface(..., weld=...) joins "
                "a seam."
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


# Shapes from arrays: images, distances on a grid, height maps


def interpolate(values: Array, place: tuple[Array, ...]) -> Array:
    """Multilinear interpolation of `values` at `place` in cells, held at the edges."""
    corner, part = [], []
    for axis, c in enumerate(place):
        last = values.shape[axis] - 1
        low = jnp.clip(jnp.floor(jax.lax.stop_gradient(c)), 0, max(last - 1, 0))
        corner.append(low.astype(jnp.int32))
        part.append(clip(c, 0.0, float(last)) - low)
    total = jnp.zeros_like(place[0])
    for offset in itertools.product((0, 1), repeat=len(place)):
        weight = functools.reduce(
            lambda a, b: a * b, (p if o else 1 - p for o, p in zip(offset, part, strict=True))
        )
        index = tuple(i + o for i, o in zip(corner, offset, strict=True))
        total = total + weight * values[index]
    return total


class Sampled(AbstractByLevel):
    """Distances `values` [m] on a grid, interpolated linearly; `origin` [m] is node (0, 0), and
    nodes are `spacing` [m] apart along every axis.

    Beyond the grid the distance to it is added.
    """

    values: Float[Array, "*nodes"] = eqx.field(converter=real)
    origin: Float[Array, " dim"] = eqx.field(converter=real)
    spacing: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        size = jnp.shape(self.values)
        if len(size) not in (2, 3) or min(size) < 2:
            raise ValueError(
                f"Sampled: `values` has shape {size}, need a 2-D or 3-D grid with at least 2 "
                "nodes per axis. Index it by x first."
            )
        _check.shape("Sampled", "origin", self.origin, (len(size),), "One per axis.")
        _check.positive("Sampled", "spacing", self.spacing, "m", "Give the node distance.")

    @property
    def dim(self) -> int:
        return self.values.ndim

    @property
    def lipschitz(self) -> Number:
        steps = [
            jnp.max(jnp.abs(jnp.diff(self.values, axis=i))) / self.spacing
            for i in range(self.dim)
        ]
        steepness = jnp.sqrt(sum((s * s for s in steps), start=jnp.zeros_like(self.spacing)))
        # Beyond a corner of the grid only the distance to it varies.
        return number(jnp.sqrt(1 + steepness**2))

    def distance(self, *x):
        place = tuple((c - self.origin[i]) / self.spacing for i, c in enumerate(x))
        last = [float(n - 1) for n in jnp.shape(self.values)]
        held = (clip(c, 0.0, end) for c, end in zip(place, last, strict=True))
        beyond = norm(*(c - h for c, h in zip(place, held, strict=True)))
        return interpolate(self.values, place) + self.spacing * beyond

    def level_box(self, level) -> Box:
        last = jnp.asarray(np.array(self.values.shape) - 1.0, self.origin.dtype)
        # Shapes that run over the edge of the grid go on beyond it.
        edges = [
            jnp.min(jnp.take(self.values, i, axis=axis))
            for axis in range(self.dim)
            for i in (0, -1)
        ]
        reach = jnp.maximum(level - functools.reduce(jnp.minimum, edges), 0)
        return self.origin - reach, self.origin + self.spacing * last + reach


def image(mask: Numbers, pixel: float, origin: Numbers | None = None) -> Sampled:
    """The shape of the true pixels (or voxels) of `mask`, by Euclidean distance transform.

    Args:
        mask: Array of booleans, rows from bottom to top: index (row, column) is (y, x) in
            the plane; volumes are indexed (x, y, z).
        pixel: Size of a pixel [m].
        origin: Centre of the first pixel [m].

    Returns:
        The shape, by its distances at the pixels.
    """
    from scipy.ndimage import distance_transform_edt

    mask = np.asarray(mask, dtype=bool)
    if mask.ndim not in (2, 3) or mask.all() or not mask.any():
        raise ValueError(
            f"image: got a mask of shape {mask.shape} with {int(mask.sum())} true pixels, need "
            "a 2-D or 3-D mask with both values. Choose another threshold."
        )
    mask = mask.T if mask.ndim == 2 else mask
    mask = np.pad(mask, 1)
    outside, inside = (np.asarray(distance_transform_edt(m)) for m in (~mask, mask))
    # Distances run from centre to centre: the boundary lies half a pixel before.
    field = np.where(mask, 0.5 - inside, outside - 0.5) * pixel
    start = np.zeros(mask.ndim) if origin is None else np.asarray(origin, dtype=float)
    return Sampled(field, start - pixel, pixel)


class HeightMap(AbstractByLevel):
    """Everything below the surface z = `heights` [m] over a grid, held at its edges.

    Node (0, 0) of the grid is at `origin` (x, y) [m], nodes are `spacing` [m] apart along x and
    y. The field is the height over the surface, with a Lipschitz constant above one.
    """

    heights: Float[Array, "x y"] = eqx.field(converter=real)
    origin: Float[Array, "2"] = eqx.field(converter=real)
    spacing: Float[Array, "2"] = eqx.field(converter=real)
    dim: ClassVar[int] = 3

    def __check_init__(self):
        _check.shape("HeightMap", "heights", self.heights, (None, None), "Index x first.")
        _check.shape("HeightMap", "origin", self.origin, (2,), "Give (x, y).")
        _check.shape("HeightMap", "spacing", self.spacing, (2,), "Give (x, y).")
        _check.positive("HeightMap", "spacing", self.spacing, "m", "Give node distances.")
        if min(self.heights.shape) < 2:
            raise ValueError(
                f"HeightMap: `heights` has shape {self.heights.shape}, need at least 2 nodes "
                "per axis. Use a HalfSpace for a level plane."
            )

    @property
    def lipschitz(self) -> Number:
        slopes = [
            jnp.max(jnp.abs(jnp.diff(self.heights, axis=i))) / self.spacing[i] for i in (0, 1)
        ]
        return steepest(number(jnp.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)), 1.0)

    def distance(self, x, y, z):
        place = tuple((c - self.origin[i]) / self.spacing[i] for i, c in enumerate((x, y)))
        return z - interpolate(self.heights, place)

    def level_box(self, level) -> Box:
        top = jnp.max(self.heights) + level
        infinity = jnp.full((3,), jnp.inf, top.dtype)
        return -infinity, infinity.at[2].set(top)
