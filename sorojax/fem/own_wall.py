"""Facets on the two sides of one wall, which are near each other but never meet."""

import numpy as np
from jaxtyping import Bool, Int

from sorojax.mesh.elements import facet_corners
from sorojax.mesh.mesh import Mesh


def through_own_wall(
    mesh: Mesh,
    facets: Int[np.ndarray, "facets facet_nodes"],
    first: Int[np.ndarray, " pairs"],
    second: Int[np.ndarray, " pairs"],
    reach: float,
) -> Bool[np.ndarray, " pairs"]:
    """Whether the first facet of a pair lies behind the second in the reference
    configuration, back to back, in the same body and within twice the reach [m]."""
    X = np.asarray(mesh.points)
    corners = X[facets[:, : facet_corners(mesh.element)]]
    middle, normal = corners.mean(axis=1), _normals(corners)
    away = middle[first] - middle[second]
    behind = (away * normal[second]).sum(axis=1) < 0
    opposed = (normal[first] * normal[second]).sum(axis=1) < 0
    close = (away**2).sum(axis=1) < (2 * reach + _size(corners)) ** 2
    body = _bodies(mesh)[facets[:, 0]]
    return behind & opposed & close & (body[first] == body[second])


def _size(corners) -> float:
    return float(np.ptp(corners, axis=1).max())


def _normals(corners):
    along = corners[:, 1] - corners[:, 0]
    if corners.shape[2] == 2:
        return np.stack([along[:, 1], -along[:, 0]], axis=1)
    return np.cross(along, corners[:, 2] - corners[:, 0])


def _bodies(mesh: Mesh) -> Int[np.ndarray, " nodes"]:
    """Number of the connected part of the mesh that each node belongs to."""
    cells = np.asarray(mesh.cells)
    label = np.arange(mesh.num_nodes)
    while True:  # the smallest number of each cell, and of what it points to
        before = label
        label = label.copy()
        np.minimum.at(label, cells.ravel(), np.repeat(label[cells].min(axis=1), cells.shape[1]))
        label = label[label]
        if np.array_equal(label, before):
            return label
