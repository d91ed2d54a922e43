"""The zero set of a plane shape as curves, of a solid shape as triangles."""

import importlib.util
from typing import Any, Literal, NamedTuple

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import finite_box, land, normals, raise_empty, values
from sorojax.sdf.surface.blocks import LEAF, Grid, active_blocks, grid_around, leaf_fields
from sorojax.sdf.surface.dual_contouring import dual_contouring

# The zero set of a plane shape as curves whose points and corners are exact.


_TURN = 0.05  # rad between neighbours that makes a corner search worth while
_CORNER = 0.02  # rad that are left at a corner when looked at from very near


class Curve(NamedTuple):
    """Points along a piece of a zero set, its inside on the left.

    Attributes:
        points: (n, 2) [m]; a closed curve does not repeat its first point.
        corner: (n,) whether the normal jumps at a point.
        closed: Whether the last point connects to the first.
    """

    points: np.ndarray
    corner: np.ndarray
    closed: bool


def contour(shape: AbstractSdf, size: float) -> list[Curve]:
    """Boundary curves of a plane shape as polygons.

    Marching squares find the curves; their points are then moved onto the zero set to
    rounding. A corner is where the normal jumps; it is put where the two sides meet.

    Args:
        shape: A concrete, bounded plane shape.
        size: Distance between points [m]; finer features may be missed.

    Returns:
        Closed curves with the inside on their left: the outline and one curve per hole.

    Raises:
        ValueError: If `size` is not positive, or the shape is not plane, empty, unbounded or
            traced.

    Example:
        >>> curves = sdf.contour(sdf.Rectangle([0, 0], [20 * mm, 10 * mm]), size=1 * mm)
        >>> len(curves), int(curves[0].corner.sum())
        (1, 4)
    """
    if not size > 0:
        raise ValueError(f"contour: `size` must be positive, got {size} m.")
    lower, upper = finite_box("contour", shape, 2)
    curves = level_curves(shape, lower - 1.37 * size, upper + 1.37 * size, size)
    if not curves:
        raise_empty("contour", lower, upper, size)
    return curves


def level_curves(
    shape: AbstractSdf, lower: np.ndarray, upper: np.ndarray, size: float
) -> list[Curve]:
    """Zero set of `shape` inside a window [m]; curves that leave the window are open."""
    from skimage.measure import find_contours

    counts = np.maximum(np.ceil((upper - lower) / size).astype(int), 2) + 1
    axes = [np.linspace(lower[i], upper[i], counts[i]) for i in (0, 1)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = values(shape, grid.reshape(-1, 2)).reshape(counts)
    # An exact zero on a grid node makes marching squares emit points twice.
    nudge = 1e-6 * size
    field = np.where(np.abs(field) < nudge, nudge, field)
    spacing = (upper - lower) / (counts - 1)
    rough = [lower + c * spacing for c in find_contours(field, 0.0)]
    curves = [_refine(shape, c, size) for c in rough if len(c) > 3]
    return [c for c in curves if len(c.points) > (2 if c.closed else 1)]


def _refine(shape: AbstractSdf, rough: np.ndarray, size: float) -> Curve:
    closed = bool(np.allclose(rough[0], rough[-1], rtol=0, atol=1e-9 * size))
    points = land(shape, rough[:-1] if closed else rough)
    points = points[_spaced(points, 0.02 * size, closed)]
    normal = normals(shape, points)
    if cross(normal[:-1], np.diff(points, axis=0)).sum() < 0:
        points, normal = points[::-1], normal[::-1]
    return _with_corners(shape, points, normal, size, closed)


def _spaced(points: np.ndarray, least: float, closed: bool) -> np.ndarray:
    """Points to keep so that neighbours are at least `least` apart."""
    before = np.roll(points, 1, axis=0)
    keep = np.linalg.norm(points - before, axis=1) > least
    if not closed:
        keep[0] = True
    return keep


def cross(a: Any, b: Any) -> Any:
    """Third component of the product of plane vectors (.., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _with_corners(shape, points, normal, size, closed) -> Curve:
    """The curve with its corners put in, and points that crowd them left out."""
    last = len(points) if closed else len(points) - 1
    first = np.arange(last)
    second = (first + 1) % len(points)
    turn = _turned(normal[first], normal[second])
    first, second = first[turn > _TURN], second[turn > _TURN]
    found, corners = locate_corners(
        shape, points[first], points[second], normal[first], normal[second]
    )
    after, corners = first[found], corners[found]
    order = np.argsort(np.concatenate([np.arange(len(points)), after + 0.5]), kind="stable")
    merged = np.concatenate([points, corners])[order]
    corner = np.concatenate([np.zeros(len(points), bool), np.ones(len(corners), bool)])
    corner = corner[order]
    keep = np.ones(len(merged), bool)
    numbers = np.flatnonzero(corner)
    for k, c in enumerate(numbers):
        # The same corner seen from two intervals counts once.
        same = np.linalg.norm(merged[numbers[:k]] - merged[c], axis=1) < 1e-6 * size
        keep[c] = not same.any()
        near = np.linalg.norm(merged - merged[c], axis=1) < 0.2 * size
        keep &= corner | ~near
    return Curve(merged[keep], corner[keep], closed)


def locate_corners(shape, a, b, normal_a, normal_b) -> tuple[np.ndarray, np.ndarray]:
    """Whether the zero set has a corner between points `a` and `b`, and where.

    The tangent lines of the two sides meet at the corner up to the curvature of the
    sides; the sides are looked at again from nearer and nearer, which makes it exact,
    and shows no jump where the curve is only strongly bent.
    """
    gap = np.linalg.norm(b - a, axis=1, keepdims=True)
    middle = (a + b) / 2
    corner = _meet(a, b, normal_a, normal_b, middle, gap)
    for zoom in (0.2, 0.05, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        step_a, step_b = zoom * gap * tangents(normal_a), zoom * gap * tangents(normal_b)
        # Both sides in one call: a call costs as much for a few points as for thousands.
        both = land(shape, np.concatenate([corner - step_a, corner + step_b]), 4)
        a, b = np.split(both, 2)
        normal_a, normal_b = np.split(normals(shape, both), 2)
        corner = _meet(a, b, normal_a, normal_b, (a + b) / 2, gap)
    near = np.linalg.norm(corner - middle, axis=1) < 1.5 * gap[:, 0]
    return (_turned(normal_a, normal_b) > _CORNER) & near, corner


def _turned(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle [rad] between vectors."""
    return np.abs(np.arctan2(cross(a, b), (a * b).sum(axis=1)))


def tangents(normal: np.ndarray) -> np.ndarray:
    """Unit tangents with the inside on the left: outward normals turned by 90 degrees."""
    return np.stack([-normal[:, 1], normal[:, 0]], axis=-1)


def _meet(a, b, normal_a, normal_b, fallback, gap) -> np.ndarray:
    """Where the lines through `a` and `b` across their normals meet."""
    det = cross(normal_a, normal_b)
    parallel = np.abs(det) < 1e-9
    safe = np.where(parallel, 1.0, det)
    # Relative to `a`, so that small numbers are not lost beside large coordinates.
    level = ((b - a) * normal_b).sum(axis=1)
    step = np.stack([-level * normal_a[:, 1], level * normal_a[:, 0]], axis=-1)
    meeting = a + step / safe[:, None]
    far = np.linalg.norm(meeting - fallback, axis=1) > 2 * gap[:, 0]
    return np.where((parallel | far)[:, None], fallback, meeting)


# Marching cubes on the blocks a surface crosses, packed into one small volume.


_SIDE = 8  # blocks along the packed volume: one call handles 512 of them
_WIDE = LEAF + 1
_PIECE = 1 << 16
_NUDGE = 5e-3  # cells: no vertex comes nearer to a node, so none coincide in float32


def marching_cubes(
    shape: AbstractSdf, grid: Grid, blocks: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [m] on grid edges and triangles that face outwards."""
    names, shares, own, triangles = [], [], [np.zeros((0, 3))], []
    count = inner = 0
    for group, field in leaf_fields(shape, grid, blocks):
        crossed = (field < 0).any(axis=(1, 2, 3)) & (field >= 0).any(axis=(1, 2, 3))
        group, field = group[crossed], field[crossed]
        field = np.where(np.abs(field) < _NUDGE, np.copysign(_NUDGE, field), field)
        for start in range(0, len(group), _SIDE**3):
            piece = slice(start, start + _SIDE**3)
            vertices, corners = _extract(_pack(field[piece]))
            name, share, alone = _locate(grid, group[piece], field[piece], vertices, inner)
            inner += len(alone)
            names.append(name)
            shares.append(share)
            own.append(alone)
            triangles.append(corners.astype(np.int32) + np.int32(count))
            count += len(name)
    if not triangles:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    name, first, which = np.unique(
        np.concatenate(names), return_index=True, return_inverse=True
    )
    share = np.concatenate(shares)[first]
    del names, shares, first
    which = which.astype(np.int32)
    corners = np.concatenate(triangles)
    del triangles
    for row in range(0, len(corners), _PIECE):
        corners[row : row + _PIECE] = which[corners[row : row + _PIECE]]
    return _positions(grid, name, share, np.concatenate(own)), corners


def _positions(grid, name, share, own) -> np.ndarray:
    """Vertices [m]: those inside cells, named below zero, then those on grid edges."""
    vertices = np.empty((len(name), 3))
    vertices[: len(own)] = grid.points(own[::-1])
    for row in range(len(own), len(name), _PIECE):
        piece = slice(row, row + _PIECE)
        number, axis = np.divmod(name[piece], 3)
        nodes = grid.node(number).astype(float)
        nodes[np.arange(len(nodes)), axis] += share[piece]
        vertices[piece] = grid.points(nodes)
    return vertices


def _pack(field: np.ndarray) -> np.ndarray:
    """Blocks side by side in a cube; places left over lie outside."""
    full = np.ones((_SIDE**3, _WIDE, _WIDE, _WIDE), np.float32)
    full[: len(field)] = field
    grouped = full.reshape(_SIDE, _SIDE, _SIDE, _WIDE, _WIDE, _WIDE)
    volume = grouped.transpose(0, 3, 1, 4, 2, 5).reshape(3 * (_SIDE * _WIDE,))
    return np.ascontiguousarray(volume)


def _extract(volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Surface of the packed volume without the cells that lie between two blocks."""
    if importlib.util.find_spec("vtkmodules") is not None:
        return _flying_edges(volume)
    from skimage import measure

    inside = np.arange(len(volume)) % _WIDE != 0
    # A cell is masked by its upper corner.
    mask = inside[:, None, None] & inside[:, None] & inside
    vertices, triangles, *_ = measure.marching_cubes(
        volume, 0.0, mask=mask, gradient_direction="descent", allow_degenerate=True
    )
    return vertices, triangles


def _flying_edges(volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy  # type: ignore
    from vtkmodules.vtkCommonDataModel import vtkImageData  # type: ignore
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D  # type: ignore

    image = vtkImageData()
    image.SetDimensions(*volume.shape)
    image.GetPointData().SetScalars(numpy_to_vtk(volume.ravel(order="F")))
    edges = vtkFlyingEdges3D()
    edges.SetInputData(image)
    edges.SetValue(0, 0.0)
    edges.ComputeNormalsOff()
    edges.ComputeScalarsOff()
    edges.Update()
    vertices = vtk_to_numpy(edges.GetOutput().GetPoints().GetData())
    triangles = vtk_to_numpy(edges.GetOutput().GetPolys().GetConnectivityArray())
    # It turns triangles towards higher values: outwards is the other way round.
    triangles = triangles.reshape(-1, 3)[:, ::-1]
    cell = np.floor(vertices[triangles].mean(axis=1)).astype(int)
    triangles = triangles[(cell % _WIDE != LEAF).all(axis=1)]
    used, triangles = np.unique(triangles, return_inverse=True)
    return vertices[used], triangles.reshape(-1, 3)


def _locate(grid, group, field, vertices, inner):
    """Name of every vertex, its share along its grid edge, and those inside cells.

    An edge is named by its first node and axis, a vertex inside a cell by -1, -2, ...
    """
    whole = np.rint(vertices)
    split = np.abs(vertices - whole) > _NUDGE / 4
    base = np.where(split, np.floor(vertices), whole).astype(np.int64)
    place, local = base // _WIDE, base % _WIDE
    block = (place[:, 0] * _SIDE + place[:, 1]) * _SIDE + place[:, 2]
    axis = split.argmax(axis=1)
    on_edge = split.sum(axis=1) == 1
    flat = field.ravel()
    steps = np.array([_WIDE * _WIDE, _WIDE, 1])
    here = block * _WIDE**3 + local @ steps
    a, b = flat[here], flat[np.where(on_edge, here + steps[axis], here)]
    share = a / np.where(on_edge, a - b, np.float32(1))
    nodes = group[block] + local
    name = grid.number(nodes) * 3 + axis
    inside = ~on_edge
    name[inside] = -inner - 1 - np.arange(inside.sum())
    return name, share, nodes[inside] + (vertices - base)[inside]


# The zero set of a solid shape as triangles


_METHODS = {"marching_cubes": marching_cubes, "dual_contouring": dual_contouring}


class Surface(NamedTuple):
    """Triangles in space, counter-clockwise seen from outside.

    Attributes:
        vertices: (n, 3) [m].
        triangles: (m, 3) rows of `vertices`.
    """

    vertices: np.ndarray
    triangles: np.ndarray

    def __repr__(self) -> str:
        return f"Surface: {len(self.vertices)} vertices, {len(self.triangles)} triangles"


def isosurface(
    shape: AbstractSdf,
    size: float,
    method: Literal["marching_cubes", "dual_contouring"] = "marching_cubes",
) -> Surface:
    """Closed, manifold boundary surface of a solid shape as triangles.

    Only blocks of cells that the Lipschitz constant of the shape cannot exclude are
    evaluated. Walls and gaps thinner than `size` may be lost by marching cubes. Dual
    contouring keeps those of `size` and more whole, and also the rims of walls that get
    thinner towards their end, up to half a cell thicker than drawn. It refuses walls of even
    thickness between 0.2 and 1 `size` where it sees that they pass between nodes; thinner ones
    may be lost without an error, so choose `size` no larger than the thinnest wall. Its
    triangles do not cross each other except in cells that several sheets of the surface share.

    Args:
        shape: A concrete, bounded solid shape.
        size: Edge of a cell [m].
        method: "marching_cubes" puts vertices on cell edges (scikit-image, or VTK's flying
            edges where vtk is installed); "dual_contouring" puts one vertex per sheet
            into a cell, which keeps sharp edges and corners.

    Returns:
        Vertices [m] and triangles, normals outward.

    Raises:
        ValueError: If the shape is not solid, empty, unbounded or traced, its field varies
            faster than its Lipschitz constant says, or dual contouring meets a wall of 0.2 to
            1 `size` that passes between nodes.

    Example:
        >>> surface = sdf.isosurface(sdf.Sphere([0, 0, 0], 10 * mm), size=2 * mm)
        >>> radii = np.linalg.norm(surface.vertices, axis=1)
        >>> bool(np.allclose(radii, 10 * mm, rtol=0, atol=0.1 * mm))
        True

    Reference:
        Lorensen and Cline, Marching cubes, SIGGRAPH 1987; Ju et al., Dual contouring of
        Hermite data, SIGGRAPH 2002; Schaefer, Ju and Warren, Manifold dual contouring, IEEE
        TVCG 13, 2007.
    """
    if method not in _METHODS:
        raise ValueError(f"isosurface: `method` is {method!r}, need one of {list(_METHODS)}.")
    grid = grid_around("isosurface", shape, size)
    blocks = active_blocks("isosurface", shape, grid)
    surface = Surface(*_METHODS[method](shape, grid, blocks))
    if not len(surface.triangles):
        raise_empty("isosurface", grid.lower, grid.points(grid.counts), grid.size)
    return surface
