"""How good the triangles of a mesh are."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.mesh.elements import Tri3, Tri6
from sorojax.mesh.mesh import Mesh


class Quality(NamedTuple):
    """Numbers that tell a good mesh.

    Attributes:
        min_angle: Smallest angle between straight sides [rad].
        mean_radius_ratio: Mean of 2 r_in / r_circ, 1 for equilateral triangles.
        area: Area of all cells [m^2], curved sides included.
        num_nodes: Nodes.
        num_cells: Cells.
    """

    min_angle: float
    mean_radius_ratio: float
    area: float
    num_nodes: int
    num_cells: int

    def __str__(self) -> str:
        return (
            f"{self.num_cells} cells, {self.num_nodes} nodes, area {self.area:.6g} m^2, "
            f"smallest angle {np.rad2deg(self.min_angle):.1f} deg, mean radius ratio "
            f"{self.mean_radius_ratio:.3f}"
        )

    __repr__ = __str__


def quality(mesh: Mesh) -> Quality:
    """Shape numbers of a triangle mesh."""
    x = np.asarray(mesh.points)[np.asarray(mesh.cells)[:, :3]]
    side = np.linalg.norm(np.roll(x, -1, axis=1) - x, axis=2)
    a, b, c = side.T
    cosine = np.stack(
        [
            (b * b + c * c - a * a) / (2 * b * c),
            (c * c + a * a - b * b) / (2 * c * a),
            (a * a + b * b - c * c) / (2 * a * b),
        ]
    )
    angle = np.arccos(np.clip(cosine, -1, 1))
    ratio = (b + c - a) * (c + a - b) * (a + b - c) / (a * b * c)
    total = float(jnp.sum(cell_areas(mesh)))
    return Quality(
        float(angle.min()), float(ratio.mean()), total, mesh.num_nodes, mesh.num_cells
    )


def cell_areas(mesh: Mesh) -> Float[Array, " cells"]:
    """Area of each triangle [m^2], curved sides included; differentiable in the points."""
    if not isinstance(mesh.element, Tri3 | Tri6):
        raise ValueError(
            f"cell_areas: the mesh has {mesh.element.name} cells, need Tri3 or Tri6."
        )
    x = mesh.points[mesh.cells]
    area = _cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) / 2
    for facet in mesh.element.facets if mesh.element.order == 2 else ():
        a, b, middle = (x[:, i] for i in facet)
        # A parabola over a chord encloses two thirds of chord times height.
        area = area + 2 / 3 * _cross(middle - (a + b) / 2, b - a)
    return area


def _cross(a: Float[Array, "cells 2"], b: Float[Array, "cells 2"]) -> Float[Array, " cells"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
