"""From a plane mesh to what a drawing library takes: triangles, outlines, paths [mm]."""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from sorojax.mesh import Mesh

if TYPE_CHECKING:
    from matplotlib.path import Path as Outline

_SPLIT = {1: ((0, 1, 2),), 2: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))}


def flat_triangles(where: str, mesh: Mesh) -> Int[np.ndarray, "triangles 3"]:
    """Node numbers of flat triangles that cover the cells; four for a six-node triangle."""
    if mesh.element.dim != 2 or mesh.element.num_corners != 3:
        raise ValueError(
            f"{where}: got a mesh of {mesh.element.name}, need plane triangles. Draw a "
            "section of the body, or its boundary."
        )
    cells = np.asarray(mesh.cells)
    return np.concatenate([cells[:, list(part)] for part in _SPLIT[mesh.element.order]])


def cell_rings(mesh: Mesh) -> Int[np.ndarray, "cells cell_nodes"]:
    """Nodes around each cell in order, mid-side nodes between the corners."""
    cells = np.asarray(mesh.cells)
    return cells if mesh.element.order == 1 else cells[:, [0, 3, 1, 4, 2, 5]]


def loops(facets: Int[Any, "facets facet_nodes"]) -> list[Int[np.ndarray, " nodes"]]:
    """Closed runs of facets as node numbers in order, mid-side nodes in place."""
    facets = np.asarray(facets)
    leaving: dict[int, list[int]] = {}
    for number, start in enumerate(facets[:, 0].tolist()):
        leaving.setdefault(start, []).append(number)
    found = []
    while leaving:
        node, ring = next(iter(leaving)), []
        while node in leaving:
            number = leaving[node].pop()
            if not leaving[node]:
                del leaving[node]
            ring += [facets[number, 0], *facets[number, 2:]]
            node = int(facets[number, 1])
        found.append(np.array(ring))
    return found


def as_path(points: Float[np.ndarray, "nodes 2"], rings: list[np.ndarray]) -> "Outline":
    """Closed rings as one path: holes run the other way round and stay empty."""
    from matplotlib.path import Path as Outline

    codes, corners = [], []
    for ring in rings:
        codes += [Outline.MOVETO, *[Outline.LINETO] * (len(ring) - 1), Outline.CLOSEPOLY]
        corners += [points[ring], points[ring[:1]]]
    return Outline(np.concatenate(corners), codes)


def box(*points: Float[np.ndarray, "... 2"]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the box around all points."""
    flat = [np.asarray(p).reshape(-1, 2) for p in points]
    lower = np.min([p.min(axis=0) for p in flat], axis=0)
    return lower, np.max([p.max(axis=0) for p in flat], axis=0)
