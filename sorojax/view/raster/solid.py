"""Solid scenes in a figure: the shaded picture, its colour bar, scale, axes and names."""

import contextlib
import importlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from sorojax import _check
from sorojax.view import style
from sorojax.view.raster.camera import Lens, View, box_corners, camera_at, fit
from sorojax.view.raster.glyphs import arrow_triangles, ball_triangles
from sorojax.view.raster.raster import shade
from sorojax.view.raster.scene import (
    Arrows,
    Dots,
    Lines,
    Part,
    Scene,
    Surface,
    box_of,
    corners_of,
)
from sorojax.view.raster.shadow import in_shadow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_warned = False


def picture_of(
    scene: Scene,
    lens: Lens,
    *,
    renderer: str = "auto",
    samples: int = 2,
    dots_per_point: float = 1.4,
    shadows: bool = False,
) -> UInt8[np.ndarray, "height width 3"]:
    """The pixels of a solid scene, by pyvista where it is installed.

    Args:
        scene: What to draw.
        lens: From `lens_of`.
        renderer: "pyvista", "own", or "auto": pyvista if it is there, with one warning if
            it is not.
        samples: Per pixel and direction, of the own renderer.
        dots_per_point: Pixels that a point of print has.
        shadows: Whether bodies throw shadows on each other.
    """
    if chosen_renderer(renderer) == "pyvista":
        return screenshot(scene, lens, dots_per_point, shadows)
    how: dict[str, Any] = {"samples": samples, "dots_per_point": dots_per_point}
    return shade(scene, lens, **how, shadow=in_shadow if shadows else None)


def chosen_renderer(renderer: str) -> str:
    """ "pyvista" or "own"; tells once that the extra is missing."""
    global _warned
    if renderer not in ("auto", "own", "pyvista"):
        raise ValueError(
            f'view: got renderer={renderer!r}, need "auto", "own" or "pyvista". Leave it out.'
        )
    if renderer == "own":
        return renderer
    import importlib.util

    if importlib.util.find_spec("pyvista") is not None:
        return "pyvista"
    if renderer == "pyvista":
        raise ValueError(
            'view: pyvista is not installed. Run pip install "sorojax[view]", or leave '
            "`renderer` out."
        )
    if not _warned:
        _warned = True
        _check.warn(
            "view: pyvista is not installed, solid pictures are shaded by sorojax's own "
            'renderer. Run pip install "sorojax[view]" for pyvista, or pass renderer="own".'
        )
    return "own"


def lens_of(scenes: Sequence[Scene], view: View, size: tuple[int, int], share: float = 0.0):
    """One lens that holds everything that `scenes` show."""
    if any(scene.extent is not None for scene in scenes):
        points = np.concatenate([box_corners(*scene.box) for scene in scenes])
    else:
        points = np.concatenate([corners_of(p) for scene in scenes for p in scene.parts])
    return fit(camera_at(view, share), points[np.all(np.isfinite(points), axis=1)], size)


def size_of(axes: "Axes") -> tuple[int, int]:
    """Width and height of a picture in `axes` [pixels]."""
    box = axes.get_window_extent()
    return max(int(round(box.width)), 16), max(int(round(box.height)), 16)


def draw_solid(
    figure: "Figure",
    axes: "Axes",
    scene: Scene,
    *,
    view: View = "iso",
    renderer: str = "auto",
    lens: Lens | None = None,
    shadows: bool = False,
) -> Lens:
    """Shade `scene` into `axes`, whose place in the figure is final; returns the lens."""
    size = size_of(axes)
    lens = lens_of([scene], view, size) if lens is None else lens
    look: dict[str, Any] = {"renderer": renderer, "dots_per_point": figure.dpi / 72}
    picture = picture_of(scene, lens, **look, shadows=shadows)
    axes.set_xlim(0, size[0])
    axes.set_ylim(size[1], 0)
    axes.imshow(
        picture, extent=(0, size[0], size[1], 0), interpolation="nearest", aspect="auto"
    )
    axes.axis("off")
    return lens


def frame(
    figure: "Figure", scene: Scene, *, bar: bool = True, title: str | None = None
) -> "tuple[Axes, Any]":
    """Axes for the picture, beside a colour bar if the scene has values."""
    width, height = figure.get_size_inches()
    heading = scene.title if title is None else title
    count = len({part.name for part in scene.parts if part.name})
    names = 0.05 + 0.21 * -(-count // 4) if count else 0.0
    top = 1 - ((0.42 if heading else 0.08) + names) / height
    right = 1 - (1.05 / width if scene.scale is not None and bar else 0.08 / width)
    low = 0.30 / height
    axes = figure.add_axes((0.08 / width, low, right - 0.08 / width, top - low))
    drawn = None
    if scene.scale is not None and bar:
        place = (right + 0.12 / width, low + 0.1 * (top - low), 0.16 / width, 0.8 * (top - low))
        drawn = bar_of(figure, scene.scale, figure.add_axes(place))
    if heading:
        style.heading(figure, 0.5, 1 - 0.1 / height, heading)
    return axes, drawn


def bar_of(figure: "Figure", scale, axes: "Axes") -> Any:
    """The colour bar of a scale in its own axes."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    painted = ScalarMappable(Normalize(scale.low, scale.high), scale.colours)
    bar = figure.colorbar(painted, cax=axes, extend=scale.extend)
    bar.set_label(scale.label, fontsize=style.LABEL, color=style.INK)
    axes.tick_params(labelsize=style.SMALL, colors=style.INK, length=3, color=style.GREY)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    return bar


def annotate(figure: "Figure", axes: "Axes", scene: Scene, lens: Lens) -> None:
    """Directions of the axes, a bar of known length, and the names of the parts."""
    width, height = lens.size
    unit = 16 * figure.dpi / 72
    corner = np.array([1.5 * unit, height - 1.5 * unit])
    right, up, _ = lens.camera.axes
    order = np.argsort(lens.camera.axes[2])
    for k in order:
        step = np.array([right[k], -up[k]]) * unit
        colour, tip = style.AXES[k], corner + step
        axes.plot(*np.stack([corner, tip]).T, color=colour, lw=1.4, solid_capstyle="round")
        style.write(axes, *(corner + 1.35 * step), "xyz"[k], color=colour)
    low = height - 0.6 * unit
    scale_bar(axes, lens, 4.2 * unit, low, 0.4 * unit)
    if scene.note:
        style.write(axes, width - 0.4 * unit, low, scene.note, ha="right")
    _names(axes, scene)


def scale_bar(axes: "Axes", lens: Lens, start: float, low: float, gap: float) -> None:
    """A bar of a round length from the pixel (`start`, `low`), its length `gap` behind it."""
    length = _round_length(0.22 * lens.size[0] / lens.scale)
    end = start + length * lens.scale
    axes.plot([start, end], [low, low], color=style.INK, lw=2.0, solid_capstyle="butt")
    style.write(axes, end + gap, low, _length_text(length), ha="left")


def _names(axes: "Axes", scene: Scene) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    shown: dict[str, Any] = {}
    for part in scene.parts:
        colour = getattr(part, "colour", style.INK)
        if not part.name or part.name in shown or not isinstance(colour, str):
            continue
        shown[part.name] = (
            Patch(color=colour, label=part.name)
            if isinstance(part, Surface)
            else Line2D([], [], color=colour, lw=2, label=part.name)
        )
    if shown:
        place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.1}
        look = {"frameon": False, "fontsize": style.SMALL, "labelcolor": style.INK}
        columns = {"ncols": min(len(shown), 4), "columnspacing": 1.2}
        axes.legend(handles=list(shown.values()), **place, **look, **columns)


def _round_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten below `length`."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(m for m in (1, 2, 5) if m * power <= length * 1.0001) * power)


def _length_text(length: float) -> str:
    return f"{length:g} m" if length >= 0.999 else f"{1e3 * length:g} mm"


def solid_figure(
    scene: Scene,
    *,
    view: View = "iso",
    renderer: str = "auto",
    width: float = 7.0,
    height: float | None = None,
) -> "tuple[Figure, Lens]":
    """One solid scene in a figure of `width` inches."""
    if height is None:  # what the picture asks for, from about half of the width to all of it
        wanted = 0.9 + width * aspect_of(scene, view)
        height = float(np.clip(wanted, 0.45 * width, width))
    figure = style.new_figure(width, height, layout="none")
    axes, _ = frame(figure, scene)
    lens = draw_solid(figure, axes, scene, view=view, renderer=renderer)
    annotate(figure, axes, scene, lens)
    return figure, lens


def aspect_of(scene: Scene, view: View) -> float:
    """Height over width of what is seen of a scene."""
    corners = box_corners(*scene.box)
    flat = fit(camera_at(view), corners, (100, 100)).raw(corners)[:, :2]
    wide, high = np.ptp(flat, axis=0)
    return float(high / max(wide, 1e-12))


# Solid scenes by pyvista, through the same lens as the own renderer


_held: dict[tuple[int, int], Any] = {}


def screenshot(
    scene: Scene, lens: Lens, dots_per_point: float, shadows: bool = False
) -> UInt8[np.ndarray, "h w 3"]:
    """The scene through `lens`, off-screen, on white paper; the window is kept for the next
    picture of this size."""
    plotter = _plotter(lens.size)
    plotter.clear_actors()
    (plotter.enable_shadows if shadows else plotter.disable_shadows)()
    for part in scene.parts:
        _add(plotter, part, scene, lens, dots_per_point)
    _aim(plotter, scene, lens)
    plotter.render()
    return np.asarray(plotter.screenshot(return_img=True))[:, :, :3].copy()


@contextlib.contextmanager
def _told_of_errors_only() -> Iterator[None]:
    logger: Any = importlib.import_module("vtkmodules.vtkCommonCore").vtkLogger
    before = logger.GetCurrentVerbosityCutoff()
    logger.SetStderrVerbosity(logger.VERBOSITY_ERROR)
    try:
        yield
    finally:
        logger.SetStderrVerbosity(before)


def _plotter(size: tuple[int, int]) -> Any:
    pv: Any = importlib.import_module("pyvista")
    if size not in _held:
        for old in _held.values():
            old.close()
        _held.clear()
        with _told_of_errors_only():  # without a display VTK warns that there is none
            plotter = pv.Plotter(off_screen=True, window_size=list(size), lighting="light kit")
            plotter.set_background("white")
            plotter.enable_anti_aliasing("msaa", multi_samples=4)
            plotter.render()
        _held[size] = plotter
    return _held[size]


def _add(plotter, part: Part, scene: Scene, lens: Lens, dots_per_point: float) -> None:
    pv: Any = importlib.import_module("pyvista")
    reach = dots_per_point / lens.scale
    flat = {"lighting": False, "reset_camera": False, "render": False}
    if isinstance(part, Lines):
        runs = [np.asarray(run, float) for run in part.runs if len(run) > 1]
        if not runs:
            return
        ahead = 1.5 * reach * max(part.width, 1.0) * lens.camera.axes[2]
        numbers = np.split(np.arange(sum(map(len, runs))), np.cumsum([*map(len, runs)])[:-1])
        cells = np.concatenate([np.append(len(ids), ids) for ids in numbers])
        lines = pv.PolyData(np.concatenate(runs) + ahead, lines=cells)
        width = part.width * dots_per_point
        plotter.add_mesh(lines, color=part.colour, line_width=width, **flat)
        return
    if isinstance(part, Arrows):
        surface = Surface(*arrow_triangles(part.starts, part.vectors, 1.1 * reach), part.colour)
    elif isinstance(part, Dots):
        surface = Surface(*ball_triangles(part.points, 0.5 * part.size * reach), part.colour)
    else:
        surface = part
    _add_surface(plotter, pv, surface, scene)
    if len(ends := surface.sides):
        cells = np.column_stack([np.full(len(ends), 2), ends]).ravel()
        ahead = 1.5 * reach * lens.camera.axes[2]
        wire = pv.PolyData(np.asarray(surface.points, float) + ahead, lines=cells)
        width = 0.7 * dots_per_point
        plotter.add_mesh(wire, color=style.INK, line_width=width, opacity=0.6, **flat)


def _add_surface(plotter, pv, part: Surface, scene: Scene) -> None:
    from sorojax.view.raster.raster import corner_normals

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
        mesh["value"] = part.corner_values.ravel()
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
