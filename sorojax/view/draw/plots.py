"""Plots: strain modes, backbones, signals, errors, materials, calibrations, sweeps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax.design.calibration.calibration import Calibration
from sorojax.material import AbstractHyperelastic, strain_energy_density, uniaxial_stress
from sorojax.material.fit import TensileFit
from sorojax.reduction.backbone import Backbone
from sorojax.rod import Rod, StrainBasis, columns, forward_kinematics
from sorojax.view import style
from sorojax.view.picture import Picture, plotted, spread
from sorojax.view.raster.glyphs import circle

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Signals = Mapping[str, Mapping[str, Any]]

_SYMBOL = {
    "kappa_x": r"twist $\kappa_x$",
    "kappa_y": r"curvature $\kappa_y$",
    "kappa_z": r"curvature $\kappa_z$",
    "sigma_x": r"stretch $\sigma_x$",
    "sigma_y": r"shear $\sigma_y$",
    "sigma_z": r"shear $\sigma_z$",
}


def show_basis(
    basis: StrainBasis,
    *,
    length: float | Float[Array, ""] = 1.0,
    energy: Mapping[str, float | Sequence[float]] | None = None,
    title: str = "",
) -> Picture:
    """Strain modes along the arc length, one panel per active strain.

    Args:
        basis: The modes.
        length: Rest length of the rod [m].
        energy: Captured share in [0, 1] per strain, in total (`captured_energy`) or as
            one number per mode.
        title: Title of the figure.
    """
    s = np.linspace(0.0, 1.0, 801)
    values = np.asarray(basis(s))
    count = len(basis.active)
    figure = style.new_figure(8.5, 0.6 + 2.9 * count)
    panels = style.grid(figure, count, 1, sharex=True)
    for row, (panel, name) in enumerate(zip(panels, basis.active, strict=True)):
        shapes = values[row][:, columns(basis, name)].T
        share = np.ravel((energy or {}).get(name, ()))
        along, shades = s * 1e3 * float(length), style.shades(len(shapes))
        for k, (shape, colour) in enumerate(zip(shapes, shades, strict=True)):
            part = f", {_percent(share[k])}" if len(share) == len(shapes) > 1 else ""
            panel.plot(along, shape, color=colour, lw=1.9, label=f"mode {k + 1}{part}")
        captured = f": {_percent(share.sum())} of the squared strain captured"
        total = captured if share.size else ""
        unit = "1/m" if name.startswith("kappa") else "-"
        style.dress(panel, "", f"shape [-], $q$ in [{unit}]", f"{_SYMBOL[name]}{total}")
        panel.axhline(0.0, color=style.GREY, lw=0.8, zorder=1)
        style.legend(panel, loc="center left", bbox_to_anchor=(1.0, 0.5))
    panels[-1].set_xlabel("arc length [mm]", fontsize=style.LABEL, color=style.INK)
    panels[-1].set_xlim(0.0, 1e3 * float(length))
    return plotted(figure, panels, title)


def backbone_errors(
    backbone: Backbone, rod: Rod, qs: Float[Array, "steps dof"]
) -> Float[Array, " steps"]:
    """Mean distance between backbone and rod over their samples, per snapshot [m].

    Args:
        backbone: Snapshots, from `strain_along`.
        rod: The rod that should follow them.
        qs: Coordinates of the rod at the snapshots.

    Returns:
        One distance per snapshot [m].
    """
    gap = _rod_lines(rod, qs, backbone.s) - backbone.positions
    return jnp.mean(jnp.sqrt(jnp.sum(gap**2, axis=2)), axis=1)


@once
def _rod_lines(rod: Rod, qs, s) -> Float[Array, "steps samples 2"]:
    return jax.lax.map(lambda q: forward_kinematics(rod, q, s)[:, :2, 2], qs)


def show_backbones(
    backbone: Backbone,
    rod: Rod,
    qs: Float[Array, "steps dof"],
    *,
    pressures: Float[Any, " steps"] | None = None,
    bar: float = 1e-3,
    title: str = "",
) -> Picture:
    """Backbones of the solid against those of a rod, and the distance between them.

    Args:
        backbone: Snapshots, from `strain_along`.
        rod: The rod that should follow them.
        qs: Coordinates of the rod at the snapshots.
        pressures: Pressure of each snapshot [Pa]; counted if omitted.
        bar: The largest error that is accepted [m].
        title: Title of the figure.

    Returns:
        The picture.
    """
    steps = len(backbone.positions)
    solid = 1e3 * np.asarray(backbone.positions)
    line = 1e3 * np.asarray(_rod_lines(rod, qs, backbone.s))
    load = np.arange(steps) if pressures is None else np.asarray(pressures) / 1e3
    unit = "step" if pressures is None else "kPa"
    figure = style.new_figure(10.0, 4.4)
    left, right = figure.subplots(1, 2, width_ratios=[1.25, 1])
    shown = spread(steps, 6)
    for k, colour in zip(shown, style.shades(len(shown)), strict=True):
        left.plot(*solid[k].T, color=colour, lw=3.4, alpha=0.55, label=f"{load[k]:.3g} {unit}")
        name = "rod" if k == shown[-1] else None
        left.plot(*line[k].T, color=style.INK, lw=1.1, ls=style.DASHES, label=name)
    style.dress(left, "x [mm]", "y [mm]", "backbone: solid in colour, rod dashed")
    left.set_aspect("equal", adjustable="datalim")
    style.legend(left, loc="best")
    error = 1e3 * np.asarray(backbone_errors(backbone, rod, qs))
    right.plot(load, error, color=style.COLOURS[0], lw=1.8, marker="o", ms=3.5)
    right.axhline(1e3 * bar, color=style.COLOURS[1], lw=1.3, ls=style.DASHES)
    look = {"textcoords": "offset points", "va": "top", "color": style.COLOURS[1]}
    name = f"bar: {1e3 * bar:g} mm"
    right.annotate(name, (load[0], 1e3 * bar), (0, -4), fontsize=style.SMALL, **look)
    across = "load step" if pressures is None else "pressure [kPa]"
    largest = f"largest mean error {error.max():.2g} mm"
    style.dress(right, across, "mean position error [mm]", largest)
    right.set_ylim(0.0, 1.12 * max(1e3 * bar, float(error.max())))
    return plotted(figure, [left, right], title)


def show_signals(time: Float[Any, " time"], panels: Signals, *, title: str = "") -> Picture:
    """Signals over time, one panel per entry, what belongs together in one panel.

    Args:
        time: Instants [s].
        panels: `{"tip angle [deg]": {"reference": y0, "rod": y1}, ...}`; a name with
            "reference", "target" or "setpoint" is drawn dashed and dark.
        title: Title of the figure.

    Returns:
        The picture.
    """
    time = np.asarray(time)
    high = [max(1.6, 0.34 * len(lines)) for lines in panels.values()]
    figure = style.new_figure(9.0, 0.7 + sum(high))
    axes = style.grid(figure, len(panels), 1, sharex=True, height_ratios=high)
    for panel, (label, signals) in zip(axes, panels.items(), strict=True):
        _draw_signals(panel, time, label, signals)
        style.legend(panel, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes[-1].set_xlabel("time [s]", fontsize=style.LABEL, color=style.INK)
    axes[-1].set_xlim(time[0], time[-1])
    figure.align_ylabels(axes)
    return plotted(figure, axes, title)


def _draw_signals(axes: Any, time: np.ndarray, label: str, signals: Mapping[str, Any]) -> None:
    styles = style.line_styles(signals)
    for name, values in signals.items():
        values = np.asarray(values)
        do = "Give one number per instant; split vectors into several names."
        _check.shape("show_signals", name, values, time.shape, do)
        above = 3 if styles[name]["color"] == style.REFERENCE else 2
        axes.plot(time, values, label=name, zorder=above, **styles[name])
    style.dress(axes, "", label)


def _percent(share: float) -> str:
    """A share in percent that never rounds up to 100."""
    digits = 2 if share < 0.9999 else 4
    cut = np.floor(100 * float(share) * 10**digits + 1e-9) / 10**digits
    return f"{cut:.{digits}f} %"


# Snapshots of a backbone: where it is, and how it is strained along its length


_SNAPSHOTS = 8  # that are drawn


def show_snapshots(backbone: Backbone, *, title: str = "") -> Picture:
    """Snapshots in the plane of their widest motion, and the strain that changes most, each
    from pale to dark in their order.

    Args:
        backbone: From `reduction.strain_along`.
        title: Title of the figure.
    """
    places, s = 1e3 * np.asarray(backbone.positions), np.asarray(backbone.s)
    up = 1 + int(np.argmax(np.ptp(places[:, :, 1:], axis=(0, 1))))
    change = np.asarray(backbone.change)
    bends = [k for k, name in enumerate(backbone.names) if name.startswith("kappa")]
    most = bends[int(np.argmax(np.abs(change[:, :, bends]).max(axis=(0, 1))))]
    name = backbone.names[most]
    figure = style.new_figure(9.0, 3.8)
    left, right = figure.subplots(1, 2, width_ratios=[1.2, 1])
    shown = spread(len(places), _SNAPSHOTS)
    for k, colour in zip(shown, style.shades(len(shown))[::-1], strict=True):
        left.plot(places[k, :, 0], places[k, :, up], color=colour, lw=2.0)
        right.plot(s, change[k, :, most], color=colour, lw=1.7, label=f"snapshot {k}")
    style.dress(left, "x [mm]", f"{'xyz'[up]} [mm]")
    left.set_aspect("equal", adjustable="datalim")
    style.dress(right, "place along the backbone [-]", f"change of {name} [1/m]")
    style.legend(right, loc="center left", bbox_to_anchor=(1.0, 0.5))
    text = f"{len(places)} snapshots of a backbone of {1e3 * float(backbone.length):.3g} mm"
    return plotted(figure, [left, right], title or text)


# How accurate at what cost: convergence under refinement, work against precision


_MARKS = "osD^vPX"


@dataclass(frozen=True, eq=False)
class Convergence:
    """Errors of some methods as something is refined.

    Attributes:
        sizes: Sizes of cells or steps.
        errors: One row per method, as long as `sizes`.
        size_label: Name and unit of the sizes.
        error_label: Name and unit of the errors.
    """

    sizes: Float[Any, " sizes"]
    errors: Mapping[str, Float[Any, " sizes"]]
    size_label: str = "size of cells [mm]"
    error_label: str = "relative error [-]"

    def orders(self) -> dict[str, float]:
        """Order of each method between its two finest sizes."""
        order = np.argsort(np.asarray(self.sizes, float))[:2]
        size = np.asarray(self.sizes, float)[order]
        found = {}
        for name, error in self.errors.items():
            fine, coarse = np.asarray(error, float)[order]
            found[name] = float(np.log(coarse / fine) / np.log(size[1] / size[0]))
        return found


@dataclass(frozen=True, eq=False)
class WorkPrecision:
    """Errors of some methods and what each run cost.

    Attributes:
        runs: For each method times [s] and errors, of equal length.
        cost_label: Name and unit of the cost.
        error_label: Name and unit of the errors.
    """

    runs: Mapping[str, tuple[Float[Any, " runs"], Float[Any, " runs"]]]
    cost_label: str = "time [s]"
    error_label: str = "relative error [-]"


def show_convergence(data: Convergence, *, title: str = "") -> Picture:
    """Errors over sizes on logarithmic axes, with the order of each method."""
    runs = {name: (data.sizes, error) for name, error in data.errors.items()}
    names = {name: f"{name}: order {order:.2f}" for name, order in data.orders().items()}
    return _logarithmic(runs, names, data.size_label, data.error_label, title)


def show_work_precision(data: WorkPrecision, *, title: str = "") -> Picture:
    """Error over cost on logarithmic axes; lower and further left is better."""
    names = {name: name for name in data.runs}
    return _logarithmic(data.runs, names, data.cost_label, data.error_label, title)


def _logarithmic(runs: Mapping, names: dict[str, str], x: str, y: str, title: str) -> Picture:
    """A line with marks for each run of an abscissa and an error."""
    figure = style.new_figure(6.5, 4.6)
    axes = figure.add_subplot()
    for k, (name, (across, error)) in enumerate(runs.items()):
        across, error = np.asarray(across, float), np.asarray(error, float)
        _positive(name, across, error)
        along = np.argsort(across)
        look = {"color": style.COLOURS[k % 6], "marker": _MARKS[k % 7], "ms": 5, "lw": 1.6}
        axes.plot(across[along], error[along], label=names[name], **look)
    axes.set_xscale("log")
    axes.set_yscale("log")
    style.dress(axes, x, y)
    axes.grid(True, which="minor", color=style.LIGHT, linewidth=0.3)
    style.legend(axes, loc="best")
    return plotted(figure, [axes], title)


def _positive(name: str, *rows: np.ndarray) -> None:
    for row in rows:
        _check.shape("view.show", name, row, (rows[0].size,), "Give two rows of one length.")
        do = "Logarithmic axes have no zero: take absolute values, leave out exact zeros."
        _check.positive("view.show", name, row[np.isfinite(row)], "", do)


# Materials and their fits, calibrations, sweeps, tracks of markers


_PANELS = 9  # of a sweep
_TINT = "#b8b8b8"  # of markers that were not seen


def show_material(
    material: AbstractHyperelastic,
    *,
    stretches: tuple[float, float] = (0.7, 2.0),
    points: tuple[Sequence[float], Sequence[float]] | None = None,
    title: str = "",
) -> Picture:
    """Engineering stress of a uniaxial test.

    Args:
        material: A stored energy whose numbers are uniform.
        stretches: First and last stretch [-].
        points: Measured engineering strains [-] and stresses [Pa].
        title: Title of the figure.
    """
    stretch = np.linspace(*stretches, 121)
    stress = np.asarray(uniaxial_stress(material, jnp.asarray(stretch)))
    return _tensile(material, stretch, stress, points, title)


def _tensile(material: AbstractHyperelastic, stretch, stress, points, title: str) -> Picture:
    """Stress [Pa] over stretch, with measured strains and stresses if given."""
    figure = style.new_figure(6.5, 4.2)
    axes = figure.add_subplot()
    axes.axhline(0.0, color=style.GREY, lw=0.8)
    name = type(material).__name__
    axes.plot(stretch, stress / 1e3, color=style.COLOURS[0], lw=1.9, label=name)
    if points is not None:
        strain, measured = np.asarray(points[0]), np.asarray(points[1]) / 1e3
        axes.plot(1 + strain, measured, "o", color=style.COLOURS[1], ms=6, label="measured")
    style.dress(axes, "stretch [-]", "engineering stress [kPa]")
    style.legend(axes, loc="upper left")
    return plotted(figure, [axes], title)


def show_fit(
    fit: TensileFit, *, points: tuple[Any, Any] | None = None, title: str = ""
) -> Picture:
    """Stress over stretch of a fitted material, as far as it was fitted and, as in the fit,
    taken as incompressible.

    Args:
        fit: From `material.fit_tensile`.
        points: Measured engineering strains [-] and stresses [Pa].
        title: Title of the figure; the error of the fit if omitted.
    """
    low, high = fit.strain_range
    text = f"{fit.rms / 1e3:.3g} kPa rms, {100 * fit.relative_rms:.2g} %"
    stretch = np.linspace(1 + min(low, 0.0), 1 + high, 121)
    stress = np.asarray(_isochoric_stress(fit.material, jnp.asarray(stretch)))
    return _tensile(fit.material, stretch, stress, points, title or text)


@once
def _isochoric_stress(
    material: AbstractHyperelastic, stretch: Float[Array, " points"]
) -> Float[Array, " points"]:
    """Slope of the energy along isochoric uniaxial stretch [Pa]."""

    def energy(stretch):
        across = 1 / jnp.sqrt(stretch)
        F = ((stretch, 0.0, 0.0), (0.0, across, 0.0), (0.0, 0.0, across))
        return strain_energy_density(material, F)

    return jax.vmap(jax.grad(energy))(stretch)


def show_calibration(found: Calibration, *, title: str = "") -> Picture:
    """Every record beside its prediction, with twice the standard deviation that the
    parameters leave it; records that were held out have it in their name."""
    checks = [(check, "") for check in found.experiments]
    checks += [(check, ", held out") for check in found.held_out]
    figure, grid = _small_plots(len(checks))
    blue, red = style.COLOURS[:2]
    for axes, (check, note) in zip(grid, checks, strict=True):
        rows = (check.predicted, check.error, 2 * np.asarray(check.expected))
        predicted, error, wide = (np.ravel(np.asarray(row, float)) for row in rows)
        at, wide = np.arange(len(predicted)), np.broadcast_to(wide, predicted.shape)
        axes.fill_between(at, predicted - wide, predicted + wide, alpha=0.2, color=blue, lw=0)
        axes.plot(at, predicted - error, "o", ms=3.5, color=red, mew=0, label="measured")
        axes.plot(at, predicted, color=blue, lw=1.6, label="predicted")
        style.dress(axes, "reading", "", f"{check.name}{note}: {check.rms:.3g} of the noise")
    style.legend(grid[0], loc="best")
    return plotted(figure, grid, title)


def _small_plots(count: int) -> "tuple[Figure, list[Axes]]":
    """A figure with room for `count` plots, up to three in a row."""
    columns = min(count, 3)
    figure = style.new_figure(max(5.0, 3.6 * columns), 0.5 + 2.7 * -(-count // columns))
    return figure, style.grid(figure, count, columns)


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
    names = list(named)[:_PANELS]
    figure, grid = _small_plots(len(names))
    colour = style.COLOURS[0]
    for axes, name in zip(grid, names, strict=True):
        values = named[name].reshape(len(named[name]), -1)
        at, low, high = np.arange(len(values)), values.min(1), values.max(1)
        if values.shape[1] == 1:
            axes.plot(at, low, "o", ms=3.5, mew=0, color=colour)
        else:
            axes.fill_between(at, low, high, alpha=0.3, lw=0, color=colour)
            axes.plot(at, values.mean(1), color=colour, lw=1.4)
        style.dress(axes, "design", "", name)
    left = len(named) - len(names)
    more = f", {left} more names" if left else ""
    return plotted(figure, grid, title or f"{len(named[names[0]])} designs{more}")


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
    arrow = {"arrowstyle": "->", "color": style.INK}
    for number, centre in enumerate(tracks.discs.centre):
        seen = tracks.unseen[number] == 0
        colour = style.COLOURS[number % len(style.COLOURS)] if seen else _TINT
        edge = centre + tracks.discs.radius[number] * circle(64)
        axes.fill(*edge.T, color=colour, alpha=0.8 if seen else 0.4, lw=0)
        axes.annotate("", centre + tracks.velocity[number], centre, arrowprops=arrow)
        axes.text(*centre, str(number), ha="center", va="center", color="white")
    text = f"{len(tracks.unseen)} markers, {int(np.sum(tracks.stale))} stale"
    style.dress(axes, "x [px]", "y [px]", title or text)
    axes.set_aspect("equal")
    axes.invert_yaxis()  # as in the image
    return plotted(figure, [axes])
