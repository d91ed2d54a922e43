"""Mesh quality, sweeps, tracks of markers, moving surfaces, boundary curves, and robots from
their dimensions.
"""

from typing import Any

import numpy as np

from sorojax.io import MovingSurface
from sorojax.mesh import Quality
from sorojax.robots import Crawler
from sorojax.robots.crawler import PORTS
from sorojax.sdf import AbstractSdf, Curve, contour, offset
from sorojax.sdf.sampling import finite_box
from sorojax.view import style
from sorojax.view.draw.shapes import shape_surface
from sorojax.view.picture import Panel, Picture
from sorojax.view.raster.camera import View
from sorojax.view.raster.scene import Lines, Part, Scene, Surface
from sorojax.view.show import show_scene

_MOST = 9  # panels of a sweep
_TINT = "#b8b8b8"  # of markers that were not seen


def show_quality(found: Quality, *, title: str = "") -> Picture:
    """How many cells have which radius ratio, and the smallest and largest angle."""
    figure = style.new_figure(6.0, 4.0)
    axes = figure.add_subplot()
    counts = np.asarray(found.histogram, float)
    edges = np.linspace(0, 1, len(counts) + 1)
    axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=style.COLOURS[0],
             edgecolor="white")  # fmt: skip
    axes.axvline(found.mean_radius_ratio, color=style.COLOURS[1], lw=1.6, label="mean")
    low, high = np.rad2deg(found.min_angle), np.rad2deg(found.max_angle)
    text = f"{found.num_cells} cells, angles {low:.1f} to {high:.1f} deg"
    style.dress(axes, "radius ratio [-]", "cells", title or text)
    axes.set_xlim(0, 1)
    style.legend(axes, loc="upper left")
    return Picture(figure, (Panel(axes),))


def show_sweep(swept: Any, *, title: str = "") -> Picture:
    """Results over the number of the design, one panel per name; of arrays their range.

    Args:
        swept: From `sweep.sweep`.
        title: Title of the figure.
    """
    named = {k: np.asarray(v, float) for k, v in swept.result.items() if _is_number(v)}
    if not named:
        raise ValueError(
            f"view.show: the sweep holds no numbers, but {sorted(swept.result)}. Return arrays "
            "of numbers from the function."
        )
    names = list(named)[:_MOST]
    columns = min(len(names), 3)
    rows = -(-len(names) // columns)
    figure = style.new_figure(max(5.0, 3.6 * columns), 0.4 + 2.7 * rows)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for spare in grid[len(names) :]:
        spare.remove()
    for axes, name in zip(grid, names, strict=False):
        values = named[name].reshape(len(named[name]), -1)
        design = np.arange(len(values))
        if values.shape[1] == 1:
            axes.plot(design, values[:, 0], "o", ms=3.5, mew=0, color=style.COLOURS[0])
        else:
            axes.fill_between(design, values.min(1), values.max(1), alpha=0.3, lw=0,
                              color=style.COLOURS[0])  # fmt: skip
            axes.plot(design, values.mean(1), color=style.COLOURS[0], lw=1.4)
        style.dress(axes, "design", "", name)
    left = len(named) - len(names)
    more = f", {left} more names" if left else ""
    style.title(figure, title or f"{len(next(iter(named.values())))} designs{more}")
    return Picture(figure, tuple(Panel(axes) for axes in grid[: len(names)]))


def _is_number(values) -> bool:
    array = np.asarray(values)
    return array.ndim > 0 and array.size > 0 and np.issubdtype(array.dtype, np.number)


def show_tracks(tracks: Any, *, title: str = "") -> Picture:
    """Markers where they are or are predicted, with the way of the next frame; grey those that
    were not seen.

    Args:
        tracks: From `vision.track`.
        title: Title of the figure.
    """
    figure = style.new_figure(6.0, 5.0)
    axes = figure.add_subplot()
    for number, (centre, radius) in enumerate(
        zip(tracks.discs.centre, tracks.discs.radius, strict=True)
    ):
        seen = tracks.unseen[number] == 0
        colour = style.COLOURS[number % len(style.COLOURS)] if seen else _TINT
        turn = np.linspace(0, 2 * np.pi, 65)
        edge = centre + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        axes.fill(edge[:, 0], edge[:, 1], color=colour, alpha=0.8 if seen else 0.4, lw=0)
        axes.annotate("", centre + tracks.velocity[number], centre,
                      arrowprops={"arrowstyle": "->", "color": style.INK})  # fmt: skip
        axes.text(*centre, str(number), ha="center", va="center", color="white")
    text = f"{len(tracks.unseen)} markers, {int(np.sum(tracks.stale))} stale"
    style.dress(axes, "x [px]", "y [px]", title or text)
    axes.set_aspect("equal")
    axes.invert_yaxis()  # as in the image
    return Picture(figure, (Panel(axes),))


def show_moving(
    surface: MovingSurface,
    *,
    frame: int = -1,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
) -> Picture:
    """A moving surface in one of its frames, the last one if omitted."""
    points = np.asarray(surface.points)
    points = points[frame if len(points) > 1 else 0]
    if surface.poses is not None:
        pose = np.asarray(surface.poses)[frame]
        points = points @ pose[:3, :3].T + pose[:3, 3]
    part = Surface(points, np.asarray(surface.triangles))
    scene = Scene((part,), title=title or surface.name)
    return show_scene(scene, view=view, renderer=renderer)


def show_curve(curve: Curve, *, title: str = "") -> Picture:
    """A piece of a boundary with its points; corners are marked."""
    points = np.asarray(curve.points)
    lower, upper = 1e3 * points.min(axis=0), 1e3 * points.max(axis=0)
    figure = style.new_figure(6.0, style.height_for(6.0, lower, upper))
    axes = figure.add_subplot()
    line = np.concatenate([points, points[:1]]) if curve.closed else points
    axes.plot(*(1e3 * line).T, color=style.COLOURS[0], lw=1.6, marker=".", ms=3)
    axes.plot(*(1e3 * points[np.asarray(curve.corner)]).T, "o", color=style.COLOURS[1], ms=6,
              label="corners")  # fmt: skip
    style.dress_plane(axes, lower, upper)
    if np.any(curve.corner):
        style.legend(axes, loc="best")
    style.title(figure, title or f"{len(points)} points")
    return Picture(figure, (Panel(axes),))


# Robots from their dimensions: the body, and the air that moves it


_CLEAR = 0.45
_CELLS = {2: 600, 3: 110}  # along the body, by dimension: walls and slots are thin
_AIR = (style.COLOURS[5], style.COLOURS[2], style.COLOURS[4])


def show_robot(
    robot: Any,
    *,
    size: float | None = None,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
) -> Picture:
    """A robot of `sorojax.robots` at rest: its body, clear in space, and its chambers.

    Args:
        robot: What is to be printed, by its dimensions.
        size: Edge of the cells of surfaces and outlines [m]; a 110th of a solid robot, a
            600th of a plane one if omitted.
        view: Camera of a solid robot.
        renderer: Of a solid robot.
        title: Title of the figure; the kind and the size of the robot if omitted.
    """
    return show_scene(robot_scene(robot, size, title), view=view, renderer=renderer)


def robot_scene(robot: Any, size: float | None = None, title: str = "") -> Scene:
    """As `show_robot`, before it is drawn."""
    air = air_of(robot)
    body = robot.body() if hasattr(robot, "body") else robot.solid()
    lower, upper = finite_box("view.show", body, body.dim)
    size = float(np.max(upper - lower)) / _CELLS[body.dim] if size is None else size
    if not title:
        extent = " x ".join(f"{1e3 * length:.3g}" for length in upper - lower)
        title = f"{type(robot).__name__}: {extent} mm"
    if body.dim == 2:
        parts = _filled(body, size, style.BODY, "")
        for colour, (name, shape) in zip(_AIR, air.items(), strict=False):
            parts += _filled(shape, size, colour, name)
        return Scene(tuple(parts), title=title)
    parts = [
        shape_surface(shape, size, colour=colour, name=name)
        for colour, (name, shape) in zip(_AIR, air.items(), strict=False)
    ]
    whole = robot.solid() if hasattr(robot, "solid") else _without_hollows(body, air, size)
    parts.append(shape_surface(whole, size, opacity=_CLEAR if parts else 1.0))
    return Scene(tuple(parts), title=title)


def air_of(robot: Any) -> dict[str, AbstractSdf]:
    """The hollows of a robot by name."""
    if isinstance(robot, Crawler):
        return {f"air, {port}": robot.chambers(k) for k, port in enumerate(PORTS)}
    if hasattr(robot, "chambers"):
        return {"air": robot.chambers()}
    return {"air": robot.chamber()} if hasattr(robot, "chamber") else {}


def _without_hollows(body: AbstractSdf, air: dict[str, AbstractSdf], size: float):
    for hollow in air.values():
        body = body | offset(hollow, size / 4)  # over the walls, which it would only touch
    return body


def _filled(shape: AbstractSdf, size: float, colour: str, name: str) -> list[Part]:
    """The inside of a plane shape and its outline. Fans over its curves overlap, but their
    rim, which is what the plane draws, is the outline with its holes."""
    curves = [curve.points for curve in contour(shape, size) if curve.closed]
    starts = np.cumsum([0, *map(len, curves)])
    fans = []
    for start, curve in zip(starts, curves, strict=False):
        k = start + np.arange(1, len(curve) - 1)
        fans.append(np.stack([np.full(len(k), start), k, k + 1], axis=1))
    inside = Surface(np.concatenate(curves), np.concatenate(fans), colour, name=name)
    rings = [np.concatenate([curve, curve[:1]]) for curve in curves]
    return [inside, Lines(rings, style.INK, 0.8)]
