"""The triangles that cover a mesh: its cells in the plane, its boundary in space."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from sorojax.mesh import Mesh, PolyN, valences
from sorojax.mesh.elements.elements import facet_element
from sorojax.mesh.mesh import facet_table

Template = tuple[tuple[tuple[int, int, int], tuple[bool, bool, bool]], ...]

_T, _F = True, False
_TEMPLATES: dict[str, Template] = {
    "Tri3": (((0, 1, 2), (_T, _T, _T)),),
    "Tri6": (
        ((0, 3, 5), (_T, _F, _T)), ((3, 1, 4), (_T, _T, _F)),
        ((5, 4, 2), (_F, _T, _T)), ((3, 4, 5), (_F, _F, _F)),
    ),
    "Tri7": tuple(((a, b, 6), (_T, _F, _F)) for a, b in
                  ((0, 3), (3, 1), (1, 4), (4, 2), (2, 5), (5, 0))),
    "Quad4": (((0, 1, 2), (_T, _T, _F)), ((0, 2, 3), (_F, _T, _T))),
    "Quad8": (
        *(((b, k, a), (_T, _T, _F)) for k, a, b in
          ((0, 4, 7), (1, 5, 4), (2, 6, 5), (3, 7, 6))),
        ((4, 5, 6), (_F, _F, _F)), ((4, 6, 7), (_F, _F, _F)),
    ),
    "Quad9": tuple(((a, b, 8), (_T, _F, _F)) for a, b in
                   ((0, 4), (4, 1), (1, 5), (5, 2), (2, 6), (6, 3), (3, 7), (7, 0))),
}  # fmt: skip


class Shell(NamedTuple):
    """What is seen of a mesh.

    Attributes:
        triangles: Node numbers.
        cells: The cell that each belongs to.
        wire: Which sides are sides of cells.
        facets: Row of `boundary_facets` that each belongs to; empty in the plane.
    """

    triangles: Int[np.ndarray, "triangles 3"]
    cells: Int[np.ndarray, " triangles"]
    wire: Bool[np.ndarray, "triangles 3"]
    facets: Int[np.ndarray, " triangles"]


def shell(mesh: Mesh) -> Shell:
    """Flat triangles over the cells of a plane mesh or the boundary of a solid one."""
    if isinstance(mesh.element, PolyN):
        return _fans(np.asarray(mesh.cells), valences(mesh))
    if mesh.element.dim == 2:
        found = _split(mesh.element.name, np.asarray(mesh.cells))
        return Shell(found[0], found[1], found[2], np.zeros(0, int))
    table, first, count, _ = facet_table(mesh)
    outer = np.sort(first[count == 1])
    element = facet_element(mesh.element)
    triangles, facets, wire = _split(element.name, table[outer])
    return Shell(triangles, outer[facets] % mesh.num_cells, wire, facets)


def _split(name: str, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles, the row of each, and its drawn sides; the triangles of a row together."""
    template = _TEMPLATES[name]
    corners = np.array([part for part, _ in template])
    sides = np.array([flags for _, flags in template])
    triangles = rows[:, corners].reshape(-1, 3)
    owner = np.repeat(np.arange(len(rows)), len(template))
    return triangles, owner, np.tile(sides, (len(rows), 1))


def _fans(cells: np.ndarray, corners: np.ndarray) -> Shell:
    count = cells.shape[1] - 2
    middle = np.arange(1, count + 1)
    triangles = np.stack(
        [np.repeat(cells[:, :1], count, 1), cells[:, middle], cells[:, middle + 1]], axis=2
    )
    real = middle[None] + 1 < corners[:, None]
    first = np.broadcast_to(middle == 1, real.shape)
    last = middle[None] + 2 == corners[:, None]
    wire = np.stack([first, np.ones_like(first), last], axis=2)
    owner = np.broadcast_to(np.arange(len(cells))[:, None], real.shape)
    return Shell(triangles[real], owner[real], wire[real], np.zeros(0, int))


def outline(mesh: Mesh, angle: float = 30.0) -> Int[np.ndarray, "sides 2"]:
    """Pairs of nodes that tell the shape: the boundary in the plane; in space the sides of
    the boundary where it turns by more than `angle` [deg]."""
    seen = shell(mesh)
    sides = np.concatenate([seen.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    owner = np.tile(np.arange(len(seen.triangles)), 3)
    keys = np.sort(sides, axis=1) @ np.array([mesh.num_nodes, 1])
    _, first, number, count = np.unique(
        keys, return_index=True, return_inverse=True, return_counts=True
    )
    if mesh.element.dim == 2:
        return sides[first[count == 1]]
    points = np.asarray(mesh.points)
    a, b, c = (points[seen.triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    total = np.zeros((len(first), 3))
    np.add.at(total, number, normal[owner])
    # two normals at an angle t add up to 2 cos(t / 2)
    bent = (count == 2) & (np.linalg.norm(total, axis=1) < 2 * np.cos(np.deg2rad(angle) / 2))
    return sides[first[bent | (count == 1)]]


def on_triangles(mesh: Mesh, seen: Shell, field: np.ndarray) -> tuple[np.ndarray, bool]:
    """A field per node as it is, one per cell as one value per triangle; whether per node.

    Raises:
        ValueError: If its length is neither.
    """
    field = np.asarray(field)
    if field.shape == (mesh.num_nodes,):
        return field, True
    if field.shape == (mesh.num_cells,):
        return field[seen.cells], False
    raise ValueError(
        f"view: `field` has shape {field.shape}, need one value per node, "
        f"({mesh.num_nodes},), or per cell, ({mesh.num_cells},)."
    )
