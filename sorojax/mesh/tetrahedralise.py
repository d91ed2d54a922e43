"""From a solid shape to conforming tetrahedra, without a surface in between."""

import numpy as np

from sorojax import _check
from sorojax._types import real
from sorojax.mesh.elements import Tet4
from sorojax.mesh.features import Features, sharpen
from sorojax.mesh.lattice import clip, lattice, snap
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.peel import peel
from sorojax.mesh.resolved import check_resolved
from sorojax.mesh.tet10 import curved, named
from sorojax.mesh.tet_shape import badness, signed_volumes
from sorojax.mesh.tets import Surface, improve
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import finite_box, land, raise_empty

_ENOUGH = np.deg2rad(22.0)  # dihedral angle above which a cell is left alone
_POOR = np.deg2rad(5.0)  # below which a wall is thinner than the lattice can follow


def tetrahedralise(
    shape: AbstractSdf, *, size: float, order: int = 1, rounds: int = 12
) -> Mesh:
    """Tetrahedra that fill a solid shape.

    A body-centred cubic lattice is snapped to the surface and cut by it, nodes are put on
    sharp edges and corners, then nodes of the worst cells are moved. Boundary nodes lie on
    the zero set; a sharp edge is chamfered within one cell where cells would degenerate.
    Facet set: "boundary"; node sets: "ridges" and "corners" of sharp edges.

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
    points, cells, skin, features = sharpen(shape, points, cells, skin, float(size))
    cells = peel(points, cells, skin, _POOR)
    points, features = _improved(shape, points, cells, skin, features, rounds)
    _check_shapes(points, cells)
    check_resolved(where, shape, points[skin], float(size), lower, upper)
    if order == 2:
        return curved(shape, points, cells, features)
    return named(Mesh(points, cells, Tet4()), features)


def _improved(shape: AbstractSdf, points, cells, skin, features: Features, rounds: int):
    """Better cells; ridges are given up where they leave a cell too poor."""
    for _ in range(3):
        points = improve(Surface((shape,), skin, features), points, cells, rounds, _ENOUGH)
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
