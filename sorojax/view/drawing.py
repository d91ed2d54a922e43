"""From a plane mesh to what a drawing library takes: triangles, outlines, paths [mm]."""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from sorojax.mesh import Mesh
from sorojax.view.shell import shell

if TYPE_CHECKING:
    from matplotlib.path import Path as Outline

_RINGS = {
    "Tri6": (0, 3, 1, 4, 2, 5), "Tri7": (0, 3, 1, 4, 2, 5),
    "Quad8": (0, 4, 1, 5, 2, 6, 3, 7), "Quad9": (0, 4, 1, 5, 2, 6, 3, 7),
}  # fmt: skip


def flat_triangles(where: str, mesh: Mesh) -> Int[np.ndarray, "triangles 3"]:
    """Node numbers of flat triangles that cover the cells of a plane mesh."""
    if mesh.element.dim != 2:
        raise ValueError(
            f"{where}: got a mesh of {mesh.element.name}, need a plane one. Draw it with "
            "view.show."
        )
    return shell(mesh).triangles


def cell_rings(mesh: Mesh) -> Int[np.ndarray, "cells cell_nodes"]:
    """Nodes around each cell in order, mid-side nodes between the corners."""
    cells = np.asarray(mesh.cells)
    ring = _RINGS.get(mesh.element.name)
    return cells if ring is None else cells[:, list(ring)]


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
