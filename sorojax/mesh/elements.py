"""Reference elements: leafless markers that carry node order and facets.

Corners come first, counter-clockwise, then mid-side nodes in the order of the
sides (0, 1), (1, 2), (2, 0). A facet is listed as its two corners, domain on the
left, followed by its mid-side node where there is one.
"""

import abc
from typing import ClassVar

import equinox as eqx


class AbstractElement(eqx.Module):
    """A reference cell."""

    dim: eqx.AbstractClassVar[int]
    num_nodes: eqx.AbstractClassVar[int]
    num_corners: eqx.AbstractClassVar[int]
    order: eqx.AbstractClassVar[int]
    facets: eqx.AbstractClassVar[tuple[tuple[int, ...], ...]]

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Name used by messages and files."""


class Tri3(AbstractElement):
    """Linear triangle."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 3
    num_corners: ClassVar[int] = 3
    order: ClassVar[int] = 1
    facets: ClassVar[tuple[tuple[int, ...], ...]] = ((0, 1), (1, 2), (2, 0))

    @property
    def name(self) -> str:
        return "Tri3"


class Tri6(AbstractElement):
    """Quadratic triangle; sides may be curved."""

    dim: ClassVar[int] = 2
    num_nodes: ClassVar[int] = 6
    num_corners: ClassVar[int] = 3
    order: ClassVar[int] = 2
    facets: ClassVar[tuple[tuple[int, ...], ...]] = ((0, 1, 3), (1, 2, 4), (2, 0, 5))

    @property
    def name(self) -> str:
        return "Tri6"
