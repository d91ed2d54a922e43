"""A mesh and its mirror image as one mesh, node for node the same on both sides."""

import numpy as np
from jaxtyping import Int

from sorojax.mesh.elements import AbstractElement, PolyN, facet_element
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.shape import nodes as reference_nodes

_SAME = 1e-9  # of the extent: on the plane


def mirrored(mesh: Mesh, axis: int, at: float) -> Mesh:
    """`mesh` with its image behind the plane x[axis] = `at` [m]; both share the nodes on it.

    A mesh without symmetry has no bifurcation, only an imperfection. Nodes on the plane are
    moved onto it, images come after them. Sets hold the images too; facets on the plane,
    which no longer bound anything, leave theirs.

    Raises:
        ValueError: For polygons, or if the mesh reaches across the plane.

    Example:
        `mirrored(mirrored(quarter, 0, 20 * mm), 1, 20 * mm)` is the whole square.
    """
    if isinstance(mesh.element, PolyN):
        raise ValueError("mesh.mirrored: got polygons, need another kind of cells.")
    points = np.array(mesh.points)
    slack = _SAME * float(np.ptp(points, axis=0).max())
    _check_side(points[:, axis] - at, slack)
    shared = np.abs(points[:, axis] - at) <= slack
    points[shared, axis] = at
    image = points[~shared]
    image[:, axis] = 2 * at - image[:, axis]
    number = np.where(shared, np.arange(len(points)), len(points) - 1 + np.cumsum(~shared))
    cells = np.asarray(mesh.cells)
    facets = {name: _facets(mesh, ids, shared, number) for name, ids in mesh.facet_sets.items()}
    return Mesh(
        np.concatenate([points, image]),
        np.concatenate([cells, number[cells[:, turned(mesh.element)]]]),
        mesh.element,
        {name: np.unique(np.concatenate([ids, number[np.asarray(ids)]]))
         for name, ids in mesh.node_sets.items()},
        facets,
        {name: np.concatenate([ids, np.asarray(ids) + len(cells)])
         for name, ids in mesh.regions.items()},
    )  # fmt: skip


def turned(element: AbstractElement) -> Int[np.ndarray, " nodes"]:
    """Order of the nodes in which the mirror image of a cell is a cell."""
    here = reference_nodes(element)
    image = here.copy()
    image[:, [0, 1]] = here[:, [1, 0]]
    apart = np.abs(image[:, None] - here[None]).sum(axis=2)
    return apart.argmin(axis=1)


def _facets(mesh: Mesh, ids, shared, number) -> np.ndarray:
    facets = np.asarray(ids)
    facets = facets[~shared[facets].all(axis=1)]
    if mesh.element.dim == 2:
        order = np.array([1, 0, *range(2, facets.shape[1])])
    else:
        order = turned(facet_element(mesh.element))
    return np.concatenate([facets, number[facets[:, order]]])


def _check_side(away: np.ndarray, slack: float) -> None:
    if away.min() < -slack and away.max() > slack:
        raise ValueError(
            f"mesh.mirrored: the mesh reaches from {away.min():.3g} to {away.max():.3g} m "
            "about the plane, need all of it on one side. Mesh one half only."
        )
