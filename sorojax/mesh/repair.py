"""A mesh from foreign arrays: what can be mended is mended and listed, the rest refused."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from sorojax._types import Numbers
from sorojax.math.host import KDTree
from sorojax.mesh.elements.base import AbstractElement, mirror_order
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.measure import cell_areas, cell_volumes
from sorojax.mesh.mesh import Mesh


class Repaired(NamedTuple):
    """A valid mesh and what was done to get it.

    Attributes:
        mesh: The mesh.
        merged: Given nodes replaced by an earlier one at the same place.
        removed: Given nodes that no cell uses.
        turned: Cells whose node order was reversed.
    """

    mesh: Mesh
    merged: np.ndarray
    removed: np.ndarray
    turned: np.ndarray

    def __str__(self) -> str:
        return (
            f"merged nodes {_ids(self.merged)}; removed nodes {_ids(self.removed)}; turned "
            f"cells {_ids(self.turned)}"
        )


def repair(
    points: Numbers, cells: Numbers, element: AbstractElement, *, tol: float | None = None
) -> Repaired:
    """A mesh from `points` [m] and `cells` that may have common faults.

    Nodes at one place are merged, nodes without cells removed, inverted cells turned.

    Args:
        points: (nodes, dim) [m].
        cells: (cells, cell_nodes), from zero.
        element: The element of the cells.
        tol: Nodes nearer than that are one [m]; 1e-9 of the extent when omitted.

    Returns:
        The mesh, and what was changed.

    Raises:
        ValueError: With the ids, if cells name missing nodes, points are not finite, or
            cells have no area.
    """

    points, cells = np.asarray(points, dtype=float), np.asarray(cells)
    _refuse(points, cells, element)
    if tol is None:
        tol = 1e-9 * float(np.ptp(points, axis=0).max())
    target = np.arange(len(points))
    for a, b in sorted(map(sorted, KDTree(points).query_pairs(tol))):
        target[b] = min(target[b], target[a])
    merged = np.flatnonzero(target != np.arange(len(points)))
    used = np.unique(target[cells])
    removed = np.setdiff1d(np.arange(len(points)), np.concatenate([used, merged]))
    kept, numbers = np.unique(target[cells], return_inverse=True)
    mesh = Mesh(points[kept], numbers.reshape(cells.shape), element)
    size = np.asarray(cell_areas(mesh) if element.dim == 2 else cell_volumes(mesh))
    flat = np.flatnonzero(np.abs(size) <= 1e-12 * np.abs(size).max(initial=0))
    if flat.size:
        raise ValueError(
            f"repair: cells {_ids(flat)} have no {'area' if element.dim == 2 else 'volume'}. "
            "Remove them, or separate their nodes."
        )
    turned = np.flatnonzero(size < 0)
    new = np.array(mesh.cells)
    if isinstance(element, PolyN):
        for k in turned:
            ring = list(dict.fromkeys(new[k].tolist()))[::-1]
            new[k] = ring + [ring[-1]] * (new.shape[1] - len(ring))
    else:
        new[turned] = new[turned][:, mirror_order(element)]
    return Repaired(Mesh(mesh.points, jnp.asarray(new), element), merged, removed, turned)


def _refuse(points, cells, element: AbstractElement) -> None:
    if cells.ndim != 2 or cells.shape[1] != element.num_nodes or not len(cells):
        raise ValueError(
            f"repair: `cells` has shape {cells.shape}, {element.name} needs (at least 1, "
            f"{element.num_nodes})."
        )
    bad = np.flatnonzero(((cells < 0) | (cells >= len(points))).any(axis=1))
    if bad.size:
        raise ValueError(
            f"repair: cells {_ids(bad)} name nodes outside 0 to {len(points) - 1}. Number "
            "nodes from zero."
        )
    lost = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if lost.size:
        raise ValueError(f"repair: points {_ids(lost)} are not finite. Correct or remove them.")


def _ids(ids: np.ndarray) -> str:
    rest = f" and {len(ids) - 12} more" if len(ids) > 12 else ""
    return f"{ids[:12].tolist()}{rest}"
