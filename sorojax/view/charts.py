"""How accurate at what cost: convergence under refinement, work against precision."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from sorojax.view import style
from sorojax.view.picture import Panel, Picture

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
    figure = style.new_figure(6.5, 4.6)
    axes = figure.add_subplot()
    size = np.asarray(data.sizes, float)
    along = np.argsort(size)
    for k, (name, order) in enumerate(data.orders().items()):
        error = np.asarray(data.errors[name], float)
        _positive(name, size, error)
        colour = style.COLOURS[k % len(style.COLOURS)]
        axes.plot(size[along], error[along], color=colour, marker=_MARKS[k % 7], ms=5, lw=1.6,
                  label=f"{name}: order {order:.2f}")  # fmt: skip
    _logarithmic(axes, data.size_label, data.error_label)
    return _finished(figure, axes, title)


def show_work_precision(data: WorkPrecision, *, title: str = "") -> Picture:
    """Error over cost on logarithmic axes; lower and further left is better."""
    figure = style.new_figure(6.5, 4.6)
    axes = figure.add_subplot()
    for k, (name, (cost, error)) in enumerate(data.runs.items()):
        cost, error = np.asarray(cost, float), np.asarray(error, float)
        _positive(name, cost, error)
        along = np.argsort(cost)
        axes.plot(cost[along], error[along], color=style.COLOURS[k % len(style.COLOURS)],
                  marker=_MARKS[k % 7], ms=5, lw=1.6, label=name)  # fmt: skip
    _logarithmic(axes, data.cost_label, data.error_label)
    return _finished(figure, axes, title)


def _positive(name: str, *rows: np.ndarray) -> None:
    lengths = {row.shape for row in rows}
    if len(lengths) > 1 or any(row.ndim != 1 for row in rows):
        raise ValueError(
            f"view.show: `{name}` has rows of shapes {sorted(lengths)}, need two of one length."
        )
    if not all(np.all(row[np.isfinite(row)] > 0) for row in rows):
        raise ValueError(
            f"view.show: `{name}` has values that are not positive, logarithmic axes need "
            "positive ones. Take absolute values; leave out exact zeros."
        )


def _logarithmic(axes: Any, x: str, y: str) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    style.dress(axes, x, y)
    axes.grid(True, which="minor", color=style.LIGHT, linewidth=0.3)


def _finished(figure, axes, title: str) -> Picture:
    style.legend(axes, loc="best")
    style.title(figure, title)
    return Picture(figure, (Panel(axes),))
