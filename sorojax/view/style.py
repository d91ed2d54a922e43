"""One look for all figures: sizes, colours, axes. Nothing global is changed.

Figures are made without pyplot, so they need no display and may be drawn in threads.
"""

import io
from collections.abc import Iterable, Sequence
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

#: Okabe and Ito's palette, safe for colour-blind readers; black is kept for references.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
INK, GREY, LIGHT = "#1f2430", "#8a8f98", "#d9dce1"
REFERENCE = "#1f2430"
FIELD, SIGNED = "viridis", "coolwarm"
AXES = ("#c0392b", "#1e8449", "#1f5fa8")
#: Bodies, what acts on them, what holds them, what they rest on.
BODY, LOAD, HOLD, OBSTACLE = "#c9d3df", "#D55E00", "#1f2430", "#b9a888"

TITLE, LABEL, SMALL = 12.0, 10.0, 9.0
DASHES = (0, (4, 2))
_REFERENCE_WORDS = ("reference", "target", "setpoint", "set-point")


def new_figure(width: float, height: float, layout: Any = "constrained") -> "Figure":
    """An empty figure of `width` x `height` inches that keeps its labels inside."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=140, layout=layout, facecolor="white")
    if layout == "constrained":
        figure.get_layout_engine().set(w_pad=0.08, h_pad=0.08)  # type: ignore[union-attr]
    FigureCanvasAgg(figure)
    return figure


def grid(figure: "Figure", count: int, columns: int, **options: Any) -> "list[Axes]":
    """`count` axes row by row."""
    every = figure.subplots(-(-count // columns), columns, squeeze=False, **options).ravel()
    for spare in every[count:]:
        spare.remove()
    return list(every[:count])


def height_for(width: float, lower, upper) -> float:
    """Height of a figure [inch] that shows a box of these corners."""
    span = np.maximum(np.subtract(upper, lower), 1e-9)
    return float(np.clip(1.2 + 0.8 * width * span[1] / span[0], 2.6, 9.0))


def dress(axes: "Axes", x: str = "", y: str = "", title: str = "", grid: bool = True) -> None:
    """Labels, a light grid and no box."""
    axes.set_facecolor("white")
    axes.set_xlabel(x, fontsize=LABEL, color=INK)
    axes.set_ylabel(y, fontsize=LABEL, color=INK)
    if title:
        axes.set_title(title, fontsize=LABEL, color=INK, loc="left")
    axes.tick_params(labelsize=SMALL, colors=INK, length=3, color=GREY)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GREY)
    axes.set_axisbelow(True)
    axes.grid(grid, color=LIGHT, linewidth=0.6)


def dress_plane(axes: "Axes", lower, upper, x: str = "x [mm]", y: str = "y [mm]") -> None:
    """Equal axes in mm around the box from `lower` to `upper` [mm]."""
    margin = 0.04 * float(np.max(np.subtract(upper, lower)))
    dress(axes, x, y)
    axes.set_aspect("equal")
    axes.set_xlim(lower[0] - margin, upper[0] + margin)
    axes.set_ylim(lower[1] - margin, upper[1] + margin)


def title(figure: "Figure", text: str) -> None:
    if text:
        figure.suptitle(text, fontsize=TITLE, color=INK, fontweight="bold")


def write(
    on: Any, x: float, y: float, text: str, ha: str = "center", va: str = "center", **look: Any
) -> "Text":
    """Small dark text on axes or a figure, `look` as of matplotlib."""
    return on.text(x, y, text, ha=ha, va=va, **({"fontsize": SMALL, "color": INK} | look))


def heading(on: Any, x: float, y: float, text: str, va: str = "top") -> None:
    """A title where the layout does not place it."""
    write(on, x, y, text, va=va, fontsize=TITLE, fontweight="bold")


def legend(axes: "Axes", **options: Any) -> None:
    """A legend without a frame; nothing if there is nothing to name."""
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=SMALL, labelcolor=INK, **options)


def colour_bar(figure: "Figure", mappable: Any, axes: Any, label: str, **options: Any) -> None:
    bar = figure.colorbar(mappable, ax=axes, **options)
    bar.set_label(label, fontsize=LABEL, color=INK)
    bar.ax.tick_params(labelsize=SMALL, colors=INK, length=3, color=GREY)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]


def line_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Line style of each name: references dashed and dark, the others in colours."""
    styles: dict[str, dict[str, Any]] = {}
    colours = iter(COLOURS * 4)
    for name in names:
        if any(word in name.lower() for word in _REFERENCE_WORDS):
            styles[name] = {"color": REFERENCE, "linestyle": DASHES, "linewidth": 1.3}
        else:
            styles[name] = {"color": next(colours), "linewidth": 1.7}
    return styles


def shades(count: int) -> Sequence[Any]:
    """Colours from low to high for an ordered family of lines."""
    from matplotlib import colormaps

    return [colormaps[FIELD](v) for v in np.linspace(0.0, 0.88, max(count, 1))]


def asset(*names: str) -> str:
    """Text of files in the folder `assets`, one after the other."""
    folder = resources.files("sorojax.view") / "assets"
    return "".join((folder / name).read_text(encoding="utf-8") for name in names)


def pale(colour: str, share: float) -> str:
    """A colour with `share` of white."""
    from matplotlib.colors import to_hex, to_rgb

    return to_hex(tuple((1 - share) * np.array(to_rgb(colour)) + share))


def png(figure: "Figure") -> bytes:
    """A figure of matplotlib as a PNG file in memory.

    Args:
        figure: The figure, as `show(...).figure`.

    Returns:
        The bytes of the file, at the dots per inch of the figure.

    Example:
        >>> picture = view.show(rod.circle(5 * mm))
        >>> view.png(picture.figure)[1:4]
        b'PNG'
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=figure.dpi)
    return buffer.getvalue()
