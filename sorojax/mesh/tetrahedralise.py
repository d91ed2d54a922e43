"""From a solid shape to conforming tetrahedra, without a surface in between."""

import numpy as np

from sorojax import _check
from sorojax._types import real
from sorojax.mesh.elements import Tet4, Tet10
from sorojax.mesh.lattice import clip, lattice, snap
from sorojax.mesh.mesh import Mesh, boundary_facets
from sorojax.mesh.resolved import check_resolved
from sorojax.mesh.shape import nodes as reference_nodes, quadrature, shape_gradients
from sorojax.mesh.tets import badness, improve, signed_volumes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import finite_box, land, raise_empty

_ENOUGH = np.deg2rad(22.0)  # dihedral angle above which a cell is left alone
_POOR = np.deg2rad(5.0)  # below which a wall is thinner than the lattice can follow


def tetrahedralise(
    shape: AbstractSdf, *, size: float, order: int = 1, rounds: int = 12
) -> Mesh:
    """Tetrahedra that fill a solid shape.

    A body-centred cubic lattice is snapped to the surface and cut by it, then nodes of
    the worst cells are moved. Boundary nodes lie on the zero set; sharp edges are
    chamfered within one cell. Facet set: "boundary".

    Args:
        shape: A concrete, bounded solid shape.
        size: Pitch of the cubes of the lattice [m]; edges are 0.87 to 1 of it.
        order: 1 for `Tet4`, 2 for `Tet10` with mid-sides of the surface on the zero set
            wherever the cells stay valid.
        rounds: Smoothing steps on the worst cells.

    Raises:
        ValueError: If the shape is empty, unbounded, traced, or has walls thinner than
            `size` can follow.
    """
    where = "tetrahedralise"
    if order not in (1, 2):
        raise ValueError(f"{where}: `order` is {order}, need 1 (Tet4) or 2 (Tet10).")
    _check.positive(where, "size", size, "m", "Give the wanted length of an edge.")
    _check.float64(where, real(0.0))
    lower, upper = finite_box(where, shape, 3)
    points, f, cells = lattice(shape, lower, upper, float(size))
    if not np.all(np.isfinite(f)):
        raise ValueError(
            f"{where}: the field is not finite at {points[~np.isfinite(f)][0]} m. Check "
            "the parameters of the shape for NaN."
        )
    if not len(cells):
        raise_empty(where, lower, upper, float(size))
    f = np.where(f == 0, -1e-9 * size, f)
    points, f = snap(shape, points, f, cells, float(size))
    points, cells, skin = clip(shape, points, f, cells)
    cells = _upright(points, cells, float(size))
    points, cells, skin = _compact(points, cells, skin)
    if not len(cells):
        raise_empty(where, lower, upper, float(size))
    points[skin] = land(shape, points[skin], 3)
    points = improve(shape, points, cells, skin, float(size), rounds, _ENOUGH)
    _check_shapes(points, cells)
    check_resolved(where, shape, points[skin], float(size), lower, upper)
    if order == 2:
        return _curved(shape, points, cells)
    return _named(Mesh(points, cells, Tet4()))


def _named(mesh: Mesh) -> Mesh:
    sets = {"boundary": boundary_facets(mesh)}
    return Mesh(mesh.points, mesh.cells, mesh.element, {}, sets)


def _compact(points, cells, skin):
    used, number = np.unique(cells, return_inverse=True)
    return points[used], number.reshape(cells.shape), skin[used]


def _upright(points, cells, size: float) -> np.ndarray:
    volume = signed_volumes(points[cells])
    cells = np.where((volume < 0)[:, None], cells[:, [0, 1, 3, 2]], cells)
    return cells[np.abs(volume) > 1e-9 * size**3]


def _check_shapes(points, cells) -> None:
    bad = badness(points[cells])
    if bad.max() > np.cos(_POOR):
        where = points[cells[bad.argmax()]].mean(axis=0)
        raise ValueError(
            f"tetrahedralise: a cell near {where} m has a dihedral angle of less than "
            f"{np.rad2deg(_POOR):.0f} degrees: the shape is thinner there than `size` can "
            "follow. Lower `size` to the thinnest wall, or thicken it."
        )


def _curved(shape: AbstractSdf, points, cells) -> Mesh:
    """Ten-node cells; mid-sides of the surface on it where all their cells stay valid."""
    corners = [facet[:2] for facet in ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))]
    ends = np.concatenate([cells[:, list(c)] for c in corners])
    n = len(points)
    keys, number = np.unique(
        ends.min(axis=1) * np.int64(n) + ends.max(axis=1), return_inverse=True
    )
    sides = np.stack(np.divmod(keys, n), axis=1)
    straight = points[sides].mean(axis=1)
    ten = np.concatenate([cells, n + number.reshape(6, -1).T], axis=1)
    mesh = Mesh(np.concatenate([points, straight]), ten, Tet10())
    surface = np.unique(boundary_facets(mesh)[:, 3:]) - n
    middles = straight.copy()
    middles[surface] = land(shape, straight[surface])
    for _ in range(20):
        x = np.concatenate([points, middles])
        folded = np.unique(ten[_least_jacobian(x[ten]) < 0.1, 4:]) - n
        if not len(folded):
            break
        middles[folded] = straight[folded]
    return _named(Mesh(np.concatenate([points, middles]), ten, Tet10()))


def _least_jacobian(x: np.ndarray) -> np.ndarray:
    """Least det dx/dxi at the nodes and inside, over that of the straight cell."""
    at = np.concatenate([reference_nodes(Tet10()), quadrature(Tet10(), 5).points])
    straight = 6 * signed_volumes(x[:, :4])
    least = np.full(len(x), np.inf)
    for slopes in shape_gradients(Tet10(), at):
        least = np.minimum(least, np.linalg.det(np.einsum("cai,ad->cid", x, slopes)))
    return least / straight
