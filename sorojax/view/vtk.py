"""Solid scenes by pyvista, through the same lens as the own renderer."""

import importlib
from typing import Any

import numpy as np
from jaxtyping import UInt8

from sorojax.view.camera import Lens
from sorojax.view.glyphs import arrow_triangles, ball_triangles
from sorojax.view.scene import Arrows, Dots, Lines, Part, Scene, Surface, box_of

_held: dict[tuple[int, int], Any] = {}


def screenshot(scene: Scene, lens: Lens, dots_per_point: float) -> UInt8[np.ndarray, "h w 3"]:
    """The scene through `lens`, off-screen, on white paper; the window is kept for the next
    picture of this size."""
    plotter = _plotter(lens.size)
    plotter.clear_actors()
    for part in scene.parts:
        _add(plotter, part, scene, lens, dots_per_point)
    _aim(plotter, scene, lens)
    plotter.render()
    return np.asarray(plotter.screenshot(return_img=True))[:, :, :3].copy()


def _plotter(size: tuple[int, int]) -> Any:
    pv: Any = importlib.import_module("pyvista")
    if size not in _held:
        for old in _held.values():
            old.close()
        _held.clear()
        plotter = pv.Plotter(off_screen=True, window_size=list(size), lighting="light kit")
        plotter.set_background("white")
        plotter.enable_anti_aliasing("msaa", multi_samples=4)
        _held[size] = plotter
    return _held[size]


def _add(plotter, part: Part, scene: Scene, lens: Lens, dots_per_point: float) -> None:
    pv: Any = importlib.import_module("pyvista")
    reach = dots_per_point / lens.scale
    if isinstance(part, Lines):
        runs = [np.asarray(run, float) for run in part.runs if len(run) > 1]
        if not runs:
            return
        starts = np.cumsum([0, *map(len, runs)])
        cells = [np.r_[len(run), at + np.arange(len(run))]
                 for run, at in zip(runs, starts, strict=False)]  # fmt: skip
        ahead = 1.5 * reach * max(part.width, 1.0) * lens.camera.axes[2]
        lines = pv.PolyData(np.concatenate(runs) + ahead, lines=np.concatenate(cells))
        plotter.add_mesh(lines, color=part.colour, line_width=part.width * dots_per_point,
                         lighting=False, reset_camera=False, render=False)  # fmt: skip
        return
    if isinstance(part, Arrows):
        surface = Surface(*arrow_triangles(part.starts, part.vectors, 1.1 * reach), part.colour)
    elif isinstance(part, Dots):
        surface = Surface(*ball_triangles(part.points, 0.5 * part.size * reach), part.colour)
    else:
        surface = part
    _add_surface(plotter, pv, surface, scene)
    if surface.wire is not None and np.any(surface.wire):
        ends = np.concatenate(
            [surface.triangles[surface.wire[:, k]][:, [k, (k + 1) % 3]] for k in range(3)]
        )
        ends = np.unique(np.sort(ends, axis=1), axis=0)
        cells = np.column_stack([np.full(len(ends), 2), ends]).ravel()
        ahead = 1.5 * reach * lens.camera.axes[2]
        wire = pv.PolyData(np.asarray(surface.points, float) + ahead, lines=cells)
        plotter.add_mesh(wire, color="#1f2430", line_width=0.7 * dots_per_point, opacity=0.6,
                         lighting=False, reset_camera=False, render=False)  # fmt: skip


def _add_surface(plotter, pv, part: Surface, scene: Scene) -> None:
    from sorojax.view.soup import corner_normals

    if not len(part.triangles):
        return
    triangles = np.asarray(part.triangles)
    normals = corner_normals(np.asarray(part.points, float), triangles).reshape(-1, 3)
    corners = np.asarray(part.points, float)[triangles].reshape(-1, 3)
    rows = np.arange(len(corners)).reshape(-1, 3)
    cells = np.column_stack([np.full(len(rows), 3), rows]).ravel()
    mesh = pv.PolyData(corners, faces=cells)
    mesh.point_data.active_normals = normals
    look: dict[str, Any] = {
        "opacity": part.opacity, "smooth_shading": True, "split_sharp_edges": False,
        "specular": 0.15, "specular_power": 20, "reset_camera": False, "render": False,
    }  # fmt: skip
    if part.values is not None and scene.scale is not None:
        values = np.asarray(part.values, float)
        per_point = len(values) == len(part.points) and len(values) != len(triangles)
        mesh["value"] = values[triangles].ravel() if per_point else np.repeat(values, 3)
        scale = scene.scale
        look |= {"scalars": "value", "cmap": scale.colours, "clim": (scale.low, scale.high),
                 "show_scalar_bar": False, "ambient": 0.35, "diffuse": 0.7}  # fmt: skip
    elif isinstance(part.colour, str):
        look |= {"color": part.colour}
    else:
        mesh["colour"] = (255 * np.repeat(np.asarray(part.colour), 3, axis=0)).astype(np.uint8)
        look |= {"scalars": "colour", "rgb": True}
    plotter.add_mesh(mesh, **look)


def _aim(plotter, scene: Scene, lens: Lens) -> None:
    """The camera of VTK where the lens is; clipping planes around all of the scene."""
    camera, axes = plotter.camera, lens.camera.axes
    wide, high = lens.size
    camera.focal_point = tuple(lens.centre)
    camera.up = tuple(axes[1])
    camera.position = tuple(lens.centre + lens.distance * axes[2])
    camera.parallel_projection = not lens.camera.opening
    camera.parallel_scale = high / 2 / lens.scale
    camera.view_angle = float(
        np.rad2deg(2 * np.arctan(high / 2 / (lens.scale * lens.distance)))
    )
    aside = lens.shift - np.array([wide, high]) / 2
    camera.SetWindowCenter(-2 * aside[0] / wide, 2 * aside[1] / high)
    lower, upper = box_of(scene.parts)
    reach = float(np.linalg.norm(upper - lower)) + float(
        np.linalg.norm((lower + upper) / 2 - lens.centre)
    )
    near = max(lens.distance - reach, 0.01 * lens.distance)
    camera.clipping_range = (near, lens.distance + reach)
