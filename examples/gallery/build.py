"""The gallery: every example with its picture, its film, its script and its numbers beside the
paper's.

    python examples/gallery/build.py                 write index.html from what is stored
    python examples/gallery/build.py --run           measure all examples again, then write it
    python examples/gallery/build.py --run 12 14     only those whose names begin so

Measured numbers lie in `numbers/NAME.json` with the machine that gave them; what the paper
says, what this project asks of a number, of what kind it is (by the longest beginning of its
name), and a sentence where we contradict the paper, in `paper.json`. A new script `NN_name.py`
beside a picture `NN_name.png` is found by itself; a picture of another name is named there too.
A film `NN_name.webp` lies beside the picture: the drawing of an example writes both.
"""

import argparse
import ast
import html
import importlib.util
import inspect
import json
import math
import os
import platform
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
EXAMPLES = HERE.parent


def scripts(folder: Path) -> list[Path]:
    """The numbered examples, in order."""
    return sorted(folder.glob("[0-9][0-9]_*.py"))


def picture_of(script: Path, paper: dict[str, Any]) -> Path | None:
    """The picture of an example, named like it with or without its number, or in `paper`."""
    if "picture" in paper:
        return script.with_name(paper["picture"])
    names = (f"{script.stem}.png", f"{script.stem[3:]}.png")
    return next((p for p in map(script.with_name, names) if p.exists()), None)


def film_of(script: Path) -> Path | None:
    """The film of an example, if it has one."""
    film = script.with_suffix(".webp")
    return film if film.exists() else None


def measured(script: Path, quick: bool = False) -> dict[str, Any]:
    """Run an example in this process and say what it gave, how long it took and where."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import sorojax

    sorojax.enable_compilation_cache()
    spec = importlib.util.spec_from_file_location(script.stem, script)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    takes = inspect.signature(module.main).parameters
    start = time.perf_counter()
    numbers = module.main(**({"quick": quick} if "quick" in takes else {}))
    return {
        "numbers": {name: _plain(value) for name, value in numbers.items()},
        "seconds": round(time.perf_counter() - start, 1),
        "quick": quick and "quick" in takes,
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}",
        "versions": f"Python {platform.python_version()}, JAX {jax.__version__}, "
        f"sorojax {sorojax.__version__}",
        "day": time.strftime("%Y-%m-%d"),
    }


def _plain(value: Any) -> float | int | str:
    value = value.item() if hasattr(value, "item") else value
    return value if isinstance(value, int | str) else float(value)


def _processor() -> str:
    """Name of the processor, or its architecture."""
    file = Path("/proc/cpuinfo")
    text = file.read_text() if file.exists() else ""
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.M)
    return found[1] if found else platform.machine()


def run(chosen: list[Path], store: Path, quick: bool) -> list[str]:
    """Measure examples, each in a process of its own; the names of those that failed."""
    failed = []
    store.mkdir(exist_ok=True)
    for script in chosen:
        command = [sys.executable, __file__, "--one", str(script), *["--quick"] * quick]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            failed.append(script.stem)
            print(f"{script.stem}: failed\n{done.stderr[-2000:]}", file=sys.stderr)
            continue
        found = json.loads(done.stdout.splitlines()[-1])
        text = json.dumps(found, indent=1, ensure_ascii=False)
        (store / f"{script.stem}.json").write_text(text + "\n")
        print(f"{script.stem:<22} {found['seconds']:6.1f} s, {len(found['numbers'])} numbers")
    return failed


def page(folder: Path, store: Path, paper: dict[str, Any]) -> str:
    """The whole page; pictures, scripts and notebooks are linked, nothing else is loaded."""
    found = scripts(folder)
    cards = "\n".join(_card(script, store, paper.get(script.stem, {})) for script in found)
    links = "".join(f'<a href="#{s.stem}">{_number(s)}</a> ' for s in found)
    return _PAGE.format(links=links, cards=cards, notebooks=_notebooks(folder / "notebooks"))


def words_of(script: Path) -> tuple[str, list[str]]:
    """The first sentence of the docstring of an example, and its other paragraphs."""
    text = ast.get_docstring(ast.parse(script.read_text())) or script.stem
    first, *rest = text.split("\n\n")
    return first.replace("\n", " "), [paragraph for paragraph in rest if paragraph.strip()]


def _card(script: Path, store: Path, paper: dict[str, Any]) -> str:
    source, (title, rest) = script.read_text(), words_of(script)
    words = "".join(f"<p>{html.escape(x)}</p>" for x in rest)
    drawn = _drawn(picture_of(script, paper), film_of(script), html.escape(title))
    told = paper.get("section")
    section = f"<span class=section>paper {told}</span>" if told else ""
    return (
        f'<section id="{script.stem}"><h2>{_number(script)} {html.escape(title)} {section}</h2>'
        f"<div class=two><div>{drawn}</div><div>{_table(script, store, paper)}</div></div>"
        f"<details><summary>about</summary>{words}</details><details><summary>script: <a href="
        f'"../{script.name}">{script.name}</a></summary><pre>{html.escape(source)}</pre>'
        "</details></section>"
    )


def _drawn(image: Path | None, film: Path | None, title: str) -> str:
    """The picture; where there is a film, it takes the place of the picture on a click."""
    if image is None:
        return "<p class=none>no picture: it prints its numbers</p>"
    still = f'<img src="../{image.name}" alt="{title}" loading="lazy">'
    if film is None:
        return f'<a href="../{image.name}">{still}</a>'
    return (
        f"<details class=film><summary>{still}<span></span></summary>"
        f'<img src="../{film.name}" alt="film: {title}" loading="lazy"></details>'
    )


def _table(script: Path, store: Path, paper: dict[str, Any]) -> str:
    """Numbers here, in the paper and asked for, and where they come from."""
    file = store / f"{script.stem}.json"
    told, asked = (dict(paper.get(key, {})) for key in ("numbers", "asked"))
    found = json.loads(file.read_text()) if file.exists() else None
    numbers = found["numbers"] if found else {}
    body = ""
    for name in dict.fromkeys((*numbers, *told, *asked)):
        here = html.escape(text(numbers[name])) if name in numbers else "-"
        said = (told.get(name, ""), asked.get(name, ""), kind_of(name, paper.get("kinds", {})))
        cells = html.escape(name), here, *map(html.escape, said)
        body += f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
    note = "not measured yet: run build.py --run"
    if found:
        mode = ", quick mode" if found["quick"] else ""
        note = f"{found['seconds']:g} s on {found['machine']}; {found['versions']}; "
        note += f"{found['day']}{mode}"
    heads = "".join(f"<th>{head}</th>" for head in ("", "ours", "paper", "asked", "kind"))
    head = f"<tr>{heads}</tr>" if body else ""
    said = f"<p>{html.escape(paper['note'])}</p>" if "note" in paper else ""
    return f"<table>{head}{body}</table>{said}<p class=note>{html.escape(note)}</p>"


def kind_of(name: str, kinds: dict[str, list[str]]) -> str:
    """Whether a number is calibrated, predicted or a check; empty where nobody says."""
    found = [
        (len(start), kind) for kind in kinds for start in kinds[kind] if name.startswith(start)
    ]
    return max(found)[1] if found else ""


def text(value: float | int | str) -> str:
    """A number in four digits, whole ones as they are."""
    if isinstance(value, str):
        return value
    whole = isinstance(value, int) or (math.isfinite(value) and value == int(value))
    return f"{int(value)}" if whole and abs(value) < 1e9 else f"{value:.4g}"


def _number(script: Path) -> str:
    return script.stem[:2]


def _notebooks(folder: Path) -> str:
    lines = ""
    for file in sorted(folder.glob("*.ipynb")):
        cells = json.loads(file.read_text())["cells"]
        text = "".join(cells[0]["source"])
        title, _, rest = text.partition("\n")
        lines += (
            f'<li><a href="../notebooks/{file.name}">{html.escape(title.lstrip("# "))}</a>'
            f"<br>{html.escape(' '.join(rest.split()))}</li>"
        )
    return f"<h2>Notebooks</h2><ul>{lines}</ul>" if lines else ""


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>sorojax: gallery</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><style>
body {{ font: 15px/1.45 system-ui, sans-serif; color: #1f2430; max-width: 1200px;
  margin: 2em auto; padding: 0 1em }}
h2 {{ font-size: 1.1em; margin: 0 0 .6em }} section {{ border-top: 1px solid #d9dce1;
  padding: 1.2em 0 }}
.two {{ display: grid; grid-template-columns: minmax(0, 1.1fr) minmax(0, 1fr); gap: 1.5em }}
@media (max-width: 800px) {{ .two {{ grid-template-columns: minmax(0, 1fr) }} }}
img {{ max-width: 100% }} table {{ border-collapse: collapse; font-size: .9em; width: 100% }}
td, th {{ padding: .15em .6em .15em 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid #eceef1 }} td:nth-child(2) {{ font-variant-numeric: tabular-nums;
  white-space: nowrap }} .note, .none {{ color: #6b7079; font-size: .8em }}
.section {{ color: #6b7079; font-weight: normal; font-size: .85em }}
pre {{ background: #f6f7f9; padding: 1em; overflow-x: auto; font-size: .8em }}
.film summary {{ list-style: none }} .film[open] summary img {{ display: none }}
.film span::after {{ content: "\25b6 show the film"; color: #0072b2 }}
.film[open] span::after {{ content: "\25a0 show the picture" }}
details {{ margin-top: .5em }} summary {{ cursor: pointer }} a {{ color: #0072b2 }}
</style></head><body><h1>Gallery</h1>
<p>Every example of this folder with what it draws and the numbers that its <code>main()</code>
returns, beside those of the paper: Caasenbrood, Pogromsky, Nijmeijer, <i>Sorotoki: a Matlab
toolkit for design, modeling, and control of soft robots</i>, IEEE Access 12, 2024. What is
asked is the bar of this project. Numbers of figures are those of the paper. The kind says what
a number is worth: <i>calibrated</i>, something in the script was chosen so that it comes out
like its source; <i>predicted</i>, it follows from sizes, materials and inputs, and could have
come out otherwise; <i>check</i>, it compares our own parts with an exact value or with each
other. Sizes and times have none.</p><p>{links}</p>
{cards}
{notebooks}
</body></html>
"""


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Build the gallery.")
    parser.add_argument("--run", nargs="*", metavar="NN", help="measure these, or all")
    parser.add_argument("--quick", action="store_true", help="in their quick mode")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, default=EXAMPLES, help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.one is not None:
        print(json.dumps(measured(arguments.one, arguments.quick)))
        return 0
    here, failed = arguments.folder / "gallery", []
    here.mkdir(exist_ok=True)
    if arguments.run is not None:
        every = scripts(arguments.folder)
        named = tuple(arguments.run)
        chosen = [s for s in every if s.stem.startswith(named)] if named else every
        failed = run(chosen, here / "numbers", arguments.quick)
    table = here / "paper.json"
    paper = json.loads(table.read_text()) if table.exists() else {}
    target = here / "index.html"
    target.write_text(page(arguments.folder, here / "numbers", paper))
    print(f"wrote {target}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
