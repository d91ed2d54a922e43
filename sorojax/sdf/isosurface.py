"""The zero set of a solid shape as triangles."""

from typing import Literal, NamedTuple

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.blocks import active_blocks, grid_around
from sorojax.sdf.dual_contouring import dual_contouring
from sorojax.sdf.marching import marching_cubes
from sorojax.sdf.sample import raise_empty

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
    """Closed, manifold boundary surface of a solid shape.

    Only blocks of cells that the Lipschitz constant of the shape cannot exclude are
    evaluated. Walls and gaps thinner than `size` may be lost by marching cubes. Dual
    contouring keeps those of `size` and more whole, and the thin rims at which sheets run
    out, up to half a cell thicker. Walls of even thickness between 0.2 and 1 `size` it
    refuses where it sees them pass between nodes; thinner ones may be lost without a word,
    so choose `size` no larger than the thinnest wall. Its triangles do not pass through
    each other but where several sheets share a cell.

    Args:
        shape: A concrete, bounded solid shape.
        size: Edge of a cell [m].
        method: "marching_cubes" puts vertices on cell edges (scikit-image, or VTK's flying
            edges where vtk is installed); "dual_contouring" puts one vertex per sheet
            into a cell, which keeps sharp edges and corners.

    Raises:
        ValueError: If the shape is empty, unbounded or traced, its field varies faster
            than its Lipschitz constant says, or dual contouring meets a wall of 0.2 to 1
            `size` that passes between nodes.
    """
    if method not in _METHODS:
        raise ValueError(f"isosurface: `method` is {method!r}, need one of {list(_METHODS)}.")
    grid = grid_around("isosurface", shape, size)
    blocks = active_blocks("isosurface", shape, grid)
    surface = Surface(*_METHODS[method](shape, grid, blocks))
    if not len(surface.triangles):
        raise_empty("isosurface", grid.lower, grid.points(grid.counts), grid.size)
    return surface
