"""The film of a moving body with its chambers, target and signals."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from sorojax.mesh import Mesh, boundary_facets
from sorojax.view import style
from sorojax.view.draw.figures import Signals, draw_signals
from sorojax.view.film.film import Film, animate_figure, frames_at
from sorojax.view.raster.plane import as_path, box, flat_triangles, loops

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIZE = (6.4, 4.0)
_DPI = 100


def film_of_mesh(
    mesh: Mesh,
    positions: Float[Any, "frames nodes 2"],
    *,
    time: Float[Any, " frames"],
    pressure: Float[Any, " frames"] | None = None,
    cavities: Int[Any, "facets facet_nodes"] | None = None,
    field: Float[Any, "frames nodes"] | None = None,
    field_label: str = "",
    lines: Mapping[str, Float[Any, "frames points 2"]] | None = None,
    signals: Signals | None = None,
    caption: str = "",
    fps: float = 20.0,
    path: str | Path | None = None,
) -> Film:
    """Film of a moving body in real time, 640 x 400 pixels.

    Args:
        mesh: The body at rest.
        positions: Node positions at every instant [m].
        time: The instants [s]; the film takes those nearest to its frames.
        pressure: Gauge pressure in the cavities [Pa], shown as their colour and as text.
        cavities: Facets of the cavities, from `mesh.facets_on(mesh, chambers)`.
        field: Values at the nodes that colour the body, e.g. a stress.
        field_label: Name and unit of the field.
        lines: Lines that move along, e.g. `{"target": ray(tip, angle, length)}` [m].
        signals: Panels as in `show_signals`, drawn as time goes on.
        caption: Title of the film.
        fps: Frames per second.
        path: Where to write the GIF; it is also in the result.
    """
    time, positions = np.asarray(time), 1e3 * np.asarray(positions)
    tracks = {name: 1e3 * np.asarray(line) for name, line in (lines or {}).items()}
    _check_lengths(mesh, time, positions, pressure, field, tracks)
    lower, upper = box(np.asarray(mesh.points) * 1e3, positions, *tracks.values())
    figure, axes, panels = _layout(lower, upper, signals)
    style.dress_plane(axes, lower, upper)
    style.title(figure, caption)
    parts: list[Any] = [_Body(axes, mesh, positions, field, field_label)]
    if cavities is not None and pressure is not None:
        parts.append(_Cavities(axes, positions, loops(cavities), np.asarray(pressure)))
    parts.append(_Tracks(axes, tracks))
    parts.append(_Stamp(axes, time, pressure))
    for panel, (label, lines_of) in zip(panels, (signals or {}).items(), strict=True):
        parts.append(_Panel(panel, time, label, lines_of))
        place = panel.get_subplotspec()
        if place is None or place.is_last_row():
            panel.set_xlabel("time [s]", fontsize=style.LABEL, color=style.INK)
        else:
            panel.tick_params(labelbottom=False)
    chosen = frames_at(time, fps)

    def update(k: int) -> "list[Artist]":
        return [artist for part in parts for artist in part.move(int(chosen[k]))]

    film = animate_figure(figure, update, len(chosen), fps=fps)
    if path is not None:
        film.save(path)
    return film


def ray(
    origin: Float[Any, "frames 2"], angle: Float[Any, " frames"], length: float
) -> Float[np.ndarray, "frames 2 2"]:
    """Line of `length` [m] from `origin` at `angle` [rad], to mark a wanted direction."""
    origin, angle = np.asarray(origin), np.asarray(angle)
    tip = origin + length * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.stack([origin, tip], axis=1)


class _Body:
    """The outline, filled or coloured by a field."""

    def __init__(self, axes: "Axes", mesh: Mesh, positions, field, label: str):
        from matplotlib.patches import PathPatch
        from matplotlib.tri import Triangulation

        self.positions, self.field = positions, None if field is None else np.asarray(field)
        self.rings = loops(boundary_facets(mesh))
        plain = field is None
        self.patch = PathPatch(
            as_path(positions[0], self.rings), facecolor="#c9d3df", fill=plain,
            edgecolor=style.INK, linewidth=0.8,
        )  # fmt: skip
        axes.add_patch(self.patch)
        self.artists: list[Artist] = [self.patch]
        if self.field is not None:
            triangles = flat_triangles("film_of_mesh", mesh)
            self.triangulation = Triangulation(
                positions[0, :, 0], positions[0, :, 1], triangles
            )
            low, high = min(0.0, self.field.min()), np.percentile(self.field, 99.5)
            self.colours = axes.tripcolor(
                self.triangulation, self.field[0], shading="gouraud", cmap=style.FIELD,
                vmin=low, vmax=high,
            )  # fmt: skip
            extend = "max" if self.field.max() > high else "neither"
            figure: Any = axes.figure
            style.colour_bar(figure, self.colours, axes, label, extend=extend, shrink=0.8)
            self.artists.insert(0, self.colours)

    def move(self, k: int) -> "list[Artist]":
        self.patch.set_path(as_path(self.positions[k], self.rings))
        if self.field is not None:
            self.triangulation.x, self.triangulation.y = self.positions[k].T
            self.colours.set_array(self.field[k])
        return self.artists


class _Cavities:
    """Chambers filled with a colour that tells their pressure."""

    def __init__(self, axes: "Axes", positions, rings, pressure: np.ndarray):
        from matplotlib import colormaps
        from matplotlib.colors import Normalize
        from matplotlib.patches import PathPatch

        self.positions, self.rings, self.pressure = positions, rings, pressure
        self.scale = Normalize(min(0.0, pressure.min()), max(pressure.max(), 1.0))
        self.colours = colormaps["OrRd"]
        path = as_path(positions[0], rings)
        self.patch = PathPatch(path, edgecolor="none")
        axes.add_patch(self.patch)

    def move(self, k: int) -> "list[Artist]":
        self.patch.set_path(as_path(self.positions[k], self.rings))
        self.patch.set_facecolor(self.colours(0.75 * self.scale(self.pressure[k])))
        return [self.patch]


class _Tracks:
    """Named lines such as a target."""

    def __init__(self, axes: "Axes", tracks: dict[str, np.ndarray]):
        styles = style.line_styles(tracks)
        self.pairs = [
            (axes.plot(*track[0].T, label=name, **styles[name])[0], track)
            for name, track in tracks.items()
        ]
        style.legend(axes, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1)

    def move(self, k: int) -> "list[Artist]":
        for line, track in self.pairs:
            line.set_data(*track[k].T)
        return [line for line, _ in self.pairs]


class _Stamp:
    """Time and pressure as text."""

    def __init__(self, axes: "Axes", time: np.ndarray, pressure):
        self.time = time
        self.pressure = None if pressure is None else np.asarray(pressure)
        self.text = axes.text(
            0.0, 1.03, self.line(0), transform=axes.transAxes, fontsize=style.LABEL,
            color=style.INK, family="monospace", va="bottom",
        )  # fmt: skip

    def line(self, k: int) -> str:
        pressure = "" if self.pressure is None else f"  {self.pressure[k] / 1e3:5.1f} kPa"
        return f"{self.time[k]:5.2f} s{pressure}"

    def move(self, k: int) -> "list[Artist]":
        self.text.set_text(self.line(k))
        return [self.text]


class _Panel:
    """Signals that grow with time; references are there from the start."""

    def __init__(self, axes: "Axes", time: np.ndarray, label: str, signals):
        self.time = time
        lines = draw_signals(axes, time, "", signals)
        axes.set_title(label, fontsize=style.LABEL, color=style.INK, loc="left")
        axes.set_xlim(time[0], time[-1])
        style.legend(axes, loc="best")
        axes.set_ylim(axes.get_ylim())
        moving = [line for line in lines.values() if line.get_color() != style.REFERENCE]
        self.pairs = [(line, np.asarray(line.get_ydata())) for line in moving]
        self.cursor = axes.axvline(time[0], color=style.GREY, linewidth=0.8)

    def move(self, k: int) -> "list[Artist]":
        self.cursor.set_xdata([self.time[k]] * 2)
        for line, values in self.pairs:
            line.set_data(self.time[: k + 1], values[: k + 1])
        return [self.cursor, *(line for line, _ in self.pairs)]


def _layout(lower, upper, signals) -> "tuple[Figure, Axes, list[Axes]]":
    """Body and panels side by side, or above each other for a long body."""
    figure = style.new_figure(*_SIZE)
    figure.set_dpi(_DPI)
    count = len(signals or {})
    if not count:
        return figure, figure.add_subplot(), []
    if (upper - lower)[0] > 2.2 * (upper - lower)[1]:
        grid = figure.add_gridspec(2, count, height_ratios=[1.2, 1])
        cells = [grid[1, k] for k in range(count)]
        return figure, figure.add_subplot(grid[0, :]), [figure.add_subplot(c) for c in cells]
    grid = figure.add_gridspec(count, 2, width_ratios=[1.7, 1])
    cells = [grid[k, 1] for k in range(count)]
    return figure, figure.add_subplot(grid[:, 0]), [figure.add_subplot(c) for c in cells]


def _check_lengths(mesh: Mesh, time, positions, pressure, field, tracks) -> None:
    want: dict[str, Any] = {"positions": (positions, (len(time), mesh.num_nodes, 2))}
    if pressure is not None:
        want["pressure"] = (np.asarray(pressure), (len(time),))
    if field is not None:
        want["field"] = (np.asarray(field), (len(time), mesh.num_nodes))
    for name, track in tracks.items():
        want[name] = (track, (len(time), track.shape[1] if track.ndim == 3 else 2, 2))
    for name, (value, shape) in want.items():
        if value.shape != shape:
            raise ValueError(
                f"film_of_mesh: `{name}` has shape {value.shape}, need {shape}. Give one entry "
                "per instant of `time`."
            )
        if not np.all(np.isfinite(value)):
            raise ValueError(
                f"film_of_mesh: `{name}` holds NaN or infinity. Cut the motion where it failed."
            )
