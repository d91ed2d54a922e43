"""How good the cells of a mesh are."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax._jax.jit import once
from sorojax.mesh.elements.base import AbstractElement, facet_corners
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.measure import cell_areas as cell_areas, cell_volumes
from sorojax.mesh.mesh import Mesh, boundary_facets, facet_table, valences
from sorojax.mesh.solid.lattice import dihedral_cosines, radius_ratios
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.measure.moments import area, volume

_WORST = 8  # cells that are named
_CUBE = ((1, 3, 4), (2, 0, 5), (3, 1, 6), (0, 2, 7), (7, 5, 0), (4, 6, 1), (5, 7, 2), (6, 4, 3))


class Quality(NamedTuple):
    """Numbers that tell a good mesh.

    Attributes:
        min_angle: Smallest angle between straight sides, in space between faces [rad].
        mean_radius_ratio: Mean over the cells of `dim` r_in / r_circ, 1 for equilateral
            ones. Other cells than triangles and tetrahedra: of 4 pi area over perimeter
            squared, 1 for regular polygons, or of the least scaled Jacobian (hexahedra).
        area: Area of all cells [m^2], curved sides included; in space their volume [m^3].
        num_nodes: Nodes.
        num_cells: Cells.
        max_angle: Largest angle [rad].
        histogram: Cells with a radius ratio in [0, 0.1), ..., [0.9, 1].
        watertight: Whether the boundary is closed and no facet has more than two cells.
        error: Relative error of `area` against the shape, if one was given.
        worst: Ids of up to eight cells of the least radius ratio, the poorest first.
        inverted: Ids of cells without positive area (volume).
    """

    min_angle: float
    mean_radius_ratio: float
    area: float
    num_nodes: int
    num_cells: int
    max_angle: float = np.nan
    histogram: tuple[int, ...] = ()
    watertight: bool = True
    error: float | None = None
    worst: tuple[int, ...] = ()
    inverted: tuple[int, ...] = ()

    def __str__(self) -> str:
        low, high = np.rad2deg(self.min_angle), np.rad2deg(self.max_angle)
        error = "" if self.error is None else f" (error {self.error:+.1e})"
        return (
            f"{self.num_cells} cells, {self.num_nodes} nodes, size {self.area:.6g} m^dim"
            f"{error}, angles {low:.1f} to {high:.1f} deg, mean radius ratio "
            f"{self.mean_radius_ratio:.3f}, {'' if self.watertight else 'NOT '}watertight\n"
            f"radius ratio per tenth: {' '.join(map(str, self.histogram))}, least in cells "
            f"{', '.join(map(str, self.worst))}"
            + (f"; inverted cells {', '.join(map(str, self.inverted))}" * bool(self.inverted))
        )

    __repr__ = __str__


def quality(mesh: Mesh, shape: AbstractSdf | None = None) -> Quality:
    """Shape numbers of a mesh, and its size against `shape` if given.

    Args:
        mesh: The mesh.
        shape: The shape.

    Returns:
        Angles and radius ratios of the cells, and what is wrong with any.
    """
    low, high, ratio = _angles_and_ratios(mesh)
    plane = mesh.element.dim == 2
    parts = np.asarray(cell_areas(mesh) if plane else cell_volumes(mesh))
    total, inverted = float(parts.sum()), np.flatnonzero(~(parts > 0))
    ratio = np.where(parts > 0, ratio, 0.0)
    error = None
    if shape is not None:
        error = total / float(area(shape) if plane else volume(shape)) - 1
    tenths = np.histogram(ratio, bins=10, range=(0, 1 + 1e-9))[0]
    return Quality(
        low,
        float(ratio.mean()),
        total,
        mesh.num_nodes,
        mesh.num_cells,
        high,
        tuple(tenths.tolist()),
        is_watertight(mesh),
        error,
        tuple(np.argsort(ratio, kind="stable")[:_WORST].tolist()),
        tuple(inverted.tolist()),
    )


def cell_ratios(mesh: Mesh) -> np.ndarray:
    """The number of each cell that `Quality.mean_radius_ratio` is the mean of; 0 where a cell
    has no positive area (volume)."""
    parts = cell_areas(mesh) if mesh.element.dim == 2 else cell_volumes(mesh)
    return np.where(np.asarray(parts) > 0, _angles_and_ratios(mesh)[2], 0.0)


def is_watertight(mesh: Mesh) -> bool:
    """Whether no facet has more than two cells and the boundary closes on itself."""
    if facet_table(mesh)[2].max(initial=0) > 2:
        return False
    count = facet_corners(mesh.element)
    corners = boundary_facets(mesh)[:, :count]
    if mesh.element.dim == 2:
        return bool((np.bincount(corners.ravel()) % 2 == 0).all())
    ends = np.concatenate([corners[:, [i, (i + 1) % count]] for i in range(count)])
    keys = ends.astype(np.int64) @ np.array([mesh.num_nodes, 1])
    back = ends.astype(np.int64) @ np.array([1, mesh.num_nodes])
    return bool(np.array_equal(np.sort(keys), np.sort(back)))


def _angles_and_ratios(mesh: Mesh) -> tuple[float, float, np.ndarray]:
    x = np.asarray(mesh.points)[np.asarray(mesh.cells)[:, : mesh.element.num_corners]]
    if mesh.element.dim == 3 and mesh.element.num_corners == 4:
        angle = np.arccos(np.clip(dihedral_cosines(x), -1, 1))
        return float(angle.min()), float(angle.max()), radius_ratios(x)
    if mesh.element.dim == 3:
        return _hexahedra(x)
    count, triangles = valences(mesh), mesh.element.num_corners == 3
    low, high, ratio = np.inf, 0.0, np.zeros(len(x))
    for n in np.unique(count):
        mine = count == n
        angle, ratio[mine] = _polygons(x[mine, :n], triangles)
        low, high = min(low, angle.min()), max(high, angle.max())
    return float(low), float(high), ratio


def _polygons(x: np.ndarray, triangles: bool) -> tuple[np.ndarray, np.ndarray]:
    """Angles at the corners, and how close to regular the polygons are."""
    out, back = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    turn = out[..., 0] * back[..., 1] - out[..., 1] * back[..., 0]
    angle = np.arctan2(turn, (out * back).sum(axis=2)) % (2 * np.pi)
    side = np.linalg.norm(out, axis=2)
    if triangles:
        a, b, c = side.T
        return angle, (b + c - a) * (c + a - b) * (a + b - c) / (a * b * c)
    y = np.roll(x, -1, axis=1)
    doubled = (x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]).sum(axis=1)
    regular = 4 * x.shape[1] * np.tan(np.pi / x.shape[1])
    return angle, regular * doubled / 2 / side.sum(axis=1) ** 2


def _hexahedra(x: np.ndarray) -> tuple[float, float, np.ndarray]:
    least, cosines = np.full(len(x), np.inf), []
    for corner, others in enumerate(_CUBE):
        edges = x[:, list(others)] - x[:, [corner]]
        edges /= np.linalg.norm(edges, axis=2, keepdims=True)
        least = np.minimum(least, np.linalg.det(edges))
        for i, j in ((0, 1), (1, 2), (2, 0)):
            n = np.cross(edges[:, i], edges[:, (3 - i - j)])
            m = np.cross(edges[:, i], edges[:, j])
            size = np.linalg.norm(n, axis=1) * np.linalg.norm(m, axis=1)
            cosines.append((n * m).sum(axis=1) / np.maximum(size, 1e-300))
    angle = np.arccos(np.clip(np.stack(cosines), -1, 1))
    return float(angle.min()), float(angle.max()), np.clip(least, 0, 1)


# How far motion has spoilt a mesh, and when to build a new one


_SIMPLICES = {
    3: ((0, 1, 2),),
    (2, 4): ((0, 1, 3), (1, 2, 0), (2, 3, 1), (3, 0, 2)),
    (3, 4): ((0, 1, 2, 3),),
    8: tuple((corner, *others) for corner, others in enumerate(_CUBE)),
}


class Distortion(NamedTuple):
    """Worst cell of a moved mesh.

    Attributes:
        size_ratio: Least area (volume) of a cell over that before; negative if inverted.
            Of quadrilaterals and hexahedra every corner counts.
        shape_ratio: Least shape number over that before; 1 where nothing changed.
        remesh: Whether a cell is smaller than 0.2 or poorer in shape than 0.4 of before.
    """

    size_ratio: Float[Array, ""]
    shape_ratio: Float[Array, ""]
    remesh: Bool[Array, ""]


def distortion(mesh: Mesh, moved: Mesh) -> Distortion:
    """Compare `moved` with `mesh`, of the same cells; may be traced.

    The shape number of a simplex is its size over that of an equilateral one with the
    same mean square edge.

    Args:
        mesh: The mesh.
        moved: Its cells with other points.

    Returns:
        Its worst cell, compared with the same cell of `mesh`.
    """
    if isinstance(mesh.element, PolyN):
        raise ValueError(
            f"distortion: got {mesh.element.name} cells, need triangles, quadrilaterals, "
            "tetrahedra or hexahedra. Build polygons anew with polymesher."
        )
    if mesh.cells.shape != moved.cells.shape:
        raise ValueError(
            f"distortion: the meshes have {mesh.num_cells} and {moved.num_cells} cells, need "
            "one mesh and the same mesh moved."
        )
    return _compared(mesh.element, mesh.points, mesh.cells, moved.points, moved.cells)


@once
def _compared(element: AbstractElement, points, cells, new_points, new_cells) -> Distortion:
    size, shape = _size_and_shape(element, points, cells)
    new_size, new_shape = _size_and_shape(element, new_points, new_cells)
    size_ratio, shape_ratio = jnp.min(new_size / size), jnp.min(new_shape / shape)
    return Distortion(size_ratio, shape_ratio, (size_ratio < 0.2) | (shape_ratio < 0.4))


def corner_simplices(element: AbstractElement) -> tuple[tuple[int, ...], ...]:
    """The simplex of the sides at each corner of a linear cell; one for a simplex."""
    n = element.num_corners
    return _SIMPLICES[n if n in _SIMPLICES else (element.dim, n)]


def least_corner(x: np.ndarray, element: AbstractElement) -> np.ndarray:
    """Least det dx/dxi at the corners `x` (cells, corners, dim) of linear cells."""
    sizes = [_size(x[:, list(s)], np) for s in corner_simplices(element)]
    return np.min(np.stack(sizes), axis=0)


def _size(x: Any, numpy: Any) -> Any:
    """Doubled area or sixfold volume of simplices with corners `x`."""
    a, b = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
    if x.shape[1] == 3:
        return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return numpy.sum(a * numpy.cross(b, x[:, 3] - x[:, 0]), axis=1)


def _size_and_shape(
    element: AbstractElement, points, cells
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    corners = points[cells[:, : element.num_corners]]
    sizes, shapes = [], []
    for simplex in corner_simplices(element.linear()):
        x = corners[:, jnp.asarray(simplex)]
        pairs = [(i, j) for i in range(len(simplex)) for j in range(i)]
        square = sum(jnp.sum((x[:, i] - x[:, j]) ** 2, axis=1) for i, j in pairs)
        size = _size(x, jnp)
        sizes.append(size)
        shapes.append(size / (square / len(pairs)) ** (element.dim / 2))
    return jnp.stack(sizes), jnp.stack(shapes)
