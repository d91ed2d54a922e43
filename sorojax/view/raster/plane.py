"""Plane scenes drawn with matplotlib, in mm."""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from sorojax.view import style
from sorojax.view.raster.scene import Arrows, Dots, Lines, Part, Scale, Scene, Surface

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.path import Path as Outline


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


def plane_figure(scene: Scene, *, width: float = 9.0) -> "tuple[Figure, Axes]":
    """One plane scene with axes, colour bar and names."""
    lower, upper = (1e3 * corner for corner in scene.box)
    figure = style.new_figure(width, style.height_for(width, lower, upper))
    axes = figure.add_subplot()
    draw_plane(axes, scene)
    style.dress_plane(axes, lower, upper)
    if scene.scale is not None:
        bar_beside(figure, axes, scene.scale)
    name_parts(axes, scene)
    if scene.note:
        axes.set_title(scene.note, fontsize=style.LABEL, color=style.INK, loc="left")
    return figure, axes


def draw_plane(axes: "Axes", scene: Scene) -> "list[Artist]":
    """Put every part into `axes`; the artists, in the order they are drawn."""
    made: list[Any] = []
    for part in scene.parts:
        made += _draw(axes, part, scene.scale)
    return made


def bar_beside(figure: "Figure", axes: Any, scale: Scale, **options: Any) -> Any:
    """A colour bar that takes its room from `axes`."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    painted = ScalarMappable(Normalize(scale.low, scale.high), scale.colours)
    look = {"shrink": 0.9, "aspect": 30, "pad": 0.02, "extend": scale.extend} | options
    label = scale.label + ("\n(arrow: the highest 0.5 %)" if scale.extend == "max" else "")
    return style.colour_bar(figure, painted, axes, label, **look)


def name_parts(axes: "Axes", scene: Scene) -> None:
    """A legend of the parts that have names, above the axes."""
    named = [part.name for part in scene.parts if part.name]
    if named:
        above = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2}
        style.legend(axes, ncols=min(len(set(named)), 4), **above)


def _draw(axes: "Axes", part: Part, scale: Scale | None) -> list:
    label = part.name or "_"
    if isinstance(part, Surface):
        return _surface(axes, part, scale, label)
    if isinstance(part, Lines):
        return _lines(axes, part, label)
    if isinstance(part, Dots):
        x, y = 1e3 * part.points.T
        return axes.plot(x, y, "o", color=part.colour, ms=part.size, label=label, mew=0)
    return _arrows(axes, part, label)


def _surface(axes: "Axes", part: Surface, scale: Scale | None, label: str) -> list:
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.patches import PathPatch

    points, triangles = 1e3 * np.asarray(part.points), np.asarray(part.triangles)
    artists: list[Any] = []
    if part.values is not None and scale is not None:
        artists.append(_painted(axes, part, scale))
    elif isinstance(part.colour, str):
        path = as_path(points, loops(rim(triangles)))
        look = {"facecolor": part.colour, "edgecolor": "none", "alpha": part.opacity}
        artists.append(axes.add_patch(PathPatch(path, label=label, **look)))
    else:
        look: dict[str, Any] = {"edgecolors": "face", "linewidths": 0.2, "label": label}
        faces = PolyCollection(list(points[triangles]), facecolors=part.colour, **look)
        artists.append(axes.add_collection(faces, autolim=False))
    if part.wire is not None:
        wire = LineCollection(list(points[part.sides]), colors=style.GREY, linewidths=0.35)
        artists.append(axes.add_collection(wire, autolim=False))
    return artists


def _painted(axes: Any, part: Surface, scale: Scale):
    (x, y), values = 1e3 * np.asarray(part.points).T, np.asarray(part.values)
    look = {"cmap": scale.colours, "vmin": scale.low, "vmax": scale.high, "rasterized": True}
    if part.has_values_per_triangle:
        return axes.tripcolor(x, y, part.triangles, facecolors=values, **look)
    return axes.tripcolor(x, y, part.triangles, values, shading="gouraud", **look)


def _lines(axes: "Axes", part: Lines, label: str) -> list:
    from matplotlib.collections import LineCollection

    runs = [1e3 * np.asarray(run) for run in part.runs]
    dashes: Any = style.DASHES if part.dashed else "solid"
    look: dict[str, Any] = {"capstyle": "round", "joinstyle": "round", "linestyles": dashes}
    made = LineCollection(runs, colors=part.colour, linewidths=part.width, label=label, **look)
    return [axes.add_collection(made, autolim=False)]


def _arrows(axes: "Axes", part: Arrows, label: str) -> list:
    to_scale = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "units": "dots"}
    head = {"headwidth": 4.5, "headlength": 5.5, "headaxislength": 5.0}
    look = {"color": part.colour, "width": 1.1 * axes.figure.dpi / 72, "zorder": 4}
    made = axes.quiver(*1e3 * part.starts.T, *1e3 * part.vectors.T, **to_scale, **head, **look)
    if part.name:
        axes.plot([], [], color=part.colour, marker=">", lw=1.5, ms=5, label=label)
    return [made]


def rim(triangles: np.ndarray) -> np.ndarray:
    """Sides of one triangle only, with the triangle on the left."""
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    size = int(triangles.max(initial=0)) + 1
    forward, back = sides @ np.array([size, 1]), sides @ np.array([1, size])
    return sides[~np.isin(forward, back)]
