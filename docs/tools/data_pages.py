"""Parts of pages from what the project stores: examples, validation, recorded runs."""

import importlib.util
import json
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
WIDTH = 800  # pixels of a picture
GROUPS = {
    "0": "First programs",
    "1": "Scenes of the Sorotoki paper",
    "2": "Studies of the Sorotoki paper",
    "3": "Body and controller designed together",
    "4": "Arms, fibres, loops, learning",
}


def write(folder: Path) -> None:
    """Write the parts into `folder`, where the pages include them."""
    (folder / "pictures").mkdir(parents=True, exist_ok=True)
    for kind in ("films", "notebooks"):
        (folder / kind).mkdir(exist_ok=True)
    texts = {
        "gallery.md": gallery(folder),
        "robots.md": section(ROOT / "benchmarks" / "README.md", "Measured robots and rubbers"),
        "others.md": section(ROOT / "benchmarks" / "recorded" / "README.md", "Measurements by"),
        "peers.md": table(section(ROOT / "benchmarks" / "README.md", "Peers")),
        "device.md": device(),
    }
    for name, text in texts.items():
        if not (folder / name).exists() or (folder / name).read_text() != text:
            (folder / name).write_text(text)


def _loaded(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def gallery(folder: Path) -> str:
    """Cards of all examples, then each with its words, its numbers and those of the paper."""
    build = _loaded("gallery_build", EXAMPLES / "gallery" / "build.py")
    paper = json.loads((EXAMPLES / "gallery" / "paper.json").read_text())
    cards, entries = "", ""
    for script in build.scripts(EXAMPLES):
        told, group = paper.get(script.stem, {}), GROUPS.get(script.stem[0])
        image = build.picture_of(script, told)
        picture = image and f"_generated/pictures/{small(image, folder / 'pictures').name}"
        title, rest = build.words_of(script)
        film = build.film_of(script)
        if film is not None:
            _copy(film, folder / "films" / film.name)
            film = f"_generated/films/{film.name}"
        if group and f"## {group}\n" not in entries:
            entries += f"## {group}\n\n"
        cards += _card(script, title, picture)
        entries += _entry(build, script, title, rest, _drawn(title, picture, film), told)
    for book in sorted((EXAMPLES / "notebooks").glob("*.ipynb")):
        _copy(book, folder / "notebooks" / book.name)
    return f":::::{{grid}} 2 2 3 4\n:gutter: 2\n\n{cards}:::::\n\n{entries}"


def _copy(file: Path, target: Path) -> None:
    """Write only what changed: pages that include it are not built again."""
    if not target.exists() or target.read_bytes() != file.read_bytes():
        target.write_bytes(file.read_bytes())


def small(picture: Path, folder: Path) -> Path:
    """A copy of a picture, at most `WIDTH` wide and in 256 colours; an older one is kept."""
    target = folder / picture.name
    if not target.exists() or target.stat().st_mtime < picture.stat().st_mtime:
        image = Image.open(picture).convert("RGB")
        image.thumbnail((WIDTH, 4 * WIDTH))
        image.quantize(256).save(target, optimize=True)
    return target


def _card(script: Path, title: str, picture: str | None) -> str:
    shown = f":img-top: {picture}\n:img-alt: {_name(script)}\n" if picture else ""
    return (
        f"::::{{grid-item-card}} {_name(script)}\n:link: {script.stem}\n:link-type: ref\n"
        f":class-card: example\n{shown}::::\n\n"
    )


def _name(script: Path) -> str:
    return script.stem[3:].replace("_", " ")


def _drawn(title: str, picture: str | None, film: str | None) -> str:
    """The picture; where there is a film, it takes the place of the picture on a click."""
    if picture is None:
        return ""

    def image(name, alt):
        return f"```{{image}} {name}\n:alt: {alt}\n:loading: lazy\n```\n\n"

    def raw(text):
        return f"```{{raw}} html\n{text}\n```\n\n"

    still = image(picture, _plain(title))
    if film is None:
        return still
    opened, closed = raw('<details class="film"><summary>'), raw("<span></span></summary>")
    return f"{opened}{still}{closed}{image(film, f'film: {_plain(title)}')}{raw('</details>')}"


def _entry(build, script, title, rest, drawn, paper: dict[str, Any]) -> str:
    about = "\n\n".join(rest)
    more = f":::{{dropdown}} About this example\n{about}\n:::\n\n" if about else ""
    where = f"`examples/{script.name}`"
    if "section" in paper:
        where += f"; in the paper {paper['section']}"
    numbers = _numbers(build, script, paper)
    return (
        f"({script.stem})=\n### {script.stem[:2]} {_name(script)}\n\n{title}\n\n{drawn}"
        f"{numbers}{more}{where}\n\n"
    )


def _plain(text: str) -> str:
    return text.replace("`", "").replace("[", "(").replace("]", ")")


_OTHERS = {"numbers": "paper", "asked": "asked"}  # columns, by their name in paper.json


def _numbers(build, script: Path, paper: dict[str, Any]) -> str:
    """The table of what an example printed, beside the paper's numbers."""
    file = EXAMPLES / "gallery" / "numbers" / f"{script.stem}.json"
    if not file.exists():
        return f"Numbers: run `python examples/{script.name}`.\n\n"
    found = json.loads(file.read_text())
    others = {key: paper[kind] for kind, key in _OTHERS.items() if paper.get(kind)}
    kinds = paper.get("kinds", {})
    heads = ("ours", *others, *(("kind",) if kinds else ()))
    head = "".join(f" {key} |" for key in heads)
    head = f"| |{head}\n| --- |{' --- |' * len(heads)}\n"
    rows = ""
    for name in dict.fromkeys((*found["numbers"], *(n for o in others.values() for n in o))):
        ours = build.text(found["numbers"][name]) if name in found["numbers"] else "-"
        cells = [ours, *(other.get(name, "") for other in others.values())]
        if kinds:
            cells.append(build.kind_of(name, kinds))
        rows += f"| {name} |{''.join(f' {cell} |' for cell in cells)}\n"
    said = f"{paper['note']}\n\n" if "note" in paper else ""
    quick = ", quick mode" if found["quick"] else ""
    note = f"{found['seconds']:g} s on {found['machine']}; {found['versions']}; {found['day']}"
    return f"{head}{rows}\n{said}{{.note}}\n{note}{quick}\n\n"


def section(path: Path, title: str) -> str:
    """The text below a heading of a page of the repository, without it."""
    found = re.search(rf"^## {title}.*?\n(.*?)(?=^## |\Z)", path.read_text(), re.M | re.S)
    assert found, f"{path} has no section {title!r}"
    return re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", found[1]).strip() + "\n"


def table(text: str) -> str:
    """The rows of the table of a section."""
    return "\n".join(line for line in text.split("\n") if line.startswith("|")) + "\n"


def device() -> str:
    """Plots of the recorded run on an accelerator, and the table of its readme."""
    sys.path.insert(0, str(ROOT))
    from benchmarks import page

    recorded = ROOT / "benchmarks" / "recorded"
    lines = [json.loads(x) for x in (recorded / "h100.jsonl").read_text().splitlines()]
    parts = [(recorded / "README.md").read_text().split("## ")[0].partition("\n")[2].strip()]
    for line in lines:  # all are of one code and one device: names short enough for a plot
        line["code"] = ""
        method = line["settings"]["method"]
        line["settings"]["method"] = method.replace("NVIDIA H100 80GB HBM3", "H100")
    for case in dict.fromkeys(line["case"] for line in lines):
        drawn = page.plots([line for line in lines if line["case"] == case])
        parts.append(f"### {case}\n\n```{{raw}} html\n<div class='plot'>{drawn}</div>\n```")
    return "\n\n".join(parts) + "\n"
