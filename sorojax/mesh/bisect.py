"""A lattice of tetrahedra graded by bisection of longest edges.

Reference: Arnold, Mukherjee and Pouly, Locally adapted tetrahedral meshes using bisection,
    SIAM J. Sci. Comput. 22 (2000).
"""

import numpy as np

from sorojax.mesh.lattice import Lattice
from sorojax.mesh.sizes import Sizes
from sorojax.mesh.tet_shape import signed_volumes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import values

_EDGES = np.array(((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)))
_COARSE = 1.12  # pitch of a cell over the wanted one: a bisection takes it to 0.9
_UNIT = 2**12  # steps per cube: lengths are compared as whole numbers
_MOST_CELLS = 10_000_000


def graded(shape: AbstractSdf, background: Lattice, pitch: float, size: Sizes):
    """Points [m] and cells of `background` bisected until they are as small as `size`.

    The longest edge of a cell is halved together with all cells around it, so faces
    match; cells of the lattice stay within four shapes, of dihedral angles from 45 degrees.
    """
    parts = _Parts(shape, background, pitch)
    for _ in range(200):
        wanted = size(parts.points)[parts.cells].min(axis=1)
        wanted = np.minimum(wanted, size(parts.points[parts.cells].mean(axis=1)))
        split = parts.pitches() > _COARSE * wanted
        split |= parts.hanging()
        if not split.any():
            break
        parts.bisect(split)
        if len(parts.cells) > _MOST_CELLS:
            raise ValueError(
                f"tetrahedralise: `size` asks for more than {_MOST_CELLS:.0e} cells. Raise "
                "its least length, or let it grow faster."
            )
    return parts.points, parts.cells


class _Parts:
    """Cells while they are bisected: coordinates are whole numbers of the smallest step."""

    def __init__(self, shape: AbstractSdf, background: Lattice, pitch: float):
        self.shape, self.start, self.step = shape, background.start, pitch / _UNIT
        self.lipschitz = float(np.asarray(shape.lipschitz))
        self.at = np.rint(background.at * _UNIT).astype(np.int64)
        self.f = values(shape, self.points)
        self.cells = background.cells
        self.ends = np.zeros(0, np.int64)  # keys of bisected edges, sorted
        self.middle = np.zeros(0, np.int64)
        self._drop()

    @property
    def points(self) -> np.ndarray:
        return self.start + self.step * self.at

    def _keys(self, cells: np.ndarray) -> np.ndarray:
        pairs = np.sort(cells[:, _EDGES], axis=2)
        return pairs[..., 0] << 32 | pairs[..., 1]

    def pitches(self) -> np.ndarray:
        """Pitch [m] of the lattice whose cells are as large."""
        volume = np.abs(signed_volumes(self.at[self.cells].astype(float)))
        return np.cbrt(12 * volume) * self.step

    def hanging(self) -> np.ndarray:
        """Cells with an edge that was bisected beside them."""
        return self._bisected(self._keys(self.cells)).any(axis=1)  # type: ignore

    def _bisected(self, keys: np.ndarray) -> np.ndarray:
        if not len(self.ends):
            return np.zeros(keys.shape, bool)
        place = np.minimum(np.searchsorted(self.ends, keys), len(self.ends) - 1)
        return np.equal(self.ends[place], keys)

    def bisect(self, split: np.ndarray) -> None:
        cells, rows = self.cells[split], np.arange(int(split.sum()))
        keys, x = self._keys(cells), self.at[cells]
        gap = x[:, _EDGES[:, 0]] - x[:, _EDGES[:, 1]]
        square = (gap * gap).sum(axis=2)
        # Of edges of one length the same is taken from every side.
        longest = np.where(square == square.max(axis=1, keepdims=True), keys, -1).argmax(axis=1)
        own = keys[rows, longest]
        new = np.unique(own[~self._bisected(own)])
        a, b = new >> 32, new & (2**32 - 1)
        number = len(self.at) + np.arange(len(new))
        self.at = np.concatenate([self.at, (self.at[a] + self.at[b]) // 2])
        fresh = self.start + self.step * self.at[number]
        self.f = np.concatenate([self.f, values(self.shape, fresh)])
        ends, middle = np.r_[self.ends, new], np.r_[self.middle, number]
        order = np.argsort(ends)
        self.ends, self.middle = ends[order], middle[order]
        node = self.middle[np.searchsorted(self.ends, own)]
        halves = [cells.copy(), cells.copy()]
        for half, end in zip(halves, _EDGES[longest].T, strict=True):
            half[rows, end] = node
        self.cells = np.concatenate([self.cells[~split], *halves])
        self._drop()

    def _drop(self) -> None:
        """Leave out cells that cannot touch the inside."""
        f = self.f[self.cells].min(axis=1)
        x = self.at[self.cells]
        reach = np.sqrt(((x - x[:, :1]) ** 2).sum(axis=2).max(axis=1)) * self.step
        self.cells = self.cells[f < 2 * self.lipschitz * reach]
