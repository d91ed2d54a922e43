"""Shape functions and quadrature of the reference cells. Host arrays: tables, not
computations.

Triangles and tetrahedra have corners at the origin and at distance 1 on each axis,
quadrilaterals and hexahedra fill [-1, 1] on each axis, polygons are regular with their
corners on the unit circle, sides are [-1, 1].

Reference: Hughes, The Finite Element Method, 1987, chapter 3.
"""

from types import ModuleType

import numpy as np
from jaxtyping import Float

from sorojax.mesh.elements import (
    polygon as shape_polygon,
    simplex as shape_simplex,
    tensor as shape_tensor,
)
from sorojax.mesh.elements.elements import AbstractElement, Hex8, PolyN, Quad4, Quad8, Quad9
from sorojax.mesh.elements.simplex import Quadrature as Quadrature


def _family(element: AbstractElement) -> ModuleType:
    if isinstance(element, Quad4 | Quad8 | Quad9 | Hex8):
        return shape_tensor
    return shape_polygon if isinstance(element, PolyN) else shape_simplex


def shape_functions(
    element: AbstractElement, at: Float[np.ndarray, "points dim"]
) -> Float[np.ndarray, "points cell_nodes"]:
    """Values of the shape functions at reference points."""
    return _family(element).shape_functions(element, np.asarray(at, float))


def shape_gradients(
    element: AbstractElement, at: Float[np.ndarray, "points dim"]
) -> Float[np.ndarray, "points cell_nodes dim"]:
    """Derivatives with respect to the reference coordinates."""
    return _family(element).shape_gradients(element, np.asarray(at, float))


def nodes(element: AbstractElement) -> Float[np.ndarray, "cell_nodes dim"]:
    """Reference coordinates of the nodes."""
    return _family(element).nodes(element)


def quadrature(element: AbstractElement, degree: int | None = None) -> Quadrature:
    """A rule for the reference cell with positive weights.

    Without `degree` the one used for stiffness, degree 1 for Tri3 and Tet4, 4 for Tri6
    and Tri7, 2 for Tet10, 5 for Tet15, 3 for Quad4 and Hex8, 5 for Quad8 and Quad9; with
    it the smallest one that is exact for polynomials of that degree.

    Raises:
        ValueError: If no such rule is tabulated.
    """
    return _family(element).quadrature(element, degree)


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
