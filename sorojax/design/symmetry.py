"""Cells that share a variable: mirrored and repeated layouts."""

import abc
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from sorojax import _check
from sorojax.mesh.mesh import Mesh


class AbstractSymmetry(eqx.Module):
    """A rule that takes every point to the one that decides about it."""

    @abc.abstractmethod
    def fold(self, points: Float[np.ndarray, "n dim"]) -> Float[np.ndarray, "n dim"]:
        """Where the point lies whose density each point has [m]."""


class Mirrored(AbstractSymmetry):
    """The same on both sides of the plane across `axis` at `at` [m]."""

    axis: int = eqx.field(static=True)
    at: float = eqx.field(static=True)

    def fold(self, points):
        folded = points.copy()
        folded[:, self.axis] = self.at + np.abs(points[:, self.axis] - self.at)
        return folded


class Repeated(AbstractSymmetry):
    """The same in every strip of length `pitch` [m] along `axis`, the first one at `at` [m]."""

    axis: int = eqx.field(static=True)
    pitch: float = eqx.field(static=True)
    at: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        _check.positive("Repeated", "pitch", self.pitch, "m", "Give the length of a strip.")

    def fold(self, points):
        folded = points.copy()
        folded[:, self.axis] = self.at + np.mod(points[:, self.axis] - self.at, self.pitch)
        return folded


def shared_variables(
    mesh: Mesh, symmetries: Sequence[AbstractSymmetry]
) -> tuple[Int[np.ndarray, " cells"], int]:
    """The variable of every cell, and how many there are.

    Symmetries apply in their order: of a repeated and mirrored layout, repeat first.

    Raises:
        ValueError: If a cell has no counterpart: the mesh has not the symmetry.
    """
    from sorojax.math.spatial import KDTree

    centres = np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(axis=1)
    folded = centres
    for symmetry in symmetries:
        folded = symmetry.fold(folded)
    tree = KDTree(centres)
    away, owner = tree.query(folded)
    size = np.median(tree.query(centres, k=2)[0][:, 1]) if len(centres) > 1 else 1.0
    if np.max(away) > 0.1 * size:
        worst = int(np.argmax(away))
        raise ValueError(
            f"shared_variables: cell {worst} at {centres[worst]} m has its counterpart at "
            f"{folded[worst]} m, {away[worst] / size:.2g} of a cell away from the nearest "
            "centre, need less than 0.1. Mesh the part with the symmetry, or half of it."
        )
    owners, number = np.unique(owner, return_inverse=True)
    return number.ravel(), len(owners)
