"""Tables of triangles and tetrahedra.

Reference: the six-point rule of degree 4 is Dunavant's (1985), the fourteen-point rule
of degree 5 Walkington's (2000).
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sorojax.mesh.elements.elements import AbstractElement, Tet15, Tri7

_SIDES = {2: ((0, 1), (1, 2), (2, 0)), 3: ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))}


class Quadrature(NamedTuple):
    points: Float[np.ndarray, "quad dim"]
    weights: Float[np.ndarray, " quad"]


def shape_functions(element: AbstractElement, at: np.ndarray) -> np.ndarray:
    return _barycentric(at) if element.order == 1 else _plain(element, at) @ _nodal(element)


def shape_gradients(element: AbstractElement, at: np.ndarray) -> np.ndarray:
    dim = element.dim
    slope = np.concatenate([-np.ones((1, dim)), np.eye(dim)])
    if element.order == 1:
        return np.broadcast_to(slope, (len(at), dim + 1, dim)).copy()
    L = _barycentric(at)
    by_L = [(4 * L - 1)[:, :, None] * slope]
    by_L += [_product_slope(L, slope, ends, 4.0)[:, None] for ends in _SIDES[dim]]
    by_L += [_product_slope(L, slope, k, 3.0 ** len(k))[:, None] for k in _bubbles(element)]
    return np.einsum("qbd,ba->qad", np.concatenate(by_L, axis=1), _nodal(element))


def _plain(element: AbstractElement, at: np.ndarray) -> np.ndarray:
    """Quadratic functions, then bubbles: a basis that is not nodal yet."""
    L = _barycentric(at)
    sides = [4 * L[:, i] * L[:, j] for i, j in _SIDES[element.dim]]
    bubbles = [3.0 ** len(k) * np.prod(L[:, list(k)], axis=1) for k in _bubbles(element)]
    return np.concatenate([L * (2 * L - 1), np.stack(sides + bubbles, axis=1)], axis=1)


def _bubbles(element: AbstractElement) -> list[tuple[int, ...]]:
    """Corners whose barycentric coordinates are multiplied into a bubble."""
    if isinstance(element, Tri7):
        return [(0, 1, 2)]
    if isinstance(element, Tet15):
        return [facet[:3] for facet in element.facets] + [(0, 1, 2, 3)]
    return []


@cache
def _nodal(element: AbstractElement) -> np.ndarray:
    """Coefficients that make the basis one at a node and zero at the others."""
    return np.linalg.inv(_plain(element, nodes(element)))


def _product_slope(L, slope, factors: tuple[int, ...], scale: float) -> np.ndarray:
    others = [np.prod(L[:, [j for j in factors if j != i]], axis=1) for i in factors]
    return scale * np.stack(others, axis=1) @ slope[list(factors)]


def _barycentric(at: np.ndarray) -> np.ndarray:
    return np.concatenate([1 - at.sum(axis=1, keepdims=True), at], axis=1)


def nodes(element: AbstractElement) -> np.ndarray:
    corners = np.concatenate([np.zeros((1, element.dim)), np.eye(element.dim)])
    if element.order == 1:
        return corners
    groups = [*_SIDES[element.dim], *_bubbles(element)]
    return np.concatenate([corners, np.stack([corners[list(k)].mean(0) for k in groups])])


def quadrature(element: AbstractElement, degree: int | None = None) -> Quadrature:
    usual = {(2, 1): 1, (2, 2): 4, (3, 1): 1, (3, 2): 2}[element.dim, element.order]
    usual = 5 if isinstance(element, Tet15) else usual
    want = usual if degree is None else degree
    rules = _TRIANGLE if element.dim == 2 else _TETRAHEDRON
    fitting = [known for known in rules if known >= want]
    if not fitting:
        raise ValueError(
            f"quadrature: no rule of degree {want} is tabulated for {element.name}, the "
            f"highest is {max(rules)}. Ask for that, or split the cell."
        )
    return rules[min(fitting)]


def _orbits(dim: int, *orbits: tuple[tuple[float, ...], float]) -> Quadrature:
    """The rule whose points are all permutations of barycentric coordinates.

    Weights are shares of the cell.
    """
    from itertools import permutations
    from math import factorial

    points, weights = [], []
    for coordinates, weight in orbits:
        for L in sorted(set(permutations(coordinates)), reverse=True):
            points.append(L[1:])
            weights.append(weight / factorial(dim))
    return Quadrature(np.array(points), np.array(weights))


def _triangle_degree_4() -> Quadrature:
    a, b = 0.445948490915965, 0.091576213509771
    wa, wb = 0.111690794839005, 0.054975871827661
    points = [p for c in (a, b) for p in ((c, c), (1 - 2 * c, c), (c, 1 - 2 * c))]
    return Quadrature(np.array(points), np.array([wa] * 3 + [wb] * 3))


def _near(a: float, dim: int) -> tuple[float, ...]:
    return (1 - dim * a, *([a] * dim))


_E = 0.04550370412564965
_TRIANGLE = {
    1: Quadrature(np.array([[1 / 3, 1 / 3]]), np.array([0.5])),
    2: _orbits(2, (_near(1 / 6, 2), 1 / 3)),
    4: _triangle_degree_4(),
}
_TETRAHEDRON = {
    1: _orbits(3, ((0.25,) * 4, 1.0)),
    2: _orbits(3, (_near((5 - 5**0.5) / 20, 3), 0.25)),
    5: _orbits(
        3,
        (_near(0.31088591926330060980, 3), 0.11268792571801585080),
        (_near(0.092735250310891226402, 3), 0.073493043116361949544),
        ((_E, _E, 0.5 - _E, 0.5 - _E), 0.042546020777081466438),
    ),
}
