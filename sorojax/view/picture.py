"""Scenes as pictures: one, or several side by side on one scale.

A picture is what `show` returns: a figure that a notebook displays and that can be written.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sorojax.view import style
from sorojax.view.raster import solid
from sorojax.view.raster.camera import Lens, View
from sorojax.view.raster.plane import bar_beside, draw_plane, name_parts, plane_figure
from sorojax.view.raster.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_KINDS = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp")


@dataclass(frozen=True, eq=False)
class Panel:
    """One drawing in a picture: its `axes`, and the `lens` if it is solid."""

    axes: "Axes"
    lens: Lens | None = None


@dataclass(frozen=True, eq=False)
class Picture:
    """A `figure` of matplotlib with what is needed to write it and to find points in it:
    `panels` has one for each drawing."""

    figure: "Figure"
    panels: tuple[Panel, ...] = field(default=(), repr=False)

    def save(self, path: str | Path, *, dpi: float | None = None) -> Path:
        """Write the picture; the ending gives the format. PDF and SVG hold vectors.

        Args:
            path: Ending in .png, .pdf, .svg, .jpg or .webp.
            dpi: Dots per inch; those of the figure if omitted.

        Raises:
            ValueError: If the ending is another one.
        """
        path = Path(path)
        if path.suffix.lower() not in _KINDS:
            raise ValueError(
                f"Picture.save: the file name ends in `{path.suffix}`, need one of "
                f"{', '.join(_KINDS)}. A film is saved as .mp4 or .gif."
            )
        metadata = {"Date": None} if path.suffix.lower() == ".svg" else None
        self.figure.savefig(path, dpi=dpi or self.figure.dpi, metadata=metadata)
        return path

    @property
    def png(self) -> bytes:
        """The picture as a PNG file in memory."""
        return style.png(self.figure)

    def pixels(
        self, points: Float[Any, "points dim"], panel: int = 0
    ) -> Float[Any, "points 2"]:
        """Where `points` [m] are in the PNG: pixels to the right and down."""
        self.figure.canvas.draw()  # the layout is known only then
        drawn, points = self.panels[panel], np.asarray(points, float)
        flat = 1e3 * points if drawn.lens is None else drawn.lens(points)[:, :2]
        at = drawn.axes.transData.transform(flat)
        high = self.figure.get_size_inches()[1] * self.figure.dpi
        return np.stack([at[:, 0], high - at[:, 1]], axis=1)

    def _repr_png_(self) -> bytes:
        return self.png

    def _repr_html_(self) -> None:
        return None  # a notebook takes the PNG

    def __repr__(self) -> str:
        wide, high = self.figure.get_size_inches() * self.figure.dpi
        return f"Picture: {wide:.0f} x {high:.0f} pixels; .save('name.png'), .figure"


def plotted(figure: "Figure", axes: "Iterable[Axes]", title: str = "") -> Picture:
    """A figure whose plots in `axes` are complete."""
    style.title(figure, title)
    return Picture(figure, tuple(Panel(each) for each in axes))


def show_scene(scene: Scene, *, view: View = "iso", renderer: str = "auto") -> Picture:
    """One scene, in the plane with axes or shaded in space.

    Args:
        scene: From `scene_of`, or put together from `Surface`, `Lines`, `Arrows` and `Dots`.
        view: Camera of a solid scene.
        renderer: Of a solid scene.
    """
    if scene.dim == 2:
        figure, axes = plane_figure(scene)
        return plotted(figure, [axes], scene.title)
    figure, lens = solid.solid_figure(scene, view=view, renderer=renderer)
    return Picture(figure, (Panel(figure.axes[0], lens),))


def draw_into(
    axes: "Axes | Sequence[Axes]",
    scenes: Scene | Sequence[Scene],
    *,
    view: View = "iso",
    renderer: str = "own",
    shadows: bool = True,
    bar: bool = True,
    scale: bool = True,
) -> None:
    """Draw solid scenes into axes of a figure of your own, all by one lens and on one scale.

    Call it after everything else is in the figure: its layout is computed and kept then, and
    each scene is drawn as large as its axes are. Axes of later calls are switched off before.
    Lengths are told by a bar in the first axes.

    Args:
        axes: Of matplotlib; one, or one per scene. Those of one size show one scale.
        scenes: From `scene_of`, `scenes_of`, `extrude` or `merge_scenes`.
        view: Of all.
        renderer: "own" gives the same picture everywhere; "auto" is pyvista where it is.
        shadows: Whether bodies throw shadows on each other.
        bar: Put a colour bar beside the axes if the first scene has a scale of values.
        scale: Put a bar of known length into the first axes.

    Raises:
        ValueError: If there are not as many axes as scenes, or a scene is plane.

    Example:
        >>> from matplotlib.figure import Figure
        >>> figure = Figure(figsize=(4, 3), layout="constrained")
        >>> ball = view.scene_of(sdf.Sphere([0, 0, 0], 10 * mm))
        >>> view.draw_into(figure.add_subplot(), ball)
    """
    every = [axes] if not isinstance(axes, Sequence | np.ndarray) else list(axes)
    scenes = [scenes] if isinstance(scenes, Scene) else list(scenes)
    _check_axes(every, scenes)
    figure = _root(every[0])
    for each in every:
        each.set_axis_off()
    if bar and scenes[0].scale is not None:
        bar_beside(figure, every, scenes[0].scale)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for k, (each, scene) in enumerate(zip(every, scenes, strict=True)):
        lens = solid.lens_of(scenes, view, solid.size_of(each))
        solid.draw_solid(figure, each, scene, renderer=renderer, lens=lens, shadows=shadows)
        if scale and k == 0:
            unit = figure.dpi / 72
            low = lens.size[1] - 6 * unit
            solid.scale_bar(each, lens, 2 * unit, low, 4 * unit)


def _root(axes: "Axes") -> "Figure":
    """The figure that holds the layout: not a subfigure."""
    figure: Any = axes.figure
    while not hasattr(figure, "set_layout_engine"):
        figure = figure.figure
    return figure


def _check_axes(axes: list, scenes: list) -> None:
    if not scenes or len(axes) != len(scenes):
        raise ValueError(
            f"view.draw_into: got {len(axes)} axes for {len(scenes)} scenes, need as many. "
            "Pass one of each, or two sequences of one length."
        )
    if any(scene.dim != 3 for scene in scenes):
        raise ValueError(
            "view.draw_into: got a plane scene, need solid ones. Give it a depth by "
            "view.extrude, or draw it by view.show."
        )


def panels(
    scenes: Sequence[Scene],
    names: Sequence[str],
    *,
    view: View = "iso",
    renderer: str = "auto",
    title: str = "",
    width: float = 10.0,
) -> Picture:
    """One panel per scene, all with the scale of the first and the same view."""
    if scenes[0].dim == 2:
        return _plane(scenes, names, title, width)
    return _solid(scenes, names, view, renderer, title, width)


def _plane(scenes, names, title: str, width: float) -> Picture:
    lower, upper = (1e3 * corner for corner in scenes[0].box)
    span = np.maximum(upper - lower, 1e-9)
    aspect = float(span[1] / span[0])
    rows, columns = _grid(len(scenes), aspect)
    height = min(0.7 + rows * (0.35 + aspect * (width - 1.4) / columns), 12.0)
    figure = style.new_figure(width, max(height, 2.7 if scenes[0].scale else 2.0))
    grid = style.grid(figure, len(scenes), columns, sharex=True, sharey=True)
    for axes, scene, name in zip(grid, scenes, names, strict=True):
        draw_plane(axes, scene)
        style.dress_plane(axes, lower, upper)
        axes.set_title(name, fontsize=style.LABEL, color=style.INK)
        axes.label_outer()
    name_parts(grid[columns - 1], scenes[0])
    if scenes[0].scale is not None:
        bar_beside(figure, grid, scenes[0].scale)
    return plotted(figure, grid, title)


def _solid(scenes, names, view: View, renderer: str, title: str, width: float) -> Picture:
    aspect = float(np.clip(solid.aspect_of(scenes[0], view), 0.3, 1.6))
    rows, columns = _grid(len(scenes), aspect)
    right = 1.05 if scenes[0].scale is not None else 0.1
    each = (width - right) / columns
    head = 0.45 if title else 0.1
    height = head + rows * (0.28 + aspect * each)
    figure = style.new_figure(width, height, layout="none")
    drawn = []
    for k, (scene, name) in enumerate(zip(scenes, names, strict=True)):
        row, column = divmod(k, columns)
        low = height - head - (row + 1) * (0.28 + aspect * each)
        place = (column * each / width, low / height, each / width, aspect * each / height)
        axes = figure.add_axes(place)
        shown = scenes if scene.extent is None else scenes[:1]
        lens = solid.lens_of(shown, view, solid.size_of(axes))
        solid.draw_solid(figure, axes, replace(scene, title=""), renderer=renderer, lens=lens)
        middle, above = (column + 0.5) * each / width, (low + aspect * each) / height
        style.write(figure, middle, above, name, va="bottom", fontsize=style.LABEL)
        drawn.append(Panel(axes, lens))
    if scenes[0].scale is not None:
        place = (1 - 0.95 / width, 0.15, 0.16 / width, 0.7)
        solid.bar_of(figure, scenes[0].scale, figure.add_axes(place))
    if title:
        style.heading(figure, 0.5, 1 - 0.12 / height, title)
    return Picture(figure, tuple(drawn))


def spread(count: int, most: int) -> list[int]:
    """Up to `most` of `count` states, evenly spaced from the first to the last."""
    return np.unique(np.round(np.linspace(0, count - 1, most)).astype(int)).tolist()


def _grid(count: int, aspect: float) -> tuple[int, int]:
    """Rows and columns: wide bodies in two columns, others in three."""
    columns = min(count, 2 if aspect < 0.4 else 3)
    return -(-count // columns), columns
