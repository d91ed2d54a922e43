"""Sides between the facets of a surface: which are sharp, and the patches they bound."""

from typing import NamedTuple

import numpy as np

CREASE = np.deg2rad(40.0)  # turn between facets that makes a ridge, without a node set
FAINT = np.deg2rad(12.0)  # the same between nodes that are known to lie on ridges


class Sides(NamedTuple):
    """Distinct sides of facets.

    Attributes:
        ends: (sides, 2) nodes.
        sharp: (sides,) whether the normal jumps there, or surfaces meet.
        number: (facets, corners) side that starts at each corner of a facet.
        patch: (facets, corners) which smooth patch around its node a facet belongs to;
            numbers are unique to the node.
    """

    ends: np.ndarray
    sharp: np.ndarray
    number: np.ndarray
    patch: np.ndarray


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def facet_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals of triangles or quadrilaterals."""
    x = points[faces]
    if faces.shape[1] == 3:
        return unit(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]))
    return unit(np.cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1]))


def surface_sides(points, faces, owner, known: np.ndarray | None = None) -> Sides:
    """Sides of `faces` (facets, corners), sharp where two owners or more than two facets
    meet, or where normals turn by much; `known` tells the nodes that lie on ridges."""
    count, n = faces.shape[1], len(points)
    a, b = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys, number = np.unique(
        np.minimum(a, b) * np.int64(n) + np.maximum(a, b), return_inverse=True
    )
    ends = np.stack(np.divmod(keys, n), axis=1)
    order = np.argsort(number, kind="stable")
    start = np.searchsorted(number[order], np.arange(len(keys)))
    paired = np.bincount(number, minlength=len(keys)) == 2
    first, second = order[start[paired]], order[start[paired] + 1]
    normals = facet_normals(points, faces)
    cosine = (normals[first // count] * normals[second // count]).sum(axis=1)
    limit = np.full(len(first), np.cos(CREASE))
    if known is not None:
        limit = np.where(known[ends[paired]].all(axis=1), np.cos(FAINT), np.cos(CREASE))
    smooth = (cosine > limit) & (owner[first // count] == owner[second // count])
    sharp = np.ones(len(keys), bool)
    sharp[np.flatnonzero(paired)[smooth]] = False
    patch = _patches(faces, first[smooth], second[smooth])
    return Sides(ends, sharp, number.reshape(faces.shape), patch)


def _patches(faces: np.ndarray, first, second) -> np.ndarray:
    """Corners of facets joined where two facets share a smooth side."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = faces.shape[1]
    flat = faces.ravel()

    def after(corner):
        return corner // count * count + (corner % count + 1) % count

    turned = flat[first] == flat[after(second)]
    partner = np.where(turned, after(second), second)
    other = np.where(turned, second, after(second))
    pairs = (np.concatenate([first, after(first)]), np.concatenate([partner, other]))
    graph = coo_matrix((np.ones(len(pairs[0])), pairs), shape=(flat.size,) * 2)
    return connected_components(graph, directed=False)[1].reshape(faces.shape)
