"""Implicit shapes: contours of the distance, shaded surfaces, slices."""

from typing import Any

import numpy as np

from sorojax.sdf import AbstractSdf, Surface as Triangles, isosurface
from sorojax.sdf.sample import finite_box, values
from sorojax.view import style
from sorojax.view.camera import View
from sorojax.view.distance import show_sdf, show_slice
from sorojax.view.picture import Panel, Picture
from sorojax.view.scene import Lines, Part, Scene, Surface
from sorojax.view.stage import show_scene


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
    if shape.dim == 3 and slice is None:
        return show_scene(shape_scene(shape, size, title), view=view, renderer=renderer)
    if shape.dim == 3:
        assert slice is not None
        return show_slice(shape, slice, resolution, title)
    if filled:
        return show_scene(shape_scene(shape, size, title))
    figure = show_sdf(shape, resolution=resolution, title=title)
    return Picture(figure, (Panel(figure.axes[0]),))


def shape_scene(shape: AbstractSdf, size: float | None = None, title: str = "") -> Scene:
    """The surface of a solid shape, or a plane shape filled."""
    lower, upper = finite_box("view.show", shape, shape.dim)
    longest = float(np.max(upper - lower))
    if shape.dim == 2:
        return Scene((_filled(shape, longest / 300 if size is None else size),), title=title)
    return Scene((shape_surface(shape, longest / 72 if size is None else size),), title=title)


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
    """What a body touches, as far as it is near: by marching over a box around it."""
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

    axes = [np.linspace(a, b, count) for a, b in zip(lower, upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    f = values(shape, grid.reshape(-1, 3)).reshape(count, count, count)
    if not f.min() < 0 < f.max():
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    step = tuple((upper - lower) / (count - 1))
    vertices, triangles, _, _ = marching_cubes(f, 0.0, spacing=step)
    return vertices + lower, triangles[:, ::-1]


def level_lines(shape: AbstractSdf, lower: np.ndarray, upper: np.ndarray, count: int = 160):
    """Zero lines of a plane field in a box; the shape may be unbounded."""
    from skimage.measure import find_contours

    step = (upper - lower) / (count - 1)
    x, y = np.meshgrid(*(np.linspace(a, b, count) for a, b in zip(lower, upper, strict=True)))
    f = values(shape, np.stack([x.ravel(), y.ravel()], axis=1)).reshape(x.shape)
    return [lower + run[:, ::-1] * step for run in find_contours(f, 0.0)]


def _filled(shape: AbstractSdf, size: float) -> Surface:
    """The inside of a plane shape as triangles, along its exact outline."""
    from sorojax.mesh import triangulate

    lower, upper = finite_box("view.show", shape, 2)
    mesh = triangulate(shape, size=max(size, float(np.max(upper - lower)) / 60))
    return Surface(np.asarray(mesh.points), np.asarray(mesh.cells))
