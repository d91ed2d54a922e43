"""Conforming tetrahedra of a solid shape, linear or with ten nodes, and the named sets of the
mesh. No surface mesh is made in between.
"""

from typing import NamedTuple

import numpy as np

from sorojax import _check
from sorojax._types import real
from sorojax.mesh.elements.base import nodes as reference_nodes, quadrature, shape_gradients
from sorojax.mesh.elements.simplex import Tet4, Tet10
from sorojax.mesh.mesh import Mesh, boundary_facets, nodes_between, with_side_nodes
from sorojax.mesh.motion.boundary import SETTLE_ZOOMS as ZOOMS, Sides, normals_near, settle
from sorojax.mesh.motion.move import movable
from sorojax.mesh.motion.plan import surface_sides
from sorojax.mesh.plane.delaunay import Mover, relocate
from sorojax.mesh.resolution import (
    NotResolved,
    check_resolved,
    check_walls,
    raise_if_thin,
    raise_thin,
)
from sorojax.mesh.sizes import SizeFunction, Sizes, constant, sizes
from sorojax.mesh.solid.interfaces import Parts, insert, whole
from sorojax.mesh.solid.lattice import (
    FACES,
    badness,
    clip,
    dihedral_cosines,
    graded,
    lattice,
    signed_volumes,
    snap,
    touching,
)
from sorojax.mesh.solid.ridges import Features, boundary_triangles, sharpen
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import (
    EmptyShape,
    finite_box,
    land,
    raise_empty,
    values,
    values_and_gradients,
)

# Flat tetrahedra at the surface taken away, as an exchange of a diagonal of the surface.


_FLAT = np.cos(np.deg2rad(178.0))  # cosine of the angle between two faces that are one plane


def peel(points, cells, skin: np.ndarray, poor: float, rounds: int = 4) -> np.ndarray:
    """`cells` without those of nodes on the surface alone that are flatter than `poor`
    [rad], where two of their faces are on the surface and lie in one plane."""
    for _ in range(rounds):
        poorest = np.abs(dihedral_cosines(points[cells])).max(axis=1) > np.cos(poor)
        flat = np.flatnonzero(skin[cells].all(axis=1) & poorest)
        if not len(flat):
            return cells
        gone = _removable(points, cells, flat)
        if not len(gone):
            return cells
        cells = np.delete(cells, gone, axis=0)
    return cells


def _removable(points, cells, flat) -> list[int]:
    faces = np.sort(np.concatenate([cells[:, list(f)] for f in FACES]), axis=1)
    rows = np.unique(faces, axis=0, return_inverse=True)[1].ravel()
    single = (np.bincount(rows) == 1)[rows].reshape(4, -1).T
    outer = np.sort(faces[single.T.ravel()], axis=1)
    sides = {tuple(s) for k in ([0, 1], [1, 2], [0, 2]) for s in outer[:, k].tolist()}
    gone, touched = [], set()
    for cell in flat:
        corners, free = cells[cell], np.flatnonzero(single[cell])
        if len(free) != 2 or touched & set(corners.tolist()):
            continue
        # The new side joins the corners opposite to the two faces.
        new = tuple(sorted(corners[free].tolist()))
        normals = [_normal(points[corners[list(FACES[k])]]) for k in free]
        if new in sides or normals[0] @ normals[1] < -_FLAT:
            continue
        gone.append(int(cell))
        touched |= set(corners.tolist())
    return gone


def _normal(x: np.ndarray) -> np.ndarray:
    n = np.cross(x[1] - x[0], x[2] - x[0])
    return n / max(float(np.linalg.norm(n)), 1e-300)


# Better places for the nodes of the worst tetrahedra


_SAME_SIDE = 0.8  # least cosine between normals before and after: nodes cross no ridge
_LANDED = 1 - 1e-6  # cosine between the slopes before and after a landing beside a ridge
_ABREAST = (0.1, 0.01, 1e-3, 1e-4)  # zooms for nodes that are near their ridge already


class Surface(NamedTuple):
    """The surfaces that hold nodes: fields, which one a smooth node lies on (or -1), and
    nodes on several sides."""

    fields: tuple[AbstractSdf, ...]
    owner: np.ndarray
    features: Features


def improve(surface: Surface, points, cells, rounds: int, enough: float) -> np.ndarray:
    """`points` with the nodes of cells worse than `enough` [rad] moved where that helps:
    nodes of the surface on it, those of ridges on both sides, corners not at all."""
    features = surface.features

    def rank(worst, random):
        return worst + 0.2 * random

    def hold(places, movers, reach, row, ball) -> None:
        ridge, beside = features.ridge[movers], np.zeros(len(movers), bool)
        np.logical_or.at(beside, row, features.ridge[ball].any(axis=1))
        for i, field in enumerate(surface.fields):
            _hold_on_skin(field, places, (surface.owner[movers] == i) & ~ridge, beside)
        _hold_on_ridges(surface, places, movers, ridge, reach[:, 0])

    axes = np.concatenate([np.eye(3), -np.eye(3)])
    mover = Mover("tetrahedralise", badness, np.cos(enough), rank, axes, (0.08, 0.2))
    return relocate(mover, points, cells, features.corner, rounds, hold)


def _hold_on_skin(shape: AbstractSdf, places, on: np.ndarray, beside: np.ndarray) -> None:
    if not on.any():
        return
    moved, tries = places[:, on].reshape(-1, 3), len(places)
    normals = []
    for _ in range(3):
        f, g = values_and_gradients(shape, moved)
        square = np.maximum((g * g).sum(axis=1), 1e-12)
        moved = moved - (f / square)[:, None] * g
        normals.append((g / np.sqrt(square)[:, None]).reshape(tries, -1, 3))
    moved, last = moved.reshape(tries, -1, 3), normals[-1]
    crossed = (last * last[0]).sum(axis=2) < _SAME_SIDE
    # What lands on the ridge itself came from where the slope is that of neither side.
    crossed |= beside[on] & ((last * normals[0]).sum(axis=2) < _LANDED)
    places[1:, on] = np.where(crossed[..., None], places[0, on], moved)[1:]


def _hold_on_ridges(surface: Surface, places, movers, on: np.ndarray, reach) -> None:
    if not on.any():
        return
    tries, count = len(places) - 1, int(on.sum())
    sides = surface.features.sides.of(movers[on], len(surface.owner))
    shift = (np.arange(tries) * count)[:, None]
    all_sides = sides._replace(
        point=(sides.point + shift).ravel(),
        field=np.tile(sides.field, tries),
        along=np.tile(sides.along, (tries, 1)),
    )
    here = places[0, on]
    normals = normals_near(surface.fields, here, sides, 0.1)[0]
    order = np.argsort(sides.point, kind="stable").reshape(count, 2)
    tangent = np.cross(normals[order[:, 0]], normals[order[:, 1]])
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    # Only along the ridge, or both sides would see the same one.
    step = ((places[1:, on] - here) * tangent).sum(axis=2, keepdims=True) * tangent
    start = (here + step).reshape(-1, 3)
    moved = settle(surface.fields, start, all_sides, _ABREAST).reshape(tries, count, 3)
    far = np.linalg.norm(moved - here, axis=2) > 0.5 * reach[on]
    flat = moved.reshape(-1, 3)
    for i in np.unique(sides.field):
        off = np.abs(values(surface.fields[i], flat)).reshape(tries, count)
        off[:, np.setdiff1d(np.arange(count), sides.point[sides.field == i])] = 0.0
        far |= off > 1e-4 * reach[on]
    places[1:, on] = np.where(far[..., None], here, moved)


# Ten-node tetrahedra on a shape, and the named sets of a solid mesh.


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
    sides = [np.stack([own, np.roll(own, -1, axis=1)], axis=-1) for own in facets]
    middles = [nodes_between(ten, Tet10(), ends) for ends in sides]
    six = [np.concatenate(both, axis=1) for both in zip(facets, middles, strict=True)]
    x = straight.copy()
    for field, own in zip(fields[::-1], six[::-1], strict=True):
        surface = np.unique(own[:, 3:])
        x[surface] = land(field, straight[surface])
    every, owner = np.concatenate(six), np.repeat(np.arange(len(six)), list(map(len, six)))
    rim, beside, on_ridge = _rims(straight, every, owner, ridge)
    if len(rim):
        x[rim] = settle(fields, straight[rim], beside, (1.0, *ZOOMS))
    for _ in range(20):
        folded = np.unique(ten[_least_jacobian(x[ten]) < _LEAST, 4:])
        if not len(folded):
            break
        x[folded] = straight[folded]
    return x, ten, six, rim[on_ridge]


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
            if finer < 1 and isinstance(found, NotResolved):
                found.args = (f"{found} That is {finer:g} of the `size` given, the last try.",)
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
