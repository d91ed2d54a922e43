"""Shape functions and quadrature of the reference triangle with corners (0,0), (1,0),
(0,1), and of the reference side [-1, 1]. Host arrays: tables, not computations.

Reference: Hughes, The Finite Element Method, 1987, chapter 3; the six-point rule of
degree 4 is Dunavant's (1985).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sorojax.mesh.elements import AbstractElement


class Quadrature(NamedTuple):
    points: Float[np.ndarray, "quad dim"]
    weights: Float[np.ndarray, " quad"]


def shape_functions(
    element: AbstractElement, at: Float[np.ndarray, "points dim"]
) -> Float[np.ndarray, "points cell_nodes"]:
    """Values of the shape functions at reference points."""
    corners = _barycentric(at)
    if element.order == 1:
        return corners
    sides = [4 * corners[:, i] * corners[:, j] for i, j in ((0, 1), (1, 2), (2, 0))]
    return np.concatenate([corners * (2 * corners - 1), np.stack(sides, axis=1)], axis=1)


def shape_gradients(
    element: AbstractElement, at: Float[np.ndarray, "points dim"]
) -> Float[np.ndarray, "points cell_nodes dim"]:
    """Derivatives with respect to the reference coordinates."""
    slope = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
    if element.order == 1:
        return np.broadcast_to(slope, (len(at), 3, 2)).copy()
    L = _barycentric(at)
    corners = (4 * L - 1)[:, :, None] * slope
    sides = [
        4 * (L[:, [i], None] * slope[j] + L[:, [j], None] * slope[i])[:, 0]
        for i, j in ((0, 1), (1, 2), (2, 0))
    ]
    return np.concatenate([corners, np.stack(sides, axis=1)], axis=1)


def _barycentric(at):
    at = np.asarray(at, float)
    return np.concatenate([1 - at.sum(axis=1, keepdims=True), at], axis=1)


def nodes(element: AbstractElement) -> Float[np.ndarray, "cell_nodes dim"]:
    """Reference coordinates of the nodes."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    if element.order == 1:
        return corners
    sides = [(corners[i] + corners[j]) / 2 for i, j in ((0, 1), (1, 2), (2, 0))]
    return np.concatenate([corners, np.stack(sides)])


def quadrature(element: AbstractElement) -> Quadrature:
    """The rule used for stiffness: degree 1 for Tri3, degree 4 for Tri6."""
    if element.order == 1:
        return Quadrature(np.array([[1 / 3, 1 / 3]]), np.array([0.5]))
    a, b = 0.445948490915965, 0.091576213509771
    wa, wb = 0.111690794839005, 0.054975871827661
    points = [p for c in (a, b) for p in ((c, c), (1 - 2 * c, c), (c, 1 - 2 * c))]
    return Quadrature(np.array(points), np.array([wa] * 3 + [wb] * 3))


def side_functions(
    order: int, at: Float[np.ndarray, " quad"]
) -> Float[np.ndarray, "quad facet_nodes"]:
    """Shape functions of a side: the two ends, then the middle node."""
    if order == 1:
        return np.stack([(1 - at) / 2, (1 + at) / 2], axis=1)
    return np.stack([at * (at - 1) / 2, at * (at + 1) / 2, 1 - at**2], axis=1)


def side_slopes(
    order: int, at: Float[np.ndarray, " quad"]
) -> Float[np.ndarray, "quad facet_nodes"]:
    """Derivatives of `side_functions`."""
    if order == 1:
        half = np.full_like(at, 0.5)
        return np.stack([-half, half], axis=1)
    return np.stack([at - 0.5, at + 0.5, -2 * at], axis=1)
