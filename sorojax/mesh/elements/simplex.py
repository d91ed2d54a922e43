"""Triangles and tetrahedra: corners at the origin and at distance 1 on each axis.

The fourth corner of a tetrahedron lies on the side to which (1 - 0) x (2 - 0) points.

Reference: the six-point rule of degree 4 is Dunavant's (1985), the fourteen-point rule
of degree 5 Walkington's (2000).
"""

from functools import cache
from itertools import permutations
from math import factorial
from typing import ClassVar

import numpy as np

from sorojax.mesh.elements.base import AbstractElement, Facets, Quadrature, side_ends


class AbstractSimplex(AbstractElement):
    """A triangle or tetrahedron of polynomials of degree `order`, 1 or 2, and bubbles.

    Attributes:
        bubbles: Corners whose barycentric coordinates are multiplied into a function that is
            zero on the rest of the boundary; each belongs to a node in the middle of them.
    """

    bubbles: ClassVar[Facets] = ()

    def linear(self):
        return Tri3() if self.dim == 2 else Tet4()

    def nodes(self):
        corners = np.concatenate([np.zeros((1, self.dim)), np.eye(self.dim)])
        groups = [*side_ends(self), *self.bubbles]
        return np.concatenate([corners, *(corners[list(k)].mean(0)[None] for k in groups)])

    def shape_functions(self, at):
        return _barycentric(at) if self.order == 1 else _basis(self, at) @ _nodal(self)

    def shape_gradients(self, at):
        slope = np.concatenate([-np.ones((1, self.dim)), np.eye(self.dim)])
        if self.order == 1:
            return np.broadcast_to(slope, (len(at), *slope.shape)).copy()
        L = _barycentric(at)
        by_L = [(4 * L - 1)[:, :, None] * slope]
        by_L += [_product_slope(L, slope, ends, 4.0)[:, None] for ends in side_ends(self)]
        by_L += [_product_slope(L, slope, k, 3.0 ** len(k))[:, None] for k in self.bubbles]
        return np.einsum("qbd,ba->qad", np.concatenate(by_L, axis=1), _nodal(self))

    def quadrature(self, degree):
        rules = _TRIANGLE if self.dim == 2 else _TETRAHEDRON
        fitting = [known for known in rules if known >= degree]
        if not fitting:
            raise ValueError(
                f"quadrature: no rule of degree {degree} is tabulated for {self.name}, the "
                f"highest is {max(rules)}. Ask for that, or split the cell."
            )
        return rules[min(fitting)]

    def mass_quadrature(self):
        """A Gauss rule of the unit cube collapsed onto the simplex."""
        highest = max([self.order, *map(len, self.bubbles)])
        x, w = np.polynomial.legendre.leggauss(highest + 2)
        axes = np.meshgrid(*[(x + 1) / 2] * self.dim, indexing="ij")
        weights = np.prod(np.meshgrid(*[w / 2] * self.dim, indexing="ij"), axis=0)
        left, at = np.ones_like(weights), []
        for axis, u in enumerate(axes):
            at.append(u * left)
            weights = weights * (1 - u) ** (self.dim - 1 - axis)
            left = left * (1 - u)
        return Quadrature(np.stack([a.ravel() for a in at], axis=1), weights.ravel())

    def depth(self, at):
        return np.minimum(at.min(axis=-1), 1 - at.sum(axis=-1))

    def stress_points(self):
        return self.quadrature(self.order).points


class Tri3(AbstractSimplex):
    """Linear triangle."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 3
    num_corners: ClassVar[int] = 3
    order: ClassVar[int] = 1
    facets: ClassVar[Facets] = ((0, 1), (1, 2), (2, 0))
    stiffness_degree: ClassVar[int] = 1
    cell_type: ClassVar[str | None] = "triangle"


class Tri6(AbstractSimplex):
    """Quadratic triangle; sides may be curved."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 6
    num_corners: ClassVar[int] = 3
    order: ClassVar[int] = 2
    facets: ClassVar[Facets] = ((0, 1, 3), (1, 2, 4), (2, 0, 5))
    stiffness_degree: ClassVar[int] = 4
    cell_type: ClassVar[str | None] = "triangle6"


class Tri7(AbstractSimplex):
    """Quadratic triangle with a node at its centre: quadratic functions and a bubble."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 7
    num_corners: ClassVar[int] = 3
    order: ClassVar[int] = 2
    facets: ClassVar[Facets] = Tri6.facets
    bubbles: ClassVar[Facets] = ((0, 1, 2),)
    stiffness_degree: ClassVar[int] = 4
    cell_type: ClassVar[str | None] = None
    pressure_order: ClassVar[int | None] = 1
    plain: ClassVar[AbstractElement | None] = Tri6()


class Tet4(AbstractSimplex):
    """Linear tetrahedron."""

    dim: ClassVar[int] = 3
    num_nodes: ClassVar[int] = 4
    num_corners: ClassVar[int] = 4
    order: ClassVar[int] = 1
    facets: ClassVar[Facets] = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
    facet_element: ClassVar[AbstractElement | None] = Tri3()
    stiffness_degree: ClassVar[int] = 1
    cell_type: ClassVar[str | None] = "tetra"


class Tet10(AbstractSimplex):
    """Quadratic tetrahedron; mid-sides of (0,1), (1,2), (2,0), (0,3), (1,3), (2,3)."""

    dim: ClassVar[int] = 3
    num_nodes: ClassVar[int] = 10
    num_corners: ClassVar[int] = 4
    order: ClassVar[int] = 2
    facets: ClassVar[Facets] = (
        (0, 2, 1, 6, 5, 4),
        (0, 1, 3, 4, 8, 7),
        (1, 2, 3, 5, 9, 8),
        (0, 3, 2, 7, 9, 6),
    )
    facet_element: ClassVar[AbstractElement | None] = Tri6()
    stiffness_degree: ClassVar[int] = 2
    cell_type: ClassVar[str | None] = "tetra10"


class Tet15(AbstractSimplex):
    """Quadratic tetrahedron with nodes in its faces, then one at its centre."""

    dim: ClassVar[int] = 3
    num_nodes: ClassVar[int] = 15
    num_corners: ClassVar[int] = 4
    order: ClassVar[int] = 2
    facets: ClassVar[Facets] = tuple(
        (*facet, 10 + number) for number, facet in enumerate(Tet10.facets)
    )
    bubbles: ClassVar[Facets] = (*(facet[:3] for facet in Tet10.facets), (0, 1, 2, 3))
    facet_element: ClassVar[AbstractElement | None] = Tri7()
    stiffness_degree: ClassVar[int] = 5
    cell_type: ClassVar[str | None] = None
    pressure_order: ClassVar[int | None] = 1
    plain: ClassVar[AbstractElement | None] = Tet10()


def _barycentric(at: np.ndarray) -> np.ndarray:
    return np.concatenate([1 - at.sum(axis=1, keepdims=True), at], axis=1)


def _basis(element: AbstractSimplex, at: np.ndarray) -> np.ndarray:
    """Quadratic functions, then bubbles: a basis that is not nodal yet."""
    L = _barycentric(at)
    sides = [4 * L[:, i] * L[:, j] for i, j in side_ends(element)]
    bubbles = [3.0 ** len(k) * np.prod(L[:, list(k)], axis=1) for k in element.bubbles]
    return np.concatenate([L * (2 * L - 1), np.stack(sides + bubbles, axis=1)], axis=1)


@cache
def _nodal(element: AbstractSimplex) -> np.ndarray:
    """Coefficients that make the basis one at a node and zero at the others."""
    return np.linalg.inv(_basis(element, element.nodes()))


def _product_slope(L, slope, factors: tuple[int, ...], scale: float) -> np.ndarray:
    others = [np.prod(L[:, [j for j in factors if j != i]], axis=1) for i in factors]
    return scale * np.stack(others, axis=1) @ slope[list(factors)]


def _orbits(dim: int, *orbits: tuple[tuple[float, ...], float]) -> Quadrature:
    """The rule whose points are all permutations of barycentric coordinates.

    Weights are shares of the cell.
    """
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
