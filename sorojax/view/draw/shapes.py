"""Implicit shapes: shaded surfaces, contours of the distance, and sections of solids."""

from typing import TYPE_CHECKING, Any

import numpy as np

from sorojax.sdf import AbstractSdf, Surface as Triangles, contour, isosurface
from sorojax.sdf.sampling import finite_box, values
from sorojax.sdf.surface.marching import Curve
from sorojax.view import style
from sorojax.view.picture import Picture, plotted, show_scene
from sorojax.view.raster.camera import View
from sorojax.view.raster.scene import Lines, Part, Scene, Surface

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sorojax.io import MovingSurface


def _show_plane(shape: AbstractSdf, resolution: int, title: str) -> Picture:
    """A plane shape: filled contours of its distance and the zero set as a line."""
    lower, upper = finite_box("view.show", shape, 2)
    step = float(np.max(upper - lower)) / resolution
    margin = 0.06 * resolution * step
    ranges = zip(lower - margin, upper + margin + step, strict=True)
    x, y = (np.arange(low, high, step) for low, high in ranges)
    figure, axes = _contours(x, y, _on_grid(shape, x, y).T, lower - margin, upper + margin)
    for curve in contour(shape, step):
        axes.plot(*_run(curve).T, color=style.INK, lw=1.5, solid_joinstyle="miter")
    style.dress_plane(axes, 1e3 * lower, 1e3 * upper)
    return plotted(figure, [axes], title)


def _show_slice(
    shape: AbstractSdf, slice: dict[str, float], resolution: int, title: str
) -> Picture:
    """The distance of a solid shape in a plane across one axis, with the zero line."""
    if len(slice) != 1 or next(iter(slice)) not in ("x", "y", "z"):
        raise ValueError(
            f'view.show: got slice={slice}, need one axis with its place [m]: {{"z": 0.01}}.'
        )
    name, place = next(iter(slice.items()))
    across = "xyz".index(name)
    lower, upper = finite_box("view.show", shape, 3)
    rest = [axis for axis in range(3) if axis != across]
    low, high = lower[rest], upper[rest]
    margin = 0.06 * float(np.max(high - low))
    low, high = low - margin, high + margin
    count = np.maximum((high - low) / np.max(high - low) * resolution, 16).astype(int)
    x, y = (np.linspace(a, b, n) for a, b, n in zip(low, high, count, strict=True))
    grid = [x, y]
    grid.insert(across, np.array([float(place)]))
    f = _on_grid(shape, *grid).squeeze(axis=across).T
    figure, axes = _contours(x, y, f, low, high)
    if f.min() < 0 < f.max():
        axes.contour(1e3 * x, 1e3 * y, f, levels=[0.0], colors=style.INK, linewidths=1.5)
    style.dress_plane(axes, 1e3 * low, 1e3 * high, *(f"{'xyz'[k]} [mm]" for k in rest))
    return plotted(figure, [axes], title or f"{name} = {1e3 * float(place):g} mm")


def _on_grid(shape: AbstractSdf, *axes: np.ndarray) -> np.ndarray:
    """A field at the points of a grid."""
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return values(shape, grid.reshape(-1, len(axes))).reshape(grid.shape[:-1])


def _run(curve: Curve) -> np.ndarray:
    """The points of a curve [mm], the first again at the end of a closed one."""
    points = 1e3 * np.asarray(curve.points)
    return np.concatenate([points, points[:1]]) if curve.closed else points


def _contours(x, y, f, lower, upper) -> "tuple[Figure, Axes]":
    """Filled contours of a distance over a grid [m], in a figure for the box around it."""
    figure = style.new_figure(9.0, style.height_for(9.0, lower, upper))
    axes = figure.add_subplot()
    norm, levels = _two_sided(1e3 * float(f.min()), 1e3 * float(f.max()))
    filled = axes.contourf(1e3 * x, 1e3 * y, 1e3 * f, levels=levels, cmap="RdBu_r", norm=norm)
    ticks = levels[::2] if len(levels) > 12 else levels
    look = {"format": "%g", "shrink": 0.9, "pad": 0.02, "spacing": "uniform", "ticks": ticks}
    style.colour_bar(figure, filled, axes, "signed distance [mm]", **look)
    return figure, axes


def _two_sided(low: float, high: float) -> tuple[Any, np.ndarray]:
    """Colours and round levels on each side of zero, where the depths may differ a lot."""
    from matplotlib.colors import TwoSlopeNorm
    from matplotlib.ticker import MaxNLocator

    inside = np.array(MaxNLocator(6).tick_values(min(low, -1e-9), 0.0))
    outside = np.array(MaxNLocator(6).tick_values(0.0, max(high, 1e-9)))
    levels = np.concatenate([inside[inside < 0], outside[outside >= 0]])
    return TwoSlopeNorm(0.0, levels[0], levels[-1]), levels


# Implicit shapes: contours of the distance, shaded surfaces, slices


def show_shape(
    shape: AbstractSdf,
    *,
    slice: dict[str, float] | None = None,
    size: float | None = None,
    filled: bool = False,
    view: View = "iso",
    renderer: str = "auto",
    resolution: int = 300,
    title: str = "",
) -> Picture:
    """A plane shape by its distance, a solid one by its surface or a slice.

    Args:
        shape: What to draw; it must be bounded.
        slice: Where to cut a solid shape, e.g. `{"z": 10 * mm}`.
        size: Edge of the cells of the surface of a solid shape [m]; a 72nd of it if omitted.
        filled: Draw a plane shape without the distance around it.
        view: Camera of a solid shape.
        renderer: Of a solid shape.
        resolution: Points along the longer side of a plane picture.
        title: Title of the figure.
    """
    if shape.dim == 2 and not filled:
        return _show_plane(shape, resolution, title)
    if shape.dim == 3 and slice is not None:
        return _show_slice(shape, slice, resolution, title)
    return show_scene(shape_scene(shape, size, title), view=view, renderer=renderer)


def shape_scene(shape: AbstractSdf, size: float | None = None, title: str = "") -> Scene:
    """The surface of a solid shape, or a plane shape filled."""
    lower, upper = finite_box("view.show", shape, shape.dim)
    longest = float(np.max(upper - lower))
    if size is None:
        size = longest / (300 if shape.dim == 2 else 72)
    part = _filled(shape, size) if shape.dim == 2 else shape_surface(shape, size)
    return Scene((part,), title=title)


def shape_surface(shape: AbstractSdf, size: float, **look: Any) -> Surface:
    """A solid shape as a part of a scene, with its `colour`, `opacity` and `name`."""
    surface = _surface(shape, size)
    return Surface(surface.vertices, surface.triangles, **look)


def _surface(shape: AbstractSdf, size: float) -> Triangles:
    """With its sharp edges, or rounded where walls are too thin for them."""
    try:
        return isosurface(shape, size, "dual_contouring")
    except ValueError:
        return isosurface(shape, size)


def surface_scene(surface: Triangles, title: str = "", wire: bool = False) -> Scene:
    """Triangles in space, plain."""
    sides = np.ones(surface.triangles.shape, bool) if wire else None
    return Scene((Surface(surface.vertices, surface.triangles, wire=sides),), title=title)


def show_surface(
    surface: Triangles,
    *,
    wire: bool = False,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
) -> Picture:
    """A triangle surface, e.g. from `sdf.isosurface` or `io.import_surface`."""
    if not title:
        title = f"{len(surface.triangles)} triangles, {len(surface.vertices)} vertices"
    return show_scene(surface_scene(surface, title, wire), view=view, renderer=renderer)


def obstacle_part(
    obstacle: AbstractSdf, points: np.ndarray, size: float, shift: np.ndarray | None = None
) -> list[Part]:
    """The obstacle of a body, as far as it is near: by marching over a box around it."""
    lower, upper = points.min(axis=0) - 0.12 * size, points.max(axis=0) + 0.12 * size
    if shift is not None:
        lower, upper = lower - shift, upper - shift
    moved = np.zeros(len(lower)) if shift is None else shift
    if len(lower) == 2:
        runs = [run + moved for run in level_lines(obstacle, lower, upper)]
        return [Lines(runs, style.OBSTACLE, 3.0, name="obstacle")] if runs else []
    vertices, triangles = level_surface(obstacle, lower, upper)
    if not len(triangles):
        return []
    return [Surface(vertices + moved, triangles, style.OBSTACLE, opacity=0.6, name="obstacle")]


def level_surface(shape: AbstractSdf, lower: np.ndarray, upper: np.ndarray, count: int = 44):
    """Zero surface of a solid field in a box, open where the box cuts it."""
    from skimage.measure import marching_cubes

    f = _on_grid(shape, *np.linspace(lower, upper, count).T)
    if not f.min() < 0 < f.max():
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    step = tuple((upper - lower) / (count - 1))
    vertices, triangles, _, _ = marching_cubes(f, 0.0, spacing=step)
    return vertices + lower, triangles[:, ::-1]


def level_lines(shape: AbstractSdf, lower: np.ndarray, upper: np.ndarray, count: int = 160):
    """Zero lines of a plane field in a box; the shape may be unbounded."""
    from skimage.measure import find_contours

    f = _on_grid(shape, *np.linspace(lower, upper, count).T)
    return [lower + run * (upper - lower) / (count - 1) for run in find_contours(f, 0.0)]


def _filled(shape: AbstractSdf, size: float) -> Surface:
    """The inside of a plane shape as triangles, along its exact outline."""
    from sorojax.mesh import triangulate

    lower, upper = finite_box("view.show", shape, 2)
    mesh = triangulate(shape, size=max(size, float(np.max(upper - lower)) / 60))
    return Surface(np.asarray(mesh.points), np.asarray(mesh.cells))


# Parts, moving surfaces, boundary curves


def show_part(part: Any, **options: Any) -> Picture:
    """A part made of densities, by its shape; options of a shape."""
    if part.shape.dim == 2:
        options = {"filled": True} | options
    return show_shape(part.shape, **options)


def moving_scene(surface: "MovingSurface", *, frame: int = -1, title: str = "") -> Scene:
    """A moving surface in one of its frames, the last one if omitted."""
    points = np.asarray(surface.points)
    points = points[frame if len(points) > 1 else 0]
    if surface.poses is not None:
        pose = np.asarray(surface.poses)[frame]
        points = points @ pose[:3, :3].T + pose[:3, 3]
    return Scene((Surface(points, np.asarray(surface.triangles)),), title=title or surface.name)


def show_curve(curve: Curve, *, title: str = "") -> Picture:
    """A piece of a boundary with its points; corners are marked."""
    points = np.asarray(curve.points)
    lower, upper = 1e3 * points.min(axis=0), 1e3 * points.max(axis=0)
    figure = style.new_figure(6.0, style.height_for(6.0, lower, upper))
    axes = figure.add_subplot()
    axes.plot(*_run(curve).T, color=style.COLOURS[0], lw=1.6, marker=".", ms=3)
    corners = 1e3 * points[np.asarray(curve.corner)]
    axes.plot(*corners.T, "o", color=style.COLOURS[1], ms=6, label="corners")
    style.dress_plane(axes, lower, upper)
    if np.any(curve.corner):
        style.legend(axes, loc="best")
    return plotted(figure, [axes], title or f"{len(points)} points")
