"""Tables of quadrilaterals and hexahedra."""

import numpy as np

from sorojax.mesh.elements.elements import AbstractElement, Quad8, Quad9
from sorojax.mesh.elements.simplex import Quadrature

_SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_MIDDLES = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])


def nodes(element: AbstractElement) -> np.ndarray:
    if element.dim == 3:
        layers = [np.concatenate([_SQUARE, np.full((4, 1), z)], axis=1) for z in (-1.0, 1.0)]
        return np.concatenate(layers)
    extra = {Quad8: [_MIDDLES], Quad9: [_MIDDLES, np.zeros((1, 2))]}
    return np.concatenate([_SQUARE, *extra.get(type(element), [])])


def shape_functions(element: AbstractElement, at: np.ndarray) -> np.ndarray:
    corners = nodes(element)[: element.num_corners]
    if isinstance(element, Quad9):
        return np.prod(_lagrange(at), axis=2)
    product = np.prod(1 + at[:, None] * corners, axis=2) / 2**element.dim
    if not isinstance(element, Quad8):
        return product
    x, y = at[:, :1], at[:, 1:]
    bend = (x * corners[:, 0] + y * corners[:, 1]) - 1
    return np.concatenate([product * bend, _bumps(x, y)], axis=1)


def _lagrange(at: np.ndarray) -> np.ndarray:
    """Factors of the nine functions, one per axis: (points, nodes, 2)."""
    x, of = at[:, None], nodes(Quad9())
    return np.where(of == 0, 1 - x**2, x * (x + of) / 2)


def _lagrange_slope(at: np.ndarray) -> np.ndarray:
    x, of = at[:, None], nodes(Quad9())
    return np.where(of == 0, -2 * x, x + of / 2)


def _bumps(x, y) -> np.ndarray:
    u, v = (1 - x**2) / 2, (1 - y**2) / 2
    return np.concatenate([u * (1 - y), v * (1 + x), u * (1 + y), v * (1 - x)], axis=1)


def shape_gradients(element: AbstractElement, at: np.ndarray) -> np.ndarray:
    corners = nodes(element)[: element.num_corners]
    if isinstance(element, Quad9):
        value, slope = _lagrange(at), _lagrange_slope(at)
        return np.stack([slope[..., 0] * value[..., 1], value[..., 0] * slope[..., 1]], axis=2)
    factors = 1 + at[:, None] * corners
    slopes = []
    for i in range(element.dim):
        others = np.prod(np.delete(factors, i, axis=2), axis=2)
        slopes.append(corners[:, i] * others / 2**element.dim)
    gradient = np.stack(slopes, axis=2)
    if not isinstance(element, Quad8):
        return gradient
    x, y = at[:, :1], at[:, 1:]
    bend = (x * corners[:, 0] + y * corners[:, 1]) - 1
    value = np.prod(factors, axis=2) / 4
    gradient = gradient * bend[..., None] + value[..., None] * corners
    u, v = (1 - x**2) / 2, (1 - y**2) / 2
    along_x = np.concatenate([-x * (1 - y), v, -x * (1 + y), -v], axis=1)
    along_y = np.concatenate([-u, -y * (1 + x), u, -y * (1 - x)], axis=1)
    return np.concatenate([gradient, np.stack([along_x, along_y], axis=2)], axis=1)


def quadrature(element: AbstractElement, degree: int | None = None) -> Quadrature:
    if degree is None:
        degree = 5 if element.order == 2 else 3
    x, w = np.polynomial.legendre.leggauss(degree // 2 + 1)
    points = np.stack(np.meshgrid(*[x] * element.dim, indexing="ij"), -1)
    weights = np.prod(np.stack(np.meshgrid(*[w] * element.dim, indexing="ij"), -1), -1)
    return Quadrature(points.reshape(-1, element.dim), weights.ravel())
