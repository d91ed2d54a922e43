"""Figures of meshes and deformed bodies."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sorojax import fem
from sorojax.fem import Path
from sorojax.mesh import Mesh, boundary_facets
from sorojax.view import style
from sorojax.view.draw.states import NodalField, nodal_von_mises
from sorojax.view.raster.plane import as_path, box, cell_rings, flat_triangles, loops
from sorojax.view.raster.shell import on_triangles, shell

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def show_deformed(
    path: Path,
    states: Sequence[int] | None = None,
    *,
    field: NodalField | None = None,
    label: str = "von Mises stress [kPa]",
    title: str = "",
) -> "Figure":
    """Deformed shapes along a load path, one panel each, the rest shape in grey.

    Colours share one scale that ends at the 99.5th percentile of what is shown, so that
    a peak in a corner does not wash the picture out; the bar says so by an arrow.

    Args:
        path: From `fem.solve_path`.
        states: Which states of the path; six evenly spaced loaded ones if omitted.
        field: `field(problem, u)` gives the value at every node; von Mises in kPa if
            omitted.
        label: Name and unit of the field.
        title: Title of the figure.
    """
    triangles = flat_triangles("show_deformed", path.problem.mesh)
    field = nodal_von_mises if field is None else field
    chosen = _chosen_states(path, states)
    rest = 1e3 * np.asarray(path.problem.mesh.points)
    shapes = [rest + 1e3 * np.asarray(path.displacements[k]) for k in chosen]
    colours = [np.asarray(field(path.problem, path.displacements[k])) for k in chosen]
    low, high, extend = _robust_limits(np.stack(colours))
    lower, upper = box(rest, *shapes)
    span = upper - lower
    figure, panels = _panels(len(chosen), float(span[1] / span[0]))
    rings = loops(boundary_facets(path.problem.mesh))
    painted: Any = None
    for panel, k, points, colour in zip(panels, chosen, shapes, colours, strict=True):
        _outline(panel, rest, rings, style.GREY, 0.7)
        paint: Any = panel.tripcolor  # its stub knows no triangles
        painted = paint(
            points[:, 0], points[:, 1], triangles, colour,
            shading="gouraud", cmap=style.FIELD, vmin=low, vmax=high, rasterized=True,
        )  # fmt: skip
        _outline(panel, points, rings, style.INK, 0.5)
        style.dress_plane(panel, lower, upper)
        panel.set_title(_state_name(path, k), fontsize=style.LABEL, color=style.INK)
        panel.label_outer()
    note = "\n(arrow: the highest 0.5 %)" if extend == "max" else ""
    style.colour_bar(
        figure, painted, panels, label + note, extend=extend, shrink=0.9, aspect=30, pad=0.02
    )
    style.title(figure, title)
    return figure


def show_mesh(
    mesh: Mesh,
    field: Float[Any, " values"] | None = None,
    *,
    label: str = "",
    title: str = "",
) -> "Figure":
    """The cells of a plane mesh, coloured by a value per node or per cell if given."""
    from matplotlib.collections import PolyCollection

    triangles = flat_triangles("show_mesh", mesh)
    points = 1e3 * np.asarray(mesh.points)
    lower, upper = box(points)
    figure = style.new_figure(9.0, style.height_for(9.0, lower, upper))
    axes = figure.add_subplot()
    if field is None:
        faces = "#e8f1f8"
    else:
        faces = "none"
        _paint(figure, axes, mesh, points, triangles, np.asarray(field), label)
    cells = PolyCollection(
        list(points[cell_rings(mesh)]), facecolors=faces, edgecolors=style.GREY, linewidths=0.3
    )
    axes.add_collection(cells, autolim=False)
    _outline(axes, points, loops(boundary_facets(mesh)), style.INK, 0.9)
    style.dress_plane(axes, lower, upper)
    count = f"{mesh.num_cells} cells {mesh.element.name}, {mesh.num_nodes} nodes"
    style.title(figure, title or count)
    return figure


def _chosen_states(path: Path, states: Sequence[int] | None) -> list[int]:
    last = len(path) - 1
    if states is None:
        return np.unique(np.round(np.linspace(0, last, 7)).astype(int))[-6:].tolist()
    wrong = [k for k in states if not -last - 1 <= k <= last]
    if wrong or not states:
        raise ValueError(
            f"show_deformed: `states` is {list(states)}, the path has states 0 to {last}. "
            "Choose one or more of them."
        )
    return [k % (last + 1) for k in states]


def _robust_limits(colours: np.ndarray) -> tuple[float, float, str]:
    """Limits of the colour scale and which ends of it are cut."""
    low, high = float(colours.min()), float(np.percentile(colours, 99.5))
    if low >= 0:
        low = 0.0
    if high <= low:
        return low, low + 1.0, "neither"
    return low, high, "max" if colours.max() > high else "neither"


def _state_name(path: Path, k: int) -> str:
    load = next(load for load in path.problem.loads if load.name == path.name)
    value = np.asarray(path.values[k])
    if value.ndim:
        return f"state {k}"
    if isinstance(load, fem.Pressure):
        return f"{float(value) / 1e3:.3g} kPa"
    return f"{path.name} = {float(value):.3g}"


def _panels(count: int, aspect: float) -> "tuple[Figure, list[Axes]]":
    """Small multiples, wide bodies in two columns, others in three."""
    columns = min(count, 2 if aspect < 0.4 else 3)
    rows = -(-count // columns)
    width = 10.0
    height = 0.7 + rows * (0.35 + aspect * (width - 1.4) / columns)
    figure = style.new_figure(width, min(height, 12.0))
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for spare in grid[count:]:
        spare.remove()
    return figure, list(grid[:count])


def _outline(axes: "Axes", points: np.ndarray, rings: list, colour: str, width: float) -> None:
    from matplotlib.patches import PathPatch

    line = PathPatch(as_path(points, rings), fill=False, edgecolor=colour, linewidth=width)
    axes.add_patch(line)


def _paint(figure, axes, mesh: Mesh, points, triangles, field: np.ndarray, label: str) -> None:
    values, per_node = on_triangles(mesh, shell(mesh), field)
    options: Any = {"shading": "gouraud"} if per_node else {"facecolors": values}
    given = (values,) if per_node else ()
    painted = axes.tripcolor(
        points[:, 0], points[:, 1], triangles, *given, cmap=style.FIELD, **options
    )
    style.colour_bar(figure, painted, axes, label, shrink=0.8, pad=0.02)
