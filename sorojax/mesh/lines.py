"""Cells between given lines, and a mesh without some of its cells."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sorojax.mesh.elements import AbstractElement
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.structured import box, rectangle


def between_lines(
    *lines: Float[np.ndarray, " lines"] | Sequence[float], element: AbstractElement
) -> Mesh:
    """Cells between lines across each axis [m]: thin walls, and what lies between, as drawn.

    `between_lines(x, y, element=Quad8())` fills a rectangle, three lists a cuboid. Sets are
    those of `rectangle` and `box`.

    Raises:
        ValueError: If a list does not rise, or the element does not fit.
    """
    places = [np.asarray(line, float) for line in lines]
    if len(places) != element.dim or any(
        p.ndim != 1 or len(p) < 2 or np.any(np.diff(p) <= 0) for p in places
    ):
        raise ValueError(
            f"mesh.between_lines: got {len(places)} lists for {element.name}, need "
            f"{element.dim}, each of two or more rising numbers. np.unique sorts them."
        )
    counts: Any = tuple(len(p) - 1 for p in places)
    make: Any = rectangle if element.dim == 2 else box
    grid = make([0.0] * element.dim, counts, divisions=counts, element=element)
    steps = np.asarray(grid.points).T
    points = [np.interp(s, np.arange(len(p)), p) for s, p in zip(steps, places, strict=True)]
    return Mesh(
        np.stack(points, axis=1), grid.cells, element, grid.node_sets, grid.facet_sets
    )  # fmt: skip


def kept(mesh: Mesh, cells: Int[np.ndarray, " kept"]) -> Mesh:
    """The mesh with the listed cells only, and the nodes that they use.

    Node sets and regions keep what is left of them; facet sets, whose facets may have gone,
    are dropped: choose facets anew with `facets_where` or `facets_on`.
    """
    chosen = np.asarray(cells)
    if not len(chosen):
        raise ValueError("mesh.kept: got no cells, need one or more.")
    used, inverse = np.unique(np.asarray(mesh.cells)[chosen], return_inverse=True)
    node_sets = {
        name: np.flatnonzero(np.isin(used, np.asarray(ids)))
        for name, ids in mesh.node_sets.items()
    }
    regions = {
        name: np.flatnonzero(np.isin(chosen, np.asarray(ids)))
        for name, ids in mesh.regions.items()
    }
    points = np.asarray(mesh.points)[used]
    return Mesh(points, inverse.reshape(len(chosen), -1), mesh.element, node_sets, {}, regions)
