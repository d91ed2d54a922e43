"""Conforming tetrahedra of a solid shape, linear or with ten nodes, and the named sets of the
mesh. No surface mesh is made in between.
"""

import numpy as np

from sorojax import _check
from sorojax._types import real
from sorojax.mesh.elements.elements import Tet4, Tet10
from sorojax.mesh.elements.shape_functions import (
    nodes as reference_nodes,
    quadrature,
    shape_gradients,
)
from sorojax.mesh.mesh import Mesh, boundary_facets, with_side_nodes
from sorojax.mesh.motion.boundary import SETTLE_ZOOMS as ZOOMS, Sides, settle
from sorojax.mesh.motion.move import movable
from sorojax.mesh.motion.plan import surface_sides
from sorojax.mesh.resolution import (
    NotResolved,
    check_resolved,
    check_walls,
    raise_if_thin,
    raise_thin,
)
from sorojax.mesh.sizes import SizeFunction, Sizes, constant, sizes
from sorojax.mesh.solid.improve import Surface, improve, peel
from sorojax.mesh.solid.interfaces import Parts, insert, whole
from sorojax.mesh.solid.lattice import (
    badness,
    clip,
    graded,
    lattice,
    signed_volumes,
    snap,
    touching,
)
from sorojax.mesh.solid.ridges import Features, boundary_triangles, sharpen
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import EmptyShape, finite_box, land, raise_empty

_SIDES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))  # of the mid-side nodes
_LEAST = 0.1  # least det dx/dxi over that of the straight cell


def solid_mesh(fields: tuple[AbstractSdf, ...], parts: Parts, order: int) -> Mesh:
    """The finished mesh with its boundary, ridges, corners and interfaces as sets."""
    features = parts.features
    ridge = np.zeros(len(parts.points), bool)
    on_body = features.sides.point[features.sides.field == 0]
    ridge[on_body[np.bincount(on_body, minlength=len(ridge))[on_body] > 1]] = True
    corner = features.corner
    nodes = {"corners": np.flatnonzero(corner), "ridges": np.flatnonzero(ridge & ~corner)}
    facets = [parts.facets(i) for i in range(len(fields))]
    points, cells, element = parts.points, parts.cells, Tet4()
    if order == 2:
        points, cells, facets, rim = _curved(fields, parts, facets, ridge | corner)
        nodes["ridges"] = np.union1d(nodes["ridges"], rim)
        element = Tet10()
    facets[0] = boundary_facets(Mesh(points, cells, element))
    sets = {"boundary": facets[0]}
    for i, own in enumerate(facets[1:]):
        sets[f"interface_{i}"] = own
        nodes[f"interface_{i}"] = np.unique(own)
    regions = {f"inside_{i}": np.flatnonzero(own) for i, own in enumerate(parts.within.T)}
    return Mesh(points, cells, element, nodes, sets, regions)


def _curved(fields, parts: Parts, facets, ridge):
    """Ten-node cells; mid-sides of the surfaces on them where all their cells stay valid."""
    straight, ten = with_side_nodes(parts.points, parts.cells, Tet10())
    n = len(parts.points)
    six = [_with_middles(own, ten, n, len(straight)) for own in facets]
    x = straight.copy()
    for field, own in zip(fields[::-1], six[::-1], strict=True):
        surface = np.unique(own[:, 3:])
        x[surface] = land(field, straight[surface])
    every, owner = np.concatenate(six), np.repeat(np.arange(len(six)), list(map(len, six)))
    rim, sides, on_ridge = _rims(straight, every, owner, ridge)
    if len(rim):
        x[rim] = settle(fields, straight[rim], sides, (1.0, *ZOOMS))
    for _ in range(20):
        folded = np.unique(ten[_least_jacobian(x[ten]) < _LEAST, 4:])
        if not len(folded):
            break
        x[folded] = straight[folded]
    return x, ten, six, rim[on_ridge]


def _with_middles(faces, ten, n: int, count: int) -> np.ndarray:
    """Triangles of corner nodes with the mid-side nodes of their sides."""
    sides = np.concatenate([ten[:, [a, b, 4 + k]] for k, (a, b) in enumerate(_SIDES)])
    keys = sides[:, :2].min(axis=1) * np.int64(count) + sides[:, :2].max(axis=1)
    order = np.argsort(keys)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)])
    wanted = ends.min(axis=0) * np.int64(count) + ends.max(axis=0)
    middles = sides[order, 2][np.searchsorted(keys[order], wanted)]
    return np.concatenate([faces, middles.reshape(-1, 3)], axis=1)


def _rims(x, facets, owner, ridge) -> tuple[np.ndarray, Sides, np.ndarray]:
    """Mid-side nodes of the sharp edges, the facets beside each as its sides, and which of
    the nodes lie on ridges of the body."""
    known = np.concatenate([ridge, np.zeros(len(x) - len(ridge), bool)])
    faces = facets[:, :3]
    found = surface_sides(x, faces, owner, known)
    row, corner = np.nonzero(found.sharp[found.number])
    node = facets[row, 3 + corner]
    rim, place = np.unique(node, return_inverse=True)
    along = x[faces[row]].mean(axis=1) - x[node]
    only_body = np.bincount(place, owner[row], len(rim)) == 0
    return rim, Sides(place, owner[row], along), only_body


def _least_jacobian(x: np.ndarray) -> np.ndarray:
    """Least det dx/dxi at the nodes and inside, over that of the straight cell."""
    at = np.concatenate([reference_nodes(Tet10()), quadrature(Tet10(), 5).points])
    straight = 6 * signed_volumes(x[:, :4])
    least = np.full(len(x), np.inf)
    for slopes in shape_gradients(Tet10(), at):
        least = np.minimum(least, np.linalg.det(np.einsum("cai,ad->cid", x, slopes)))
    return least / straight


# From a solid shape to conforming tetrahedra, without a surface in between


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

    A body-centred cubic lattice is snapped to the surface and cut by it (isosurface stuffing),
    nodes are put on sharp edges and corners, then nodes of the worst cells are moved. Boundary
    nodes lie on the zero set; a sharp edge is chamfered within one cell where cells would
    degenerate. Facet sets: "boundary" and "interface_0", ...; node sets: "ridges" and "corners"
    of sharp edges, and "interface_0", ...; regions: "inside_0", ... of the cells within each
    interface.

    Args:
        shape: A concrete, bounded solid shape.
        size: Pitch of the cubes of the lattice [m]; edges are 0.87 to 1 of it. Where no wall
            is thin and cells get too flat all the same, a finer lattice is tried, down to
            0.7 of it. A function of points (n, 3) that returns one length per point, such as
            `grade(...)`, halves the edges of the lattice where it is small.
        order: 1 for `Tet4`, 2 for `Tet10` with mid-side nodes of the surface on the zero set
            wherever the cells stay valid.
        interfaces: Shapes whose zero sets become facets of the mesh inside `shape`; none by
            default.
        rounds: Smoothing steps on the worst cells.

    Returns:
        The mesh, points [m].

    Raises:
        ValueError: If the shape is not solid, empty, unbounded, traced, or has walls thinner
            than `size` can follow; if an interface misses the shape.

    Example:
        >>> block = sdf.Box([0, 0, 0], [20 * mm, 10 * mm, 10 * mm])
        >>> cells = mesh.tetrahedralise(block, size=5 * mm)
        >>> print(f"{float(mesh.cell_volumes(cells).sum()) / mm**3:.1f} mm^3")
        2000.0 mm^3

    Reference:
        Labelle and Shewchuk, Isosurface stuffing: fast tetrahedral meshes with good dihedral
        angles, SIGGRAPH 2007.
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
