"""Quadrilaterals and hexahedra: they fill [-1, 1] on each axis."""

from itertools import product
from typing import ClassVar

import numpy as np

from sorojax.mesh.elements.base import AbstractElement, Facets, Quadrature, side_ends

_SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_CUBE = np.concatenate(
    [np.concatenate([_SQUARE, np.full((4, 1), z)], axis=1) for z in (-1.0, 1.0)]
)


class AbstractHypercube(AbstractElement):
    """A quadrilateral or hexahedron; Gauss rules are products of those of a line.

    Its functions are products of linear ones of each axis where it defines no others.
    """

    def linear(self):
        return Quad4() if self.dim == 2 else Hex8()

    def shape_functions(self, at):
        return np.prod(1 + at[:, None] * self._corners(), axis=2) / 2**self.dim

    def shape_gradients(self, at):
        corners, slopes = self._corners(), []
        factors = 1 + at[:, None] * corners
        for i in range(self.dim):
            others = np.prod(np.delete(factors, i, axis=2), axis=2)
            slopes.append(corners[:, i] * others / 2**self.dim)
        return np.stack(slopes, axis=2)

    def _corners(self) -> np.ndarray:
        return _SQUARE if self.dim == 2 else _CUBE

    def nodes(self):
        corners = self._corners()
        middles = [corners[list(ends)].mean(0)[None] for ends in side_ends(self)]
        inner = np.zeros((self.num_nodes - len(corners) - len(middles), self.dim))
        return np.concatenate([corners, *middles, inner])

    def quadrature(self, degree):
        x, w = np.polynomial.legendre.leggauss(degree // 2 + 1)
        points = np.stack(np.meshgrid(*[x] * self.dim, indexing="ij"), -1)
        weights = np.prod(np.stack(np.meshgrid(*[w] * self.dim, indexing="ij"), -1), -1)
        return Quadrature(points.reshape(-1, self.dim), weights.ravel())

    def mass_quadrature(self):
        return self.quadrature(2 * self.order + 3)

    def depth(self, at):
        return 1 - np.abs(at).max(axis=-1)

    def stress_points(self):
        line = np.array([-1.0, 1.0]) / np.sqrt(3) if self.order == 2 else np.zeros(1)
        return np.array(list(product(line, repeat=self.dim)))


class Quad4(AbstractHypercube):
    """Bilinear quadrilateral."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 4
    num_corners: ClassVar[int] = 4
    order: ClassVar[int] = 1
    facets: ClassVar[Facets] = ((0, 1), (1, 2), (2, 3), (3, 0))
    stiffness_degree: ClassVar[int] = 3
    cell_type: ClassVar[str | None] = "quad"
    pressure_order: ClassVar[int | None] = 0


class Quad8(AbstractHypercube):
    """Serendipity quadrilateral; sides may be curved."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 8
    num_corners: ClassVar[int] = 4
    order: ClassVar[int] = 2
    facets: ClassVar[Facets] = ((0, 1, 4), (1, 2, 5), (2, 3, 6), (3, 0, 7))
    stiffness_degree: ClassVar[int] = 5
    cell_type: ClassVar[str | None] = "quad8"

    def shape_functions(self, at):
        x, y = at[:, :1], at[:, 1:]
        u, v = (1 - x**2) / 2, (1 - y**2) / 2
        middles = [u * (1 - y), v * (1 + x), u * (1 + y), v * (1 - x)]
        bend = at @ _SQUARE.T - 1
        return np.concatenate([super().shape_functions(at) * bend, *middles], axis=1)

    def shape_gradients(self, at):
        x, y = at[:, :1], at[:, 1:]
        u, v = (1 - x**2) / 2, (1 - y**2) / 2
        bend = at @ _SQUARE.T - 1
        corners = super().shape_gradients(at) * bend[..., None]
        corners = corners + super().shape_functions(at)[..., None] * _SQUARE
        along_x = np.concatenate([-x * (1 - y), v, -x * (1 + y), -v], axis=1)
        along_y = np.concatenate([-u, -y * (1 + x), u, -y * (1 - x)], axis=1)
        return np.concatenate([corners, np.stack([along_x, along_y], axis=2)], axis=1)


class Quad9(AbstractHypercube):
    """Biquadratic quadrilateral; the last node is at its centre."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 9
    num_corners: ClassVar[int] = 4
    order: ClassVar[int] = 2
    facets: ClassVar[Facets] = Quad8.facets
    stiffness_degree: ClassVar[int] = 5
    cell_type: ClassVar[str | None] = "quad9"
    pressure_order: ClassVar[int | None] = 1
    plain: ClassVar[AbstractElement | None] = Quad8()

    def shape_functions(self, at):
        return np.prod(self._factors(at), axis=2)

    def shape_gradients(self, at):
        x, of = at[:, None], self.nodes()
        value, slope = self._factors(at), np.where(of == 0, -2 * x, x + of / 2)
        return np.stack([slope[..., 0] * value[..., 1], value[..., 0] * slope[..., 1]], axis=2)

    def _factors(self, at):
        """Factors of the nine functions, one per axis: (points, nodes, 2)."""
        x, of = at[:, None], self.nodes()
        return np.where(of == 0, 1 - x**2, x * (x + of) / 2)


class Hex8(AbstractHypercube):
    """Trilinear hexahedron: bottom face counter-clockwise from above, then the top."""

    dim: ClassVar[int] = 3
    num_nodes: ClassVar[int] = 8
    num_corners: ClassVar[int] = 8
    order: ClassVar[int] = 1
    facets: ClassVar[Facets] = (
        (0, 3, 2, 1),
        (4, 5, 6, 7),
        (0, 1, 5, 4),
        (1, 2, 6, 5),
        (2, 3, 7, 6),
        (3, 0, 4, 7),
    )
    facet_element: ClassVar[AbstractElement | None] = Quad4()
    stiffness_degree: ClassVar[int] = 3
    cell_type: ClassVar[str | None] = "hexahedron"
    pressure_order: ClassVar[int | None] = 0
