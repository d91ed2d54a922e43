"""Meshes: cells by quality, region, facet set or any field; in the plane and in space."""

from typing import Any

import numpy as np
from jaxtyping import Float

from sorojax.mesh import Mesh, boundary_facets
from sorojax.mesh.quality import cell_ratios
from sorojax.view import style
from sorojax.view.picture import Picture
from sorojax.view.raster.camera import View
from sorojax.view.raster.plane import loops
from sorojax.view.raster.scene import Dots, Lines, Part, Scale, Scene, Surface, robust_scale
from sorojax.view.raster.shell import Shell, on_triangles, outline, shell
from sorojax.view.show import show_scene

_PALE = 0.55  # how far the colours of regions are mixed with white


def show_cells(
    mesh: Mesh,
    *,
    by: str | None = None,
    field: Float[Any, " values"] | None = None,
    label: str = "",
    limits: tuple[float, float] | None = None,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
) -> Picture:
    """The cells of a mesh; of a solid one those at its boundary.

    Args:
        mesh: What to draw.
        by: "quality", "region", "facets" or "nodes" to colour what has a name; plain if
            omitted.
        field: One value per node or per cell, instead of `by`.
        label: Name and unit of the field.
        limits: Ends of the colour scale.
        view: Camera of a solid mesh.
        renderer: Of a solid mesh.
        title: Title; the kind and number of cells if omitted.
    """
    scene = mesh_scene(mesh, by=by, field=field, label=label, limits=limits, title=title)
    return show_scene(scene, view=view, renderer=renderer)


def mesh_scene(
    mesh: Mesh,
    *,
    by: str | None = None,
    field: Float[Any, " values"] | None = None,
    label: str = "",
    limits: tuple[float, float] | None = None,
    title: str = "",
) -> Scene:
    """As `show_cells`, before it is drawn."""
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
        values, _ = on_triangles(mesh, seen, np.asarray(field))
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


def edge_lines(
    mesh: Mesh, points: np.ndarray, ends: np.ndarray | None = None, **look: Any
) -> Lines:
    """The edges that tell the shape of a mesh whose nodes are at `points` [m]; `ends` is
    `outline(mesh)`, found once for many."""
    ends = outline(mesh) if ends is None else ends
    if not len(ends):
        ends = np.zeros((1, 2), int)
    return Lines(list(points[ends]), **look)


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
            parts.append(Surface(points, seen.triangles[at], _colour(k, pale=True),
                                 wire=seen.wire[at], name=name))  # fmt: skip
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
    corners = points[triangles] + 1.5e-3 * size * normals
    count = len(triangles)
    return Surface(
        corners.reshape(-1, 3),
        np.arange(3 * count).reshape(-1, 3),
        colour,
        wire=wire,
        name=name,
    )


def _keys(facets: np.ndarray) -> np.ndarray:
    """One number for each facet, whatever the order of its nodes."""
    least = np.sort(facets, axis=1).astype(np.int64)
    size = np.int64(1) << 21
    return (least[:, 0] * size + least[:, 1]) * size + least[:, min(2, least.shape[1] - 1)]


def _colour(k: int, pale: bool = False) -> str:
    from matplotlib.colors import to_hex, to_rgb

    colour = np.array(to_rgb(style.COLOURS[k % len(style.COLOURS)]))
    return to_hex(tuple((1 - _PALE) * colour + _PALE if pale else colour))
