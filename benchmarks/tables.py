"""Tables of the page beside those of the cases: bars by row, features, peers."""

from collections.abc import Callable, Iterable
from html import escape
from typing import Any

from benchmarks.peers.__main__ import PEERS
from benchmarks.peers.call import status

Line = dict[str, Any]


def anchor(row: str) -> str:
    return row.replace(" ", "-")


def contents(rows: dict[str, list[list[Line]]]) -> str:
    """Every row of the report with its cases, and how many of its bars are met."""
    body = []
    for row, cases in rows.items():
        lines = [line for case in cases for line in case]
        bars = [line["holds"] for line in lines if line["holds"] is not None]
        codes = dict.fromkeys(line["code"] for line in lines if line["run_s"] is not None)
        none = dict.fromkeys(x["code"] for x in lines if "reason" in x["settings"])
        body.append(
            (
                f'<a href="#{anchor(row)}">{escape(row)}</a>',
                escape(", ".join(case[0]["case"] for case in cases)),
                f"{sum(bars)} of {len(bars)}" if bars else "-",
                escape(", ".join(codes)),
                escape(", ".join(none) or "-"),
            )
        )
    return _table(("row", "cases", "bars met", "codes", "did not run"), body)


def features(lines: list[Line], seconds: Callable[[float | None], str]) -> str:
    """What each feature costs where it is: the scene without it beside the scene with it."""
    scenes: dict[str, dict[str, Line]] = {}
    for line in lines:
        told = line["settings"]
        if "feature" not in told:
            return ""
        scenes.setdefault(told["feature"], {})[told["scene"]] = line
    body = []
    for name, pair in scenes.items():
        if len(pair) < 2:
            return ""
        without, with_it = pair["without"], pair["with"]
        counts = [
            f"{x['settings'][key]:.6g}"
            for key in ("instructions", "flops")
            for x in (without, with_it)
        ]
        ratio = f"{with_it['run_s'] / without['run_s']:.2f}"
        times = [seconds(x["run_s"]) for x in (without, with_it)]
        body.append((escape(name), *counts, *times, ratio))
    head = ("feature", "instructions without", "with", "flops without", "with",
            "run without", "with", "ratio")  # fmt: skip
    return _table(head, body) if body else ""


def scaling(lines: list[Line], seconds: Callable[[float | None], str]) -> str:
    """Cost over size; the exponent is that between a size and the one before."""
    body = []
    for line in lines:
        told = line["settings"]
        if "against" not in told:
            return ""
        exponent, expected, memory = map(told.get, ("exponent", "expected", "peak_MB"))
        body.append((
            escape(told["method"]), f"{told[told['against']]} {escape(told['against'])}",
            seconds(line["compile_s"]), seconds(line["run_s"]),
            "-" if exponent is None else f"{exponent:.2f}",
            "-" if expected is None else f"{expected:.3g}",
            "-" if memory is None else f"{memory:.3g} MB",
        ))  # fmt: skip
    head = ("what", "size", "compile", "run", "observed exponent", "expected", "peak memory")
    return _table(head, body) if body else ""


def peers() -> str:
    """Which codes there are to compare with, and why others are not there."""
    body = []
    for name, peer in PEERS.items():
        found = status(name)
        state = found["version"] if found["ok"] else f"not available: {found['reason']}"
        body.append((escape(name), escape(state), escape(peer.licence)))
    return "<h2>Peers</h2>" + _table(("peer", "version", "licence"), body)


def _table(head: Iterable[str], body: Iterable[Iterable[str]]) -> str:
    """Cells are markup already."""
    top = "".join(f"<th>{cell}</th>" for cell in head)
    rows = "".join(f"<tr>{''.join(f'<td>{x}</td>' for x in row)}</tr>" for row in body)
    return f'<div class="wide"><table><tr>{top}</tr>{rows}</table></div>'
