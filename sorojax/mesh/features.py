"""Sharp edges and corners of a solid in its tetrahedra: nodes of the surface moved onto
the ridge wherever an edge of the surface would cut it off."""

from typing import NamedTuple

import numpy as np

from sorojax.mesh.ridge_snap import Around, Snapper
from sorojax.mesh.settle import Sides
from sorojax.mesh.sizes import Sizes
from sorojax.mesh.tet_shape import badness
from sorojax.sdf.base import AbstractSdf

_TURNS = 2  # rounds of splitting
_THIN = np.cos(np.deg2rad(12.0))  # poorest dihedral angle that a split may make


class Features(NamedTuple):
    """What is known of the nodes on ridges.

    Attributes:
        sides: The two sides of every ridge node, three or more of every corner.
        ridge: (nodes,) whether a node lies on a ridge.
        corner: (nodes,) whether it is a corner and may not move.
        before: (nodes, 3) where the nodes were before they were put on ridges [m].
    """

    sides: Sides
    ridge: np.ndarray
    corner: np.ndarray
    before: np.ndarray

    def without(self, nodes: np.ndarray) -> "Features":
        """The same with `nodes` no longer on ridges."""
        ridge, corner = self.ridge.copy(), self.corner.copy()
        ridge[nodes], corner[nodes] = False, False
        keep = ridge[self.sides.point]
        return Features(Sides(*(part[keep] for part in self.sides)), ridge, corner, self.before)


def sharpen(shape: AbstractSdf, points, cells, skin, size: Sizes):
    """`(points, cells, skin, features)` without surface edges that cut a ridge off: a node
    is moved where its cells allow it, else the edge is split."""
    before = points
    for turn in range(_TURNS + 1):
        found = Snapper(shape, points, cells, size)
        found.snap_touching()
        found.snap_corners()
        found.snap_ridges()
        edges, places = found.left() if turn < _TURNS else ([], [])
        points = found.points
        if not len(edges):
            return (
                points,
                cells,
                skin,
                Features(found.sides(), found.ridge, found.corner, before),
            )
        points, cells = split_edges(points, cells, edges, places)
        if len(points) == len(skin):
            return (
                points,
                cells,
                skin,
                Features(found.sides(), found.ridge, found.corner, before),
            )
        fresh = points[len(skin) :]
        skin = np.concatenate([skin, np.ones(len(fresh), bool)])
        before = np.concatenate([before, fresh])
    raise AssertionError("unreachable")


def split_edges(points, cells, edges, places) -> tuple[np.ndarray, np.ndarray]:
    """A new node at `places` on each edge; every cell of the edge becomes two."""
    around = Around(cells, len(points))
    taken = np.zeros(len(cells), bool)
    halves, fresh = [], []
    for (a, b), place in zip(edges.tolist(), places, strict=True):
        rows = np.intersect1d(around.rows_of(a), around.rows_of(b))
        x = points[cells[rows]]
        parts = [np.where((cells[rows] == old)[..., None], place, x) for old in (a, b)]
        if taken[rows].any() or badness(np.concatenate(parts)).max() > _THIN:
            continue  # its turn comes in the next round, or the ridge is cut off there
        taken[rows] = True
        node = len(points) + len(fresh)
        fresh.append(place)
        for old in (a, b):
            halves.append(np.where(cells[rows] == old, node, cells[rows]))
    cells = np.concatenate([cells[~taken], *halves])
    return np.concatenate([points, np.reshape(fresh, (-1, 3))]), cells
