"""Convex polygons: Wachspress functions on the regular polygon in the unit circle.

The number of corners is that of the element: a padded cell of n corners takes the
tables of `PolyN(n)`.

Reference: Talischi, Paulino, Pereira, Menezes, PolyTop, SMO 45, 2012, section 4.
"""

from typing import ClassVar

import equinox as eqx
import numpy as np

from sorojax.mesh.elements.base import AbstractElement, Facets, Quadrature
from sorojax.mesh.elements.simplex import Tri3


class PolyN(AbstractElement):
    """Convex polygon of at most `sides` corners.

    A cell with fewer corners repeats its last node up to `sides` entries, so sums over
    sides (area, centroid) need no mask; `valences` counts the corners.
    """

    sides: int = eqx.field(static=True)
    dim: ClassVar[int] = 2
    order: ClassVar[int] = 1
    stiffness_degree: ClassVar[int] = 2
    cell_type: ClassVar[str | None] = "polygon"
    pressure_order: ClassVar[int | None] = 0

    @property
    def num_nodes(self) -> int:
        return self.sides

    @property
    def num_corners(self) -> int:
        return self.sides

    @property
    def facets(self) -> Facets:
        return tuple((i, (i + 1) % self.sides) for i in range(self.sides))

    @property
    def name(self) -> str:
        return f"Poly{self.sides}"

    def linear(self):
        return self

    def nodes(self):
        angle = 2 * np.pi * np.arange(self.sides) / self.sides
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def shape_functions(self, at):
        weight = self._weights(at)[0]
        return weight / weight.sum(axis=1, keepdims=True)

    def shape_gradients(self, at):
        weight, slope = self._weights(at)
        total = weight.sum(axis=1)[:, None, None]
        N = weight[..., None] / total
        return slope / total - N * slope.sum(axis=1, keepdims=True) / total

    def quadrature(self, degree):
        """Rules of the triangles between the centre and the sides."""
        rule, corners = Tri3().quadrature(degree), self.nodes()
        after = np.roll(corners, -1, axis=0)
        r, s = rule.points[:, :1], rule.points[:, 1:]
        points = np.concatenate([r * a + s * b for a, b in zip(corners, after, strict=True)])
        doubled = np.sin(2 * np.pi / self.sides)
        return Quadrature(points, np.tile(rule.weights * doubled, self.sides))

    def mass_quadrature(self):
        """The rule of the stiffness: no rule is exact for rational functions."""
        return self.quadrature(self.stiffness_degree)

    def depth(self, at):
        normal, reach = self._sides()
        return (reach - at @ normal.T).min(axis=-1)

    def stress_points(self):
        return self.quadrature(self.order).points

    def _sides(self) -> tuple[np.ndarray, float]:
        """Outward normals of the sides, and how far the sides are from the centre."""
        corners, reach = self.nodes(), np.cos(np.pi / self.sides)
        return (corners + np.roll(corners, -1, axis=0)) / 2 / reach, reach

    def _weights(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Wachspress weights times all side distances: polynomials, finite on the sides too.

        On a regular polygon the weight of a corner is the product of the distances to all
        sides that do not touch it.
        """
        n, (normal, reach) = self.sides, self._sides()
        distance = reach - at @ normal.T
        away = [[k for k in range(n) if k not in (i, (i - 1) % n)] for i in range(n)]
        weight = np.stack([np.prod(distance[:, k], axis=1) for k in away], axis=1)
        slope = np.zeros((len(at), n, 2))
        for i, sides in enumerate(away):
            for k in sides:
                rest = np.prod(distance[:, [j for j in sides if j != k]], axis=1)
                slope[:, i] -= rest[:, None] * normal[k]
        return weight, slope
