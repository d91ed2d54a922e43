"""Meshes: cells by quality, region, facet set or any field; in the plane and in space.

The triangles that cover a mesh, its cells in the plane, its boundary in space, and bodies of
meshes in any state.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sorojax.mesh import Mesh, PolyN, boundary_facets
from sorojax.mesh.elements.base import (
    AbstractElement,
    facet_element,
    flat_triangles,
    outline_nodes,
)
from sorojax.mesh.mesh import facet_table, valences
from sorojax.mesh.quality import Quality, cell_ratios
from sorojax.mesh.repair import Repaired
from sorojax.view import style
from sorojax.view.picture import Picture, plotted
from sorojax.view.raster.plane import loops
from sorojax.view.raster.scene import Dots, Lines, Part, Scale, Scene, Surface, robust_scale


class Shell(NamedTuple):
    """The visible part of a mesh.

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
        found = _split(mesh.element, np.asarray(mesh.cells))
        return Shell(found[0], found[1], found[2], np.zeros(0, int))
    table, first, count, _ = facet_table(mesh)
    outer = np.sort(first[count == 1])
    triangles, facets, wire = _split(facet_element(mesh.element), table[outer])
    return Shell(triangles, outer[facets] % mesh.num_cells, wire, facets)


def _split(
    element: AbstractElement, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles, the row of each, and its drawn sides; the triangles of a row together."""
    corners, ring = flat_triangles(element), outline_nodes(element)
    pairs = set(zip(ring, [*ring[1:], ring[0]], strict=True))
    ends = [zip(part, np.roll(part, -1), strict=True) for part in corners.tolist()]
    sides = np.array([[(a, b) in pairs for a, b in part] for part in ends])
    triangles = rows[:, corners].reshape(-1, 3)
    owner = np.repeat(np.arange(len(rows)), len(corners))
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


def on_triangles(mesh: Mesh, seen: Shell, field: np.ndarray) -> np.ndarray:
    """A field per node as it is, one per cell as one value per triangle.

    Raises:
        ValueError: If its length is neither.
    """
    field = np.asarray(field)
    if field.shape == (mesh.num_nodes,):
        return field
    if field.shape == (mesh.num_cells,):
        return field[seen.cells]
    raise ValueError(
        f"view: `field` has shape {field.shape}, need one value per node, "
        f"({mesh.num_nodes},), or per cell, ({mesh.num_cells},)."
    )


class Body:
    """A mesh to be drawn in many states: its triangles and the sides that tell its shape are
    found once."""

    def __init__(self, mesh: Mesh):
        self.mesh, self.shell, self.sides = mesh, shell(mesh), outline(mesh)

    def edges(self, points: Float[np.ndarray, "nodes dim"], colour: str, width: float) -> Lines:
        """The sides, with the nodes at `points` [m]."""
        sides = self.sides if len(self.sides) else np.zeros((1, 2), int)
        return Lines(list(points[sides]), colour, width)

    def parts(
        self,
        points: Float[np.ndarray, "nodes dim"],
        values: Float[np.ndarray, " values"] | None = None,
        *,
        rest: Float[np.ndarray, "nodes dim"] | None = None,
        wire: bool = False,
    ) -> list[Part]:
        """The body with its nodes at `points` [m], coloured by a value per node or per cell,
        and its outline at `rest`."""
        if values is not None:
            values = on_triangles(self.mesh, self.shell, values)
        cells = self.shell.wire if wire else None
        parts: list[Part] = [
            Surface(points, self.shell.triangles, values=values, wire=cells),
            self.edges(points, style.INK, 0.7),
        ]
        return parts if rest is None else [self.edges(rest, style.GREY, 0.8), *parts]

    def mode(
        self,
        base: Float[np.ndarray, "nodes dim"],
        shape: Float[np.ndarray, "nodes dim"],
        share: float,
    ) -> Scene:
        """A mode about `base` [m], its largest displacement `share` of the body."""
        moved, amplitude = scaled_mode(base, shape, share)
        return Scene(tuple(self.parts(base + moved, amplitude, rest=base)), AMPLITUDE)


#: The scale of pictures of modes.
AMPLITUDE = Scale("amplitude [-]", 0.0, 1.0)


def scaled_mode(base: np.ndarray, shape: np.ndarray, share: float):
    """A mode with a largest displacement of `share` of the body, and its amplitude from 0
    to 1."""
    length = np.linalg.norm(shape, axis=1)
    size = float(np.linalg.norm(np.ptp(base, axis=0)))
    return shape * (share * size / length.max()), length / length.max()


# Meshes as pictures: cells by quality, region, facet set or any field


_PALE = 0.55  # how far the colours of regions are mixed with white


def mesh_scene(
    mesh: Mesh,
    *,
    by: str | None = None,
    field: Float[Any, " values"] | None = None,
    label: str = "",
    limits: tuple[float, float] | None = None,
    title: str = "",
) -> Scene:
    """The cells of a mesh; of a solid one those at its boundary.

    Args:
        mesh: What to draw.
        by: "quality", "region", "facets" or "nodes" to colour what has a name; plain if
            omitted.
        field: One value per node or per cell, instead of `by`.
        label: Name and unit of the field.
        limits: Ends of the colour scale.
        title: Title; the kind and number of cells if omitted.
    """
    if by not in (None, "quality", "region", "facets", "nodes"):
        raise ValueError(
            f'view.show: got by={by!r}, need "quality", "region", "facets" or "nodes". Pass '
            "other values as field=."
        )
    seen, points = shell(mesh), np.asarray(mesh.points)
    scale: Scale | None = None
    values, colour = None, style.BODY
    if by == "quality":
        field, label = cell_ratios(mesh), label or "shape of the cell [-], 1 is the best"
        limits = (0.0, 1.0) if limits is None else limits
    if field is not None:
        values = on_triangles(mesh, seen, np.asarray(field))
        scale = robust_scale(label, [values], limits=limits)
    plain: list[Part] = [Surface(points, seen.triangles, colour, values, seen.wire)]
    if by == "region":
        plain = _regions(mesh, seen, points)
    parts = plain + _outlines(mesh, points)
    if by == "facets":
        parts += _facet_sets(mesh, points, seen)
    if by == "nodes":
        parts += [
            Dots(points[np.asarray(ids)], _colour(k), 4.0, name)
            for k, (name, ids) in enumerate(mesh.node_sets.items())
        ]
    count = f"{mesh.num_cells} cells {mesh.element.name}, {mesh.num_nodes} nodes"
    return Scene(tuple(parts), scale, title or count)


def _outlines(mesh: Mesh, points: np.ndarray) -> list[Part]:
    if mesh.element.dim == 3:
        return []
    rings = loops(boundary_facets(mesh))
    return [Lines([points[np.append(ring, ring[0])] for ring in rings], style.INK, 0.9)]


def _regions(mesh: Mesh, seen: Shell, points: np.ndarray) -> list[Part]:
    """One surface per region, what belongs to none in grey."""
    left = np.ones(mesh.num_cells, bool)
    parts: list[Part] = []
    for k, (name, cells) in enumerate(mesh.regions.items()):
        mine = np.zeros(mesh.num_cells, bool)
        mine[np.asarray(cells)] = True
        left &= ~mine
        at = mine[seen.cells]
        if at.any():
            colour, wire = style.pale(_colour(k), _PALE), seen.wire[at]
            parts.append(Surface(points, seen.triangles[at], colour, wire=wire, name=name))
    rest = left[seen.cells]
    if rest.any() or not parts:
        parts.insert(0, Surface(points, seen.triangles[rest], style.BODY, wire=seen.wire[rest]))
    return parts


def _facet_sets(mesh: Mesh, points: np.ndarray, seen: Shell) -> list[Part]:
    """Sets of facets as thick lines, in space as patches a little off the surface."""
    parts: list[Part] = []
    for k, (name, facets) in enumerate(mesh.facet_sets.items()):
        facets, colour = np.asarray(facets), _colour(k)
        if not len(facets):
            continue
        if mesh.element.dim == 2:
            order = [0, 2, 1] if facets.shape[1] == 3 else [0, 1]
            parts.append(Lines(list(points[facets[:, order]]), colour, 2.6, name=name))
            continue
        table = boundary_facets(mesh)
        mine = np.isin(_keys(table), _keys(facets))
        at = mine[seen.facets]
        if at.any():
            parts.append(_lifted(points, seen.triangles[at], seen.wire[at], colour, name))
    return parts


def _lifted(points: np.ndarray, triangles: np.ndarray, wire, colour: str, name: str) -> Surface:
    """A patch so little in front of its surface that only the depth buffer sees it."""
    from sorojax.view.raster.raster import corner_normals

    normals = corner_normals(points, triangles)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    corners = (points[triangles] + 1.5e-3 * size * normals).reshape(-1, 3)
    loose = np.arange(len(corners)).reshape(-1, 3)
    return Surface(corners, loose, colour, wire=wire, name=name)


def _keys(facets: np.ndarray) -> np.ndarray:
    """One number for each facet, whatever the order of its nodes."""
    least = np.sort(facets, axis=1).astype(np.int64)
    size = np.int64(1) << 21
    return (least[:, 0] * size + least[:, 1]) * size + least[:, min(2, least.shape[1] - 1)]


def _colour(k: int) -> str:
    return style.COLOURS[k % len(style.COLOURS)]


def repaired_scene(repaired: Repaired, **options: Any) -> Scene:
    """The mesh that was repaired; options of a mesh."""
    return mesh_scene(repaired.mesh, **options)


def show_quality(found: Quality, *, title: str = "") -> Picture:
    """How many cells have which radius ratio, and the smallest and largest angle."""
    figure = style.new_figure(6.0, 4.0)
    axes = figure.add_subplot()
    counts = np.asarray(found.histogram, float)
    edges = np.linspace(0, 1, len(counts) + 1)
    look: dict[str, Any] = {"color": style.COLOURS[0], "edgecolor": "white"}
    axes.bar(edges[:-1], counts, np.diff(edges), align="edge", **look)
    axes.axvline(found.mean_radius_ratio, color=style.COLOURS[1], lw=1.6, label="mean")
    low, high = np.rad2deg(found.min_angle), np.rad2deg(found.max_angle)
    text = f"{found.num_cells} cells, angles {low:.1f} to {high:.1f} deg"
    style.dress(axes, "radius ratio [-]", "cells", title or text)
    axes.set_xlim(0, 1)
    style.legend(axes, loc="upper left")
    return plotted(figure, [axes])
