"""Reference elements: static objects without arrays that know node order and facets.

Corners come first, then mid-side nodes. In the plane corners run counter-clockwise and
a facet is listed as its two corners, domain on the left, then its mid-side node. In
space the fourth corner of a tetrahedron lies on the side to which (1 - 0) x (2 - 0)
points, and a facet lists its corners counter-clockwise as seen from outside. The
order is that of VTK and meshio.
"""

from typing import TYPE_CHECKING, ClassVar

import equinox as eqx

Facets = tuple[tuple[int, ...], ...]


class AbstractElement(eqx.Module):
    """A reference cell."""

    dim: eqx.AbstractClassVar[int]
    order: eqx.AbstractClassVar[int]
    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        num_nodes: ClassVar[int]
        num_corners: ClassVar[int]
        facets: ClassVar[Facets]

    @property
    def name(self) -> str:
        """Name used by messages and files."""
        return type(self).__name__


class Tri3(AbstractElement):
    """Linear triangle."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 3
    num_corners: ClassVar[int] = 3
    order: ClassVar[int] = 1
    facets: ClassVar[Facets] = ((0, 1), (1, 2), (2, 0))


class Tri6(AbstractElement):
    """Quadratic triangle; sides may be curved."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 6
    num_corners: ClassVar[int] = 3
    order: ClassVar[int] = 2
    facets: ClassVar[Facets] = ((0, 1, 3), (1, 2, 4), (2, 0, 5))


class Tri7(AbstractElement):
    """Quadratic triangle with a node at its centre: quadratic functions and a bubble."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 7
    num_corners: ClassVar[int] = 3
    order: ClassVar[int] = 2
    facets: ClassVar[Facets] = Tri6.facets


class Quad4(AbstractElement):
    """Bilinear quadrilateral."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 4
    num_corners: ClassVar[int] = 4
    order: ClassVar[int] = 1
    facets: ClassVar[Facets] = ((0, 1), (1, 2), (2, 3), (3, 0))


class Quad8(AbstractElement):
    """Serendipity quadrilateral; sides may be curved."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 8
    num_corners: ClassVar[int] = 4
    order: ClassVar[int] = 2
    facets: ClassVar[Facets] = ((0, 1, 4), (1, 2, 5), (2, 3, 6), (3, 0, 7))


class Quad9(AbstractElement):
    """Biquadratic quadrilateral; the last node is at its centre."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 9
    num_corners: ClassVar[int] = 4
    order: ClassVar[int] = 2
    facets: ClassVar[Facets] = Quad8.facets


class PolyN(AbstractElement):
    """Convex polygon of at most `sides` corners.

    A cell with fewer corners repeats its last node up to `sides` entries, so sums over
    sides (area, centroid) need no mask; `valences` counts the corners.
    """

    sides: int = eqx.field(static=True)
    dim: ClassVar[int] = 2
    order: ClassVar[int] = 1

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


class Tet4(AbstractElement):
    """Linear tetrahedron."""

    dim: ClassVar[int] = 3
    num_nodes: ClassVar[int] = 4
    num_corners: ClassVar[int] = 4
    order: ClassVar[int] = 1
    facets: ClassVar[Facets] = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))


class Tet10(AbstractElement):
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


class Tet15(AbstractElement):
    """Quadratic tetrahedron with nodes in its faces, then one at its centre."""

    dim: ClassVar[int] = 3
    num_nodes: ClassVar[int] = 15
    num_corners: ClassVar[int] = 4
    order: ClassVar[int] = 2
    facets: ClassVar[Facets] = tuple(
        (*facet, 10 + number) for number, facet in enumerate(Tet10.facets)
    )


class Hex8(AbstractElement):
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


def facet_corners(element: AbstractElement) -> int:
    """Corners of a facet: 2 in the plane, 3 or 4 in space."""
    if element.dim == 2:
        return 2
    return 4 if isinstance(element, Hex8) else 3


def facet_element(element: AbstractElement) -> AbstractElement:
    """Element of the facets of a cell in space."""
    return {Tet4: Tri3, Tet10: Tri6, Tet15: Tri7, Hex8: Quad4}[type(element)]()
