"""Error over CPU time for the documentation, from a recorded run of benchmarks.

`python -m benchmarks.curves` draws `docs/pictures/curves_*.png` from `recorded/curves.jsonl`.
It measures nothing; `python -m benchmarks --cpu CASE... --json FILE` writes such lines.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
from matplotlib.figure import Figure

from benchmarks.rows import KEYS

RECORDED = Path(__file__).parent / "recorded" / "curves.jsonl"
PICTURES = Path(__file__).parent.parent / "docs" / "pictures"
#: Of Okabe and Ito: told apart with every kind of colour blindness.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
MARKS = "os^DvPX"
Line = dict[str, Any]


class Curve(NamedTuple):
    """The name of a curve; those of one group share a colour."""

    label: str
    group: str
    is_dashed: bool = False


class Panel(NamedTuple):
    """One case: its title, what its error is of, and the curve of a line, if it has one."""

    case: str
    title: str
    error: str
    curve: Callable[[Line], Curve | None]


def _statics(line: Line) -> Curve | None:
    name = line["settings"]["case"]
    # one mode bends into a circle: nothing but rounding is left
    return None if name == "roll-up" else Curve(name, name)


def _simulation(line: Line) -> Curve:
    told = line["settings"]
    name = f"{line['code']}, {told['method']}" if "method" in told else line["code"]
    is_dashed = told.get("by") == "sorojax.jit"
    return Curve(f"{name}, sj.jit" if is_dashed else name, name, is_dashed)


def _continuum(line: Line) -> Curve:
    return Curve(line["code"], line["code"])


def _bellows(line: Line) -> Curve:
    name = f"{line['code']}, {line['settings'].get('element', 'Tri6')}"
    return Curve(name, name)


def _cook(line: Line) -> Curve | None:
    told = line["settings"]
    element, formulation = told["element"], told["formulation"]
    if told["poisson_ratio"] != 0.4999 or element not in ("Quad4", "Quad9", "Tri6", "Tri7"):
        return None
    pressure = {
        "Displacement": "displacement only",
        "ConstantPressure": "constant pressure",
        "LinearPressure": "linear pressure",
    }[formulation]
    return Curve(f"{element}, {pressure}", element, formulation == "Displacement")


TIP, CORNER = "error of the tip / length", "relative error of the tip"
FIGURES = {
    "rod_statics": (
        Panel("rod.statics", "Static rods of the literature", "error of the tip", _statics),
    ),
    "rod_dynamics": (
        Panel("rod.simulation", "Bending finger, 0.5 s", TIP, _simulation),
        Panel("rod.continuum", "Finger that stretches too, 0.5 s", TIP, _continuum),
    ),
    "fem": (
        Panel("fem.case_a", "Bellows to 20 kPa in four states", CORNER, _bellows),
        Panel("fem.cook", "Cook's membrane, Poisson's ratio 0.4999", CORNER, _cook),
    ),
}


def read(file: Path = RECORDED) -> list[Line]:
    """The lines of a run that have a time and an error."""
    lines = [json.loads(text) for text in file.read_text().splitlines()]
    assert all(tuple(line) == KEYS for line in lines)
    return [line for line in lines if line["run_s"] and line["error"]]


def curves(panel: Panel, lines: list[Line]) -> dict[Curve, list[tuple[float, float]]]:
    """Shortest run and error of each curve, from coarse to fine as measured."""
    found: dict[Curve, list[tuple[float, float]]] = {}
    for line in lines:
        if line["case"] == panel.case and (curve := panel.curve(line)) is not None:
            found.setdefault(curve, []).append((line["run_s_min"], line["error"]))
    return found


def draw(lines: list[Line], folder: Path = PICTURES) -> list[Path]:
    """A picture for each entry of `FIGURES`."""
    style: Any = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
    files = []
    with matplotlib.rc_context(style):
        for name, panels in FIGURES.items():
            is_wide = len(panels) > 1
            figure = Figure(figsize=(7.4, 4.5 if is_wide else 2.9), layout="constrained")
            row = figure.subplots(1, len(panels), squeeze=False)[0]
            for axes, panel in zip(row, panels, strict=True):
                _panel(axes, panel, curves(panel, lines))
                place = (0.0, -0.2) if is_wide else (1.02, 1.0)
                axes.legend(loc="upper left", bbox_to_anchor=place, frameon=False, fontsize=8)
            files.append(folder / f"curves_{name}.png")
            figure.savefig(files[-1], dpi=150)
    return files


def _panel(axes, panel: Panel, found) -> None:
    groups = list(dict.fromkeys(curve.group for curve in found))
    for curve, points in found.items():
        place = groups.index(curve.group)
        axes.loglog(
            *zip(*points, strict=True),
            color=COLOURS[place],
            marker=MARKS[place],
            linestyle="--" if curve.is_dashed else "-",
            markersize=4.5,
            linewidth=1.3,
            label=curve.label,
        )
    axes.set_title(panel.title, fontsize=9.5)
    axes.set_xlabel("CPU time [s]")
    axes.set_ylabel(panel.error)
    axes.grid(alpha=0.3, which="major")


if __name__ == "__main__":
    for written in draw(read()):
        print(f"written: {written} ({written.stat().st_size // 1000} kB)")
