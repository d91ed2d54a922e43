"""What an element is: a reference cell with its nodes, shape functions and quadrature.

Corners come first, then mid-side nodes, then nodes inside faces and cells. In the plane
corners run counter-clockwise and a facet is listed as its two corners, domain on the left,
then its mid-side node. In space a facet lists its corners counter-clockwise as seen from
outside, then the middles of its sides in this order, then its centre. The order is that of
VTK and meshio. Tables are host arrays.

A new element is a class in the file of its family (`simplex`, `tensor`, `polygon`), exported
by `sorojax.mesh`; nothing else names the elements one by one.

Reference: Hughes, The Finite Element Method, 1987, chapter 3.
"""

import abc
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

Facets = tuple[tuple[int, ...], ...]


class Quadrature(NamedTuple):
    """Points and weights of a rule; the weights add up to the size of the reference cell."""

    points: Float[np.ndarray, "quad dim"]
    weights: Float[np.ndarray, " quad"]


class AbstractElement(eqx.Module):
    """A reference cell: a static object without arrays.

    Attributes:
        dim: Axes, 2 or 3.
        order: Degree of the polynomials that the shape functions hold.
        stiffness_degree: Degree that the quadrature of the stiffness is exact for.
        cell_type: Name of the cell in VTK and meshio; `None` if files hold it as `plain`.
        pressure_order: Degree of the pressures, discontinuous between cells, that the
            element carries in nearly incompressible materials by default; `None` if none.
        plain: The element without the nodes inside faces and cells, where it has such nodes.
        facet_element: Element of the facets of a solid cell.
        num_nodes: Nodes of a cell.
        num_corners: Corners of a cell.
        facets: Numbers of the nodes of each facet.
    """

    dim: eqx.AbstractClassVar[int]
    order: eqx.AbstractClassVar[int]
    stiffness_degree: eqx.AbstractClassVar[int]
    cell_type: eqx.AbstractClassVar[str | None]
    pressure_order: ClassVar[int | None] = None
    plain: ClassVar["AbstractElement | None"] = None
    facet_element: ClassVar["AbstractElement | None"] = None
    if TYPE_CHECKING:  # properties of polygons
        num_nodes: ClassVar[int]
        num_corners: ClassVar[int]
        facets: ClassVar[Facets]

    @property
    def name(self) -> str:
        """Name used by messages and files."""
        return type(self).__name__

    @abc.abstractmethod
    def linear(self) -> "AbstractElement":
        """The element with the same corners and no other nodes."""

    @abc.abstractmethod
    def nodes(self) -> Float[np.ndarray, "cell_nodes dim"]:
        """Reference coordinates of the nodes."""

    @abc.abstractmethod
    def shape_functions(
        self, at: Float[np.ndarray, "points dim"]
    ) -> Float[np.ndarray, "points cell_nodes"]:
        """Values of the shape functions at reference points."""

    @abc.abstractmethod
    def shape_gradients(
        self, at: Float[np.ndarray, "points dim"]
    ) -> Float[np.ndarray, "points cell_nodes dim"]:
        """Derivatives with respect to the reference coordinates."""

    @abc.abstractmethod
    def quadrature(self, degree: int) -> Quadrature:
        """The smallest rule with positive weights that is exact for that degree."""

    @abc.abstractmethod
    def mass_quadrature(self) -> Quadrature:
        """A rule exact for products of two shape functions and a radius, on straight cells."""

    @abc.abstractmethod
    def depth(self, at: Float[np.ndarray, "*points dim"]) -> Float[np.ndarray, "*points"]:
        """How far reference points lie inside the cell; negative outside."""

    @abc.abstractmethod
    def stress_points(self) -> Float[np.ndarray, "samples dim"]:
        """Points of reduced integration, where stresses are the most accurate."""


def exported_elements() -> list[type[AbstractElement]]:
    """The element classes that `sorojax.mesh` exports."""
    import sorojax.mesh

    kinds = [kind for kind in vars(sorojax.mesh).values() if isinstance(kind, type)]
    return [k for k in kinds if issubclass(k, AbstractElement) and k is not AbstractElement]


def shape_functions(
    element: AbstractElement, at: Float[np.ndarray, "points dim"]
) -> Float[np.ndarray, "points cell_nodes"]:
    """Values of the shape functions at reference points."""
    return element.shape_functions(np.asarray(at, float))


def shape_gradients(
    element: AbstractElement, at: Float[np.ndarray, "points dim"]
) -> Float[np.ndarray, "points cell_nodes dim"]:
    """Derivatives with respect to the reference coordinates."""
    return element.shape_gradients(np.asarray(at, float))


def nodes(element: AbstractElement) -> Float[np.ndarray, "cell_nodes dim"]:
    """Reference coordinates of the nodes."""
    return element.nodes()


def quadrature(element: AbstractElement, degree: int | None = None) -> Quadrature:
    """A rule for the reference cell with positive weights.

    Without `degree` the one used for the stiffness (`element.stiffness_degree`); with it the
    smallest one that is exact for polynomials of that degree.

    Raises:
        ValueError: If no such rule is tabulated.
    """
    return element.quadrature(element.stiffness_degree if degree is None else degree)


def facet_element(element: AbstractElement) -> AbstractElement:
    """Element of the facets of a cell in space.

    Raises:
        ValueError: If the cell is plane.
    """
    if element.facet_element is None:
        raise ValueError(
            f"facet_element: {element.name} is plane, need a solid element: the sides of a "
            "plane cell are lines. Use side_functions."
        )
    return element.facet_element


def facet_corners(element: AbstractElement) -> int:
    """Corners of a facet: 2 in the plane, 3 or 4 in space."""
    return 2 if element.dim == 2 else facet_element(element).num_corners


def side_ends(element: AbstractElement) -> list[tuple[int, int]]:
    """The two corners beside each mid-side node of a quadratic element."""
    count, found = facet_corners(element), {}
    for facet in element.facets:
        corners, middles = facet[:count], facet[count : 2 * count]
        after = (*corners[1:], corners[0])
        for a, b, middle in zip(corners, after, middles, strict=False):  # one in the plane
            found[middle] = (min(a, b), max(a, b))
    return [found[node] for node in sorted(found)]


def mirror_order(element: AbstractElement) -> Int[np.ndarray, " nodes"]:
    """Order of the nodes in which the mirror image of a cell is a cell."""
    here = nodes(element)
    image = here.copy()
    image[:, [0, 1]] = here[:, [1, 0]]
    apart = np.abs(image[:, None] - here[None]).sum(axis=2)
    return apart.argmin(axis=1)


def outline_nodes(element: AbstractElement) -> list[int]:
    """Nodes around a plane cell, mid-side nodes between the corners."""
    return [node for side in element.facets for node in (side[0], *side[2:])]


def flat_triangles(element: AbstractElement) -> Int[np.ndarray, "triangles 3"]:
    """Triangles through the nodes of a plane cell that cover it: a fan around the node inside
    or, without one, at each corner the triangle up to the mid-side nodes and a fan of what
    is left."""
    ring = outline_nodes(element)
    after = [*ring[1:], ring[0]]
    if element.num_nodes > len(ring):
        return np.array([(a, b, len(ring)) for a, b in zip(ring, after, strict=True)])
    cut = []
    if element.order > 1:
        ears = zip(ring[::2], ring[1::2], [ring[-1], *ring[1:-1:2]], strict=True)
        cut = [np.roll(ear, number) for number, ear in enumerate(ears)]
        ring = ring[1::2]
    fan = [(ring[0], ring[k], ring[k + 1]) for k in range(1, len(ring) - 1)]
    return np.array([*cut, *fan])


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
