"""Distances of shapes as filled contours: of plane shapes, and in sections of solid ones."""

from typing import TYPE_CHECKING, Any

import numpy as np

from sorojax.sdf import AbstractSdf, contour
from sorojax.sdf.sample import finite_box, values
from sorojax.view import style
from sorojax.view.picture import Panel, Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_AXES = {"x": 0, "y": 1, "z": 2}


def show_sdf(shape: AbstractSdf, *, resolution: int = 300, title: str = "") -> "Figure":
    """A plane shape: filled contours of its distance and the zero set as a line."""
    lower, upper = finite_box("show_sdf", shape, 2)
    step = float(np.max(upper - lower)) / resolution
    margin = 0.06 * resolution * step
    ranges = zip(lower - margin, upper + margin + step, strict=True)
    x, y = np.meshgrid(*(np.arange(low, high, step) for low, high in ranges))
    f = values(shape, np.stack([x.ravel(), y.ravel()], axis=1)).reshape(x.shape)
    figure, axes = _contours(x, y, f, lower - margin, upper + margin, title)
    for run in _runs(shape, step):
        axes.plot(*(1e3 * run).T, color=style.INK, lw=1.5, solid_joinstyle="miter")
    style.dress_plane(axes, 1e3 * lower, 1e3 * upper)
    return figure


def show_slice(
    shape: AbstractSdf, slice: dict[str, float], resolution: int = 300, title: str = ""
) -> Picture:
    """The distance of a solid shape in a plane across one axis, with the zero line."""
    if len(slice) != 1 or next(iter(slice)) not in _AXES:
        raise ValueError(
            f'view.show: got slice={slice}, need one axis with its place [m]: {{"z": 0.01}}.'
        )
    name, place = next(iter(slice.items()))
    across = _AXES[name]
    lower, upper = finite_box("view.show", shape, 3)
    rest = [axis for axis in range(3) if axis != across]
    low, high = lower[rest], upper[rest]
    margin = 0.06 * float(np.max(high - low))
    low, high = low - margin, high + margin
    count = np.maximum((high - low) / np.max(high - low) * resolution, 16).astype(int)
    x, y = np.meshgrid(
        *(np.linspace(a, b, n) for a, b, n in zip(low, high, count, strict=True))
    )
    points = np.full((x.size, 3), float(place))
    points[:, rest[0]], points[:, rest[1]] = x.ravel(), y.ravel()
    f = values(shape, points).reshape(x.shape)
    title = title or f"{name} = {1e3 * float(place):g} mm"
    figure, axes = _contours(x, y, f, low, high, title)
    if f.min() < 0 < f.max():
        axes.contour(1e3 * x, 1e3 * y, f, levels=[0.0], colors=style.INK, linewidths=1.5)
    style.dress_plane(axes, 1e3 * low, 1e3 * high, *(f"{'xyz'[k]} [mm]" for k in rest))
    return Picture(figure, (Panel(axes),))


def _runs(shape: AbstractSdf, size: float) -> list[np.ndarray]:
    """Closed curves of a plane shape, the first point repeated at the end."""
    return [
        np.concatenate([c.points, c.points[:1]]) if c.closed else c.points
        for c in contour(shape, size)
    ]


def _contours(x, y, f, lower, upper, title: str) -> "tuple[Figure, Axes]":
    """Filled contours of a distance over a grid [m], in a figure for the box around it."""
    figure = style.new_figure(9.0, style.height_for(9.0, lower, upper))
    axes = figure.add_subplot()
    norm, levels = _two_sided(1e3 * float(f.min()), 1e3 * float(f.max()))
    filled = axes.contourf(1e3 * x, 1e3 * y, 1e3 * f, levels=levels, cmap="RdBu_r", norm=norm)
    style.colour_bar(
        figure, filled, axes, "signed distance [mm]", format="%g", shrink=0.9, pad=0.02,
        ticks=levels[::2] if len(levels) > 12 else levels, spacing="uniform",
    )  # fmt: skip
    style.title(figure, title)
    return figure, axes


def _two_sided(low: float, high: float) -> tuple[Any, np.ndarray]:
    """Colours and round levels on each side of zero, where the depths may differ a lot."""
    from matplotlib.colors import TwoSlopeNorm
    from matplotlib.ticker import MaxNLocator

    inside = np.array(MaxNLocator(6).tick_values(min(low, -1e-9), 0.0))
    outside = np.array(MaxNLocator(6).tick_values(0.0, max(high, 1e-9)))
    levels = np.concatenate([inside[inside < 0], outside[outside >= 0]])
    return TwoSlopeNorm(0.0, levels[0], levels[-1]), levels
