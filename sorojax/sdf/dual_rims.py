"""Walls and gaps that fall between the nodes of a grid and would leave holes.

Where such a wall is lost, the surface turns round on itself within a cell. There, and only
there, the cell edges are looked along: one that goes through a wall between two nodes of the
same sign, in through one face and out through a parallel one, shows a hole.
"""

import numpy as np

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.blocks import Grid
from sorojax.sdf.sample import values, values_and_gradients

_TURNED = 0.6  # length of the mean normal of a vertex below which its planes are compared
_MOST = 2000  # cells that are looked at in a group of blocks
_ALONG = np.arange(1, 16) / 16
_PARALLEL = -0.98  # cosine between the slopes at both ends: sharper wedges end somewhere
_SHALLOW = 0.2  # cells: what is less deep may be the thin end of a wedge, not a wall
_CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)])
_EDGES = np.array([(c, c | 1 << a) for a in range(3) for c in range(8) if not c >> a & 1])


def refuse_lost_walls(
    shape: AbstractSdf, grid: Grid, total: np.ndarray, corner: np.ndarray, code: np.ndarray
) -> None:
    """Raise where a wall or gap would be cut open.

    Args:
        shape: Solid.
        grid: Cells.
        total: (n, 16) sums over the crossings of vertices, as `dual_vertices` has them.
        corner: (n, 3) first nodes of their cells.
        code: (n,) bits of the inside corners of their cells.

    Raises:
        ValueError: If a cell edge goes through a wall, or a gap, between its ends.
    """
    length = np.einsum("ni,ni->n", total[:, 4:7], total[:, 4:7])
    rows = np.flatnonzero(length < (_TURNED * total[:, 0]) ** 2)
    rows = rows[:: -(-len(rows) // _MOST) or 1]
    inside = code[rows, None] >> np.arange(8) & 1 > 0
    row, edge = np.nonzero(inside[:, _EDGES[:, 0]] == inside[:, _EDGES[:, 1]])
    a, b = (corner[rows[row]] + _CORNERS[_EDGES[edge, k]] for k in (0, 1))
    points = a[:, None] + _ALONG[:, None] * (b - a)[:, None]
    f = values(shape, grid.points(points.reshape(-1, 3))).reshape(len(row), len(_ALONG))
    within = inside[row, _EDGES[edge, 0]]
    depth = np.where(within[:, None], f, -f).max(axis=1, initial=0.0)
    at = np.flatnonzero(depth > _SHALLOW * grid.size)
    slopes = [values_and_gradients(shape, grid.points(end[at]))[1] for end in (a, b)]
    cosine = np.einsum("ni,ni->n", *slopes)
    cosine /= np.maximum(np.prod([np.linalg.norm(s, axis=1) for s in slopes], axis=0), 1e-300)
    at = at[cosine < _PARALLEL]
    if len(at):
        thick = 2 * float(np.median(depth[at]))
        what = "gap" if within[at[0]] else "wall"
        where = grid.points((a[at[0]] + b[at[0]]) / 2)
        raise ValueError(
            f"isosurface: a {what} about {thick:.2g} m thick near {np.round(where, 6)} m falls "
            f"between nodes {grid.size:.3g} m apart and would leave holes, need nodes at most "
            f"{thick:.2g} m apart. Use `size` <= {0.9 * thick:.2g} m, or thicken the {what}."
        )
