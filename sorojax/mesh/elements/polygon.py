"""Tables of convex polygons: Wachspress functions on the regular polygon.

The number of corners is that of the element: a padded cell of n corners takes the
tables of `PolyN(n)`.

Reference: Talischi, Paulino, Pereira, Menezes, PolyTop, SMO 45, 2012, section 4.
"""

import numpy as np

from sorojax.mesh.elements.elements import AbstractElement, Tri3
from sorojax.mesh.elements.simplex import Quadrature, quadrature as simplex_quadrature


def nodes(element: AbstractElement) -> np.ndarray:
    angle = 2 * np.pi * np.arange(element.num_nodes) / element.num_nodes
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def shape_functions(element: AbstractElement, at: np.ndarray) -> np.ndarray:
    weight = _weights(element, at)[0]
    return weight / weight.sum(axis=1, keepdims=True)


def shape_gradients(element: AbstractElement, at: np.ndarray) -> np.ndarray:
    weight, slope = _weights(element, at)
    total = weight.sum(axis=1)[:, None, None]
    N = weight[..., None] / total
    return slope / total - N * slope.sum(axis=1, keepdims=True) / total


def _weights(element: AbstractElement, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wachspress weights times all side distances: polynomials, finite on the sides too.

    On a regular polygon the weight of a corner is the product of the distances to all
    sides that do not touch it.
    """
    n = element.num_nodes
    corners = nodes(element)
    middle = (corners + np.roll(corners, -1, axis=0)) / 2
    reach = np.cos(np.pi / n)
    normal = middle / reach
    distance = reach - at @ normal.T
    away = [[k for k in range(n) if k not in (i, (i - 1) % n)] for i in range(n)]
    weight = np.stack([np.prod(distance[:, k], axis=1) for k in away], axis=1)
    slope = np.zeros((len(at), n, 2))
    for i, sides in enumerate(away):
        for k in sides:
            rest = np.prod(distance[:, [j for j in sides if j != k]], axis=1)
            slope[:, i] -= rest[:, None] * normal[k]
    return weight, slope


def quadrature(element: AbstractElement, degree: int | None = None) -> Quadrature:
    """Rules of the triangles between the centre and the sides; degree 2 when omitted."""
    rule = simplex_quadrature(Tri3(), 2 if degree is None else degree)
    corners = nodes(element)
    after = np.roll(corners, -1, axis=0)
    r, s = rule.points[:, :1], rule.points[:, 1:]
    points = np.concatenate([r * a + s * b for a, b in zip(corners, after, strict=True)])
    doubled = np.sin(2 * np.pi / element.num_nodes)
    return Quadrature(points, np.tile(rule.weights * doubled, element.num_nodes))
