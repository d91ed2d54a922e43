"""Robots from their dimensions: the body, and the air that moves it."""

from typing import Any

import numpy as np

from sorojax.robots import Crawler
from sorojax.sdf import AbstractSdf, contour, offset
from sorojax.sdf.sampling import finite_box
from sorojax.view import style
from sorojax.view.draw.shapes import shape_surface
from sorojax.view.raster.scene import Lines, Part, Scene, Surface

_CLEAR = 0.45
_CELLS = {2: 600, 3: 110}  # along the body, by dimension: walls and slots are thin
_AIR = (style.COLOURS[5], style.COLOURS[2], style.COLOURS[4])


def robot_scene(robot: Any, *, size: float | None = None, title: str = "") -> Scene:
    """A robot of `sorojax.robots` at rest: its body, clear in space, and its chambers.

    Args:
        robot: What is to be printed, by its dimensions.
        size: Edge of the cells of surfaces and outlines [m]; a 110th of a solid robot, a
            600th of a plane one if omitted.
        title: Title of the figure; the kind and the size of the robot if omitted.
    """
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
        return {f"air, {port}": robot.chambers(k) for k, port in enumerate(robot.ports)}
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
