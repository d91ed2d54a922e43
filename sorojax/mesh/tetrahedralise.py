"""From a solid shape to conforming tetrahedra, without a surface in between."""

import numpy as np

from sorojax import _check
from sorojax._types import real
from sorojax.mesh.bisect import graded
from sorojax.mesh.features import Features, sharpen
from sorojax.mesh.followed import movable
from sorojax.mesh.interfaces import Parts, insert, whole
from sorojax.mesh.lattice import clip, lattice, snap, touching
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.peel import peel
from sorojax.mesh.resolved import (
    NotResolved,
    check_resolved,
    check_walls,
    raise_if_thin,
    raise_thin,
)
from sorojax.mesh.ridge_snap import boundary_triangles
from sorojax.mesh.sizes import SizeFunction, Sizes, constant, sizes
from sorojax.mesh.tet10 import solid_mesh
from sorojax.mesh.tet_shape import badness, signed_volumes
from sorojax.mesh.tets import Surface, improve
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import EmptyShape, finite_box, land, raise_empty

_ENOUGH = np.deg2rad(22.0)  # dihedral angle above which a cell is left alone
_STRETCH = 1.5  # of the wanted length that an edge of a bisected cell may have
_FINER = (1.0, 0.93, 0.85, 0.7)  # of the wanted pitch: lattices that are tried
_POOR = np.deg2rad(5.0)  # below which a wall is thinner than the lattice can follow


def tetrahedralise(
    shape: AbstractSdf,
    *,
    size: float | SizeFunction,
    order: int = 1,
    interfaces: tuple[AbstractSdf, ...] = (),
    rounds: int = 12,
) -> Mesh:
    """Tetrahedra that fill a solid shape.

    A body-centred cubic lattice is snapped to the surface and cut by it, nodes are put on
    sharp edges and corners, then nodes of the worst cells are moved. Boundary nodes lie on
    the zero set; a sharp edge is chamfered within one cell where cells would degenerate.
    Facet sets: "boundary" and "interface_0", ...; node sets: "ridges" and "corners" of
    sharp edges, and "interface_0", ...; regions: "inside_0", ... of the cells within each
    interface.

    Args:
        shape: A concrete, bounded solid shape.
        size: Pitch of the cubes of the lattice [m]; edges are 0.87 to 1 of it. Where no wall
            is thin and cells get too flat all the same, a finer lattice is tried, down to
            0.7 of it. A function of points (n, 3) that returns one length per point, such as
            `grade(...)`, halves the edges of the lattice where it is small.
        order: 1 for `Tet4`, 2 for `Tet10` with mid-sides of the surface on the zero set
            wherever the cells stay valid.
        interfaces: Shapes whose zero sets become facets of the mesh inside `shape`.
        rounds: Smoothing steps on the worst cells.

    Raises:
        ValueError: If the shape is empty, unbounded, traced, or has walls thinner than
            `size` can follow; if an interface misses the shape.
    """
    where = "tetrahedralise"
    if order not in (1, 2):
        raise ValueError(f"{where}: `order` is {order}, need 1 (Tet4) or 2 (Tet10).")
    _check.float64(where, real(0.0))
    lower, upper = finite_box(where, shape, 3)
    lengths = _lengths(where, size, lower, upper)
    for finer in _FINER:
        try:
            return _meshed(
                (shape, *interfaces), lower, upper, lengths.scaled(finer), order, rounds
            )
        except (EmptyShape, NotResolved) as found:
            # another lattice may do, unless a thin wall is the reason
            if finer > _FINER[-1] and not getattr(found, "thin", False):
                continue
            if isinstance(found, EmptyShape):
                raise_if_thin(where, shape, lower, upper, lengths)
            raise
    raise AssertionError("unreachable")


def _meshed(fields, lower, upper, lengths: Sizes, order: int, rounds: int) -> Mesh:
    where, (shape, *interfaces) = "tetrahedralise", fields
    points, f, cells = _background(where, shape, lower, upper, lengths)
    regular = lengths.largest if lengths.largest == lengths.smallest else None
    points, f = snap(shape, points, f, cells, regular)
    points, cells, skin = clip(shape, points, f, cells)
    cells = _upright(points, cells, lengths)
    points, cells, skin = _compact(points, cells, skin)
    if not len(cells):
        raise_empty(where, lower, upper, lengths.largest)
    points[skin] = land(shape, points[skin], 3)
    points, cells, skin, features = sharpen(shape, points, cells, skin, lengths)
    cells = peel(points, cells, skin, _POOR)
    points, features = _improved(shape, points, cells, skin, features, rounds)
    widest = lengths if regular else lengths.scaled(_STRETCH)
    check_resolved(where, shape, points[skin], widest, lower, upper)
    check_walls(where, shape, points, boundary_triangles(cells), lengths)
    parts = _divided(fields, whole(points, cells, skin, features), rounds)
    _check_shapes(fields, parts.points, parts.cells, lengths)
    mesh = solid_mesh(fields, parts, order)
    if parts.features.ridge.any() or interfaces:
        mesh = movable(where, fields, mesh, lengths)
    return mesh


def _divided(fields: tuple[AbstractSdf, ...], parts: Parts, rounds: int) -> Parts:
    """`parts` with the zero sets of all fields but the first among its facets."""
    for count in range(2, len(fields) + 1):
        parts = insert(fields[:count], parts)
        surface = Surface(fields[:count], parts.owner, parts.features)
        points = improve(surface, parts.points, parts.cells, 2 * rounds, _ENOUGH)
        parts = parts._replace(points=points)
    return parts


def _lengths(where: str, size: float | SizeFunction, lower, upper) -> Sizes:
    if callable(size):
        return sizes(where, size, lower, upper)
    _check.positive(where, "size", size, "m", "Give the wanted length of an edge.")
    return constant(float(size))


def _background(where: str, shape: AbstractSdf, lower, upper, lengths: Sizes):
    """Nodes of the lattice, their field [m] (nowhere zero), and its tetrahedra."""
    pitch = lengths.largest
    found = lattice(shape, lower, upper, pitch)
    points, cells = found.start + pitch * found.at, found.cells
    if lengths.smallest < pitch:
        points, cells = graded(shape, found, pitch, lengths)
    f, cells = touching(shape, points, cells, 1e-9 * lengths.smallest)
    if not np.all(np.isfinite(f)):
        raise ValueError(
            f"{where}: the field is not finite at {points[~np.isfinite(f)][0]} m. Check "
            "the parameters of the shape for NaN."
        )
    if not len(cells):
        raise_empty(where, lower, upper, pitch)
    return points, f, cells


def _improved(shape: AbstractSdf, points, cells, skin, features: Features, rounds: int):
    """Better cells; ridges are given up where they leave a cell too poor."""
    for _ in range(3):
        surface = Surface((shape,), np.where(skin, 0, -1), features)
        points = improve(surface, points, cells, rounds, _ENOUGH)
        poor = np.unique(cells[badness(points[cells]) > np.cos(_POOR)])
        poor = poor[features.ridge[poor]]
        if not len(poor):
            break
        points[poor] = features.before[poor]
        features = features.without(poor)
    return points, features


def _compact(points, cells, skin):
    used, number = np.unique(cells, return_inverse=True)
    return points[used], number.reshape(cells.shape), skin[used]


def _upright(points, cells, lengths: Sizes) -> np.ndarray:
    volume = signed_volumes(points[cells])
    cells = np.where((volume < 0)[:, None], cells[:, [0, 1, 3, 2]], cells)
    return cells[np.abs(volume) > 1e-9 * lengths(points[cells[:, 0]]) ** 3]


def _check_shapes(fields, points, cells, lengths: Sizes) -> None:
    bad = badness(points[cells])
    poor = np.flatnonzero(bad > np.cos(_POOR))
    if len(poor):
        raise_thin("tetrahedralise", fields, points[cells[poor]].mean(axis=1), lengths)
