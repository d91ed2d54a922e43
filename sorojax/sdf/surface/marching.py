"""The zero set of a solid shape as triangles, by marching cubes on the blocks that the surface
crosses, packed into one small volume.
"""

import importlib.util
from typing import Literal, NamedTuple

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import raise_empty
from sorojax.sdf.surface.blocks import LEAF, Grid, active_blocks, grid_around, leaf_fields
from sorojax.sdf.surface.dual_contouring import dual_contouring

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
