"""Lines of results as a table for the terminal and as one self-contained page."""

import os
import platform
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from html import escape
from importlib import metadata
from pathlib import Path
from typing import Any

from benchmarks import suite, svg, tables

Line = dict[str, Any]
COLUMNS = ("case", "code", "compile", "run", "min .. max", "error", "bar", "holds")
HIDDEN = ("bar_on", "against")
_WIDTHS = (22, 12, 10, 10, 21, 9, 10, 6)
PACKAGES = ("jax", "equinox", "diffrax", "numpy", "scipy", "mkl")
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1000px; margin: 2em auto;
       padding: 0 1em; color: #222; }
table { border-collapse: collapse; font-size: 13px; width: 100%; }
th, td { text-align: left; padding: 3px 10px 3px 0; border-bottom: 1px solid #ddd;
         vertical-align: top; }
svg { width: 100%; max-width: 640px; font: 11px system-ui, sans-serif; }
.grid { stroke: #e3e3e3; } .no { color: #b00020; font-weight: 600; }
.small { color: #666; font-size: 13px; } .wide { overflow-x: auto; }
.runs td:not(:last-child) { white-space: nowrap; }
h2 { border-bottom: 2px solid #0b6e99; margin-top: 2.5em; } h3 { margin-top: 2em; }
"""


def seconds(value: float | None) -> str:
    if value is None:
        return "-"
    for factor, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "us")):
        if value >= factor:
            return f"{value / factor:.3g} {unit}"
    return f"{value * 1e9:.3g} ns"


def number(value: Any) -> str:
    return f"{value:.2e}" if isinstance(value, float) else "-" if value is None else str(value)


def cells(line: Line) -> list[str]:
    """One row of the table."""
    bar_on = line["settings"].get("bar_on", "run_s")
    bar = number(line["bar"]) if bar_on == "error" else seconds(line["bar"])
    spread = f"{seconds(line['run_s_min'])} .. {seconds(line['run_s_max'])}"
    return [
        line["case"], line["code"], seconds(line["compile_s"]), seconds(line["run_s"]),
        "-" if line["run_s_min"] is None else spread, number(line["error"]), bar,
        {True: "yes", False: "NO", None: "-"}[line["holds"]],
    ]  # fmt: skip


def _padded(texts: Iterable[str]) -> str:
    return "  ".join(f"{t:<{w}}" for t, w in zip(texts, _WIDTHS, strict=True))


HEADER = _padded(COLUMNS) + "  settings"


def text(line: Line) -> str:
    return _padded(cells(line)) + "  " + _settings(line)


def _settings(line: Line) -> str:
    return ", ".join(f"{k}={v}" for k, v in line["settings"].items() if k not in HIDDEN)


def html(
    lines: list[Line], took: Mapping[str, float] | None = None, left_out: Iterable[str] = ()
) -> str:
    """The page: row by row of the report, a plot and a table per case, and what it was
    measured on; with the seconds that cases took, and the cases that a quick run leaves out."""
    by_case: dict[str, list[Line]] = {}
    for line in lines:
        by_case.setdefault(line["case"], []).append(line)
    took = took or {}
    groups = suite.grouped(by_case)
    parts = [tables.contents({row: [by_case[n] for n in g] for row, g in groups.items()})]
    for row, names in groups.items():
        parts.append(f'<h2 id="{tables.anchor(row)}">{escape(row)}</h2>')
        parts.extend(_section(name, by_case[name], took.get(name)) for name in names)
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>sorojax benchmarks'
        f"</title><style>{STYLE}</style><h1>Run time against error</h1>"
        f"<p>{escape(machine())}</p><p class=small>Medians over repeats on one pinned "
        "core, every case in its own process, every peer in its own environment. "
        "compile: XLA without a persistent cache, or the first call.</p>"
        + _quick(left_out)
        + "".join(parts)
        + tables.peers()
        + "</html>\n"
    )


def _quick(left_out: Iterable[str]) -> str:
    names = ", ".join(left_out)
    text = f"A quick run: cases left out are {names}; sizes left out are named by case."
    return f"<p class=small>{escape(text)}</p>" if names else ""


def _section(name: str, lines: list[Line], took: float | None) -> str:
    notes = [text for line in lines for text in line["settings"].get("left_out", ())]
    lines = [line for line in lines if "left_out" not in line["settings"]]
    references = {str(x["reference"]) for x in lines if x["reference"]}
    against = f"Error against: {'; '.join(sorted(references))}." if references else ""
    special = tables.features(lines, seconds) or tables.scaling(lines, seconds)
    body = plots(lines) + (special or f'<div class="wide">{_table(lines)}</div>')
    head = name if took is None else f"{name} ({took:.0f} s)"
    left = f"<p class=small>Left out of a quick run: {escape('; '.join(notes))}.</p>"
    return f"<h3>{escape(head)}</h3><p>{escape(against)}</p>{body}{left if notes else ''}"


def plots(lines: list[Line]) -> str:
    """Error over run time, or run time over each size that was varied."""
    found: dict[tuple[str, str], svg.Points] = {}
    for line in lines:
        size = line["settings"].get("against")
        x, y = (
            (line["settings"][size], line["run_s"]) if size else (line["run_s"], line["error"])
        )
        if x and y and y > 0:  # a difference may be negative, axes are logarithmic
            labels = (size, "run time [s]") if size else ("run time [s]", "error")
            told = line["settings"]
            label = f"{line['code']} {told.get('method', told.get('case', ''))}".strip()
            found.setdefault(labels, {}).setdefault(label, []).append((x, y))
    return "".join(svg.loglog(series, *labels) for labels, series in found.items())


def _table(lines: list[Line]) -> str:
    head = "".join(f"<th>{column}</th>" for column in (*COLUMNS[1:], "settings"))
    rows = []
    for line in lines:
        row = "".join(f"<td>{escape(cell)}</td>" for cell in cells(line)[1:])
        style = ' class="no"' if line["holds"] is False else ""
        rows.append(f"<tr{style}>{row}<td>{escape(_settings(line))}</td></tr>")
    return f"<table class=runs><tr>{head}</tr>{''.join(rows)}</table>"


def machine() -> str:
    """Processor, cores, system, versions and date, in one sentence."""
    versions = []
    for name in PACKAGES:
        try:
            versions.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            versions.append(f"no {name}")
    return (
        f"{_processor()}, {os.cpu_count()} cores, {platform.platform()}, Python "
        f"{platform.python_version()}, {', '.join(versions)}, "
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC."
    )


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
