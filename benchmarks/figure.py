"""The figure of the README, from figures that benchmarks printed and NOTES.md and README.md of
this folder quote: `python -m benchmarks.figure` writes docs/explanation/speed_and_accuracy.png.

It measures nothing. Each panel names the command that does; change a number here where that
command gives another.
"""

from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

FILE = Path(__file__).parent.parent / "docs" / "explanation" / "speed_and_accuracy.png"
BLUE, RED, GREY = "#0b6e99", "#c8553d", "#8a8a8a"

#: `rod.flight`, in space: elements or modes, seconds of CPU, largest error of both ends after
#: 5 s over the length (NOTES.md, "rod.flight, rod.spin").
FLIGHT = {
    "PyElastica 1.0, 20 to 320 elements": (
        RED,
        (0.13, 0.15, 0.39, 0.83, 2.7),
        (2.7e-3, 4.4e-4, 1.5e-4, 2.0e-4, 2.1e-4),
    ),
    "sorojax, 4 to 10 modes": (
        BLUE,
        (0.33, 0.50, 0.97, 1.6),
        (1.4e-3, 1.4e-4, 4.6e-5, 3.7e-6),
    ),
}
#: `rod.acceleration` (one core of a shared machine), `device.rods` (recorded/README.md): us.
ACCELERATION = {
    "soromox 0.5.0": (98.0, RED),
    "sorojax, jax.jit": (4.6, BLUE),
    "sorojax, sj.jit": (2.1, BLUE),
    "in a batch on an H100": (0.026, BLUE),
}
#: `--quick fem.cook`, Poisson's ratio 0.4999: error of the tip [%].
COOK = {
    "Quad4, pressure at points": (58.8, GREY),
    "Quad4 (default)": (0.65, BLUE),
    "Tri7 (mesh.enrich)": (0.36, BLUE),
    "Quad9 (mesh.enrich)": (0.14, BLUE),
}


def draw(file: Path = FILE) -> Path:
    """The three panels as a PNG file."""
    style: Any = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
    with matplotlib.rc_context(style):
        figure = Figure(figsize=(11.6, 3.1))
        axes = figure.subplots(1, 3, width_ratios=(1.3, 1, 1))
        _flight(axes[0])
        _bars(axes[1], ACCELERATION, "us", "Acceleration of a finger, 6 coordinates")
        _bars(axes[2], COOK, "%", "Cook's membrane: error")
        figure.tight_layout(w_pad=2.0)
        figure.savefig(file, dpi=110)
    return file


def _flight(axes):
    for name, (colour, seconds, errors) in FLIGHT.items():
        axes.loglog(seconds, errors, "o-", color=colour, markersize=4)
        axes.text(seconds[0] * 1.15, errors[0] * 1.5, name, color=colour, fontsize=8.5)
    axes.set_title("A rod in free flight: error over cost", fontsize=9.5)
    axes.set_xlabel("CPU for 5 s of motion [s]")
    axes.set_ylabel("error of the ends / length")
    axes.set_xlim(0.1, 10)
    axes.set_ylim(1e-6, 2e-2)
    ticks = (0.1, 1, 10)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.grid(alpha=0.3, which="major")


def _bars(axes, values, unit, title):
    """Bars on a logarithmic scale, each with its number."""
    names = list(values)[::-1]
    sizes, colours = zip(*(values[name] for name in names), strict=True)
    rows = range(len(names))
    axes.barh(rows, sizes, color=colours, height=0.6)
    axes.set_yticks(rows, names)
    axes.set_xscale("log")
    axes.set_xlim(min(sizes) / 4, max(sizes) * 10)
    for row, size in zip(rows, sizes, strict=True):
        axes.text(size * 1.2, row, f"{size:g} {unit}", va="center", fontsize=8.5)
    axes.set_title(title, fontsize=9.5)
    axes.minorticks_off()
    axes.set_xticks([])
    axes.set_xlabel("logarithmic scale", fontsize=8, color=GREY)
    axes.spines["bottom"].set_visible(False)


if __name__ == "__main__":
    print(f"written: {draw()}")
