"""The pages of the documentation: their programs run, their links and pictures are there, and
every public name has its entry. `make docs` builds the pages and takes warnings as errors."""

import functools
import importlib.util
import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import nbformat
import pytest

from tests.scripts import ROOT

pytestmark = pytest.mark.quick

DOCS = ROOT / "docs"
TOOLS = DOCS / "tools"
WRITTEN = ("_build", "_generated", "reference")  # by the build
PAGES = sorted(p for p in DOCS.rglob("*.md") if p.relative_to(DOCS).parts[0] not in WRITTEN)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)[^)]*\)")
FENCED = re.compile(r"^(`{3,})(?!\{include|\{raw).*?^\1`*$", re.M | re.S)
OWN_SITE = re.compile(r"""<(?!a\b)[a-z]+[^>]*?\s(?:src|href)=["'](?:https?:)?//""")


@functools.cache
def tool(name: str):
    """A module of `docs/tools`, which is no package."""
    if str(TOOLS) not in sys.path:
        sys.path.insert(0, str(TOOLS))
    spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def label(page: Path) -> str:
    return str(page.relative_to(DOCS).with_suffix(""))


def links(page: Path) -> list[str]:
    """Targets of links and pictures outside code, without their anchors."""
    found = LINK.findall(FENCED.sub("", page.read_text()))
    return [target.partition("#")[0] for target in found if not target.startswith("#")]


def broken(page: Path) -> list[str]:
    """Links of a page that lead nowhere; what the build writes is known by its writers."""
    wrong = []
    for target in links(page):
        if re.match(r"[a-z]+:", target):
            continue
        path = (page.parent / target).resolve()
        made = path.is_relative_to(DOCS) and path.relative_to(DOCS).parts[0] in WRITTEN
        if not (path.name in written() if made else path.is_file()):
            wrong.append(target)
    return wrong


@functools.cache
def written() -> set[str]:
    """Names of the files that the build writes and pages link to."""
    pictures = {picture.name for picture in (ROOT / "examples").glob("*.png")}
    return pictures | set(tool("reference").pages())


def programs(page: Path) -> bool:
    return re.search(r"^```python$", page.read_text(), re.M) is not None


@pytest.mark.parametrize("page", [page for page in PAGES if programs(page)], ids=label)
def test_the_programs_of_a_page_run(page, tmp_path):
    """In an empty folder, with the numbers that the page prints."""
    tool("run_page").run(page, tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=label)
def test_links_and_pictures_of_a_page_are_there(page):
    assert broken(page) == []


def test_a_broken_link_is_found(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("[a](no.md) [b](page.md#x) ![c](d.png)\n```text\n[e](f)\n```\n")
    monkeypatch.setattr(sys.modules[__name__], "DOCS", tmp_path)
    assert broken(page) == ["no.md", "d.png"]


@pytest.mark.parametrize("page", sorted(DOCS.glob("tutorials/0*.md")), ids=label)
def test_a_tutorial_is_a_notebook_too(page, tmp_path):
    """With every program of the page, what these print, and the pictures that they draw."""
    tool("notebooks").write(tmp_path)
    book = nbformat.read(tmp_path / f"{page.stem}.ipynb", as_version=4)
    nbformat.validate(book)
    cells = [cell for cell in book.cells if cell.cell_type == "code"]
    told = tool("run_page").blocks(page)
    assert [cell.source for cell in cells] == [block.code.rstrip("\n") for block in told]
    for cell, block in zip(cells, told, strict=True):
        printed = [o.text for o in cell.outputs if o.output_type == "stream"]
        assert printed == ([] if block.expected is None else [block.expected])
    drawn = [o for cell in cells for o in cell.outputs if o.output_type == "display_data"]
    text = page.read_text()
    assert len(drawn) == len(re.findall(r"^!\[", text, re.M)) > 0
    words = "\n".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
    assert words.startswith(text.partition("\n")[0]) and "](../" not in words


def test_every_public_name_has_its_entry():
    """As the object of a directive, once."""
    names = [name.path for name in tool("public_names").everything()]
    text = "\n".join(tool("reference").pages().values())
    entries = re.findall(r"^\.\. (?:auto)\w+:: (\S+)$", text, re.M)
    units = re.findall(r"^\.\. py:data:: (\S+)$", text, re.M)
    assert len(entries) == len(set(entries))
    assert set(names) <= {*entries, *(f"sorojax.units.{unit}" for unit in units)}


def test_every_public_name_is_described():
    """All have a docstring, nouns with every field, verbs with every argument and what comes
    back."""
    names = tool("public_names")
    lacks = {x.path: names.undescribed(x) for x in names.listed()}
    assert {path: missing for path, missing in lacks.items() if missing} == {}


def test_what_a_docstring_lacks_is_found():
    def spring(stiffness, *ends, length):
        """Force.

        Args:
            stiffness, length: Of the spring.
        """

    names = tool("public_names")
    found = names.undescribed(names.Public("a.spring", "a", spring))
    assert found == ["ends", "Returns"]
    spring.__doc__ = ""
    assert names.undescribed(names.Public("a.spring", "a", spring)) == ["docstring"]


def test_fields_that_no_docstring_tells_are_found():
    """A word of the text is not enough, and a private field needs none."""

    @dataclass
    class Spring:
        """Spring of `stiffness` [N/m] and some colour, `slack=True` if it never pushes.

        Attributes:
            start, end: Where it is [m].
        """

        stiffness: float
        colour: str
        slack: bool
        start: float
        end: float
        _found: float

    class Drop(NamedTuple):
        """Volume [m^3]."""

        volume: float

    names = tool("public_names")
    assert names.undescribed(names.Public("a.Spring", "a", Spring)) == ["colour"]
    assert names.undescribed(names.Public("a.Drop", "a", Drop)) == ["volume"]


def test_no_page_takes_anything_from_another_host():
    """Of the pages as built, if they are; links to follow are not loaded."""
    for page in PAGES:
        pictures = re.findall(r"!\[[^\]]*\]\((https?:[^)]*)\)", page.read_text())
        assert pictures == [] and not OWN_SITE.search(FENCED.sub("", page.read_text()))
    for page in (DOCS / "_build" / "html").rglob("*.html"):
        found = OWN_SITE.search(page.read_text())
        assert found is None, f"{page}: {found}"


@pytest.mark.parametrize(
    "text, shown",
    [
        ("a *b* and x_ or |c|", r"a \*b\* and x\_ or \|c\|"),
        ("`fine`^2 of `a_b`", r"`fine`\ ^2 of `a_b`"),
        ("* one\n* two *", "* one\n* two \\*"),
        ("As here:\n\n    x * y\n\nthen *", "As here::\n\n    x * y\n\nthen \\*"),
        (">>> 2 * 3\n6 * 1\n\n2 * 3", ">>> 2 * 3\n6 * 1\n\n2 \\* 3"),
    ],
)
def test_docstrings_keep_their_marks(text, shown):
    assert tool("docstrings").as_rst(text) == shown


def test_signatures_name_axes_and_nouns():
    from sorojax import fem, rod

    names = tool("public_names").everything()
    paths = {name.value: name.path for name in names if name.kind == "class"}
    text, answer = tool("signatures").signature(rod.mass_matrix, paths)
    assert text == "(model: sorojax.rod.Rod | sorojax.rod.Assembly, q: Float[coordinates])"
    assert answer == "Float[dof, dof]"
    text, _ = tool("signatures").signature(fem.Pressure, paths)
    assert "value: Numbers = 0.0" in text and "origin: Numbers | None = None" in text


def test_the_gallery_has_every_example_with_its_numbers(tmp_path):
    data = tool("data_pages")
    data.write(tmp_path)
    text = (tmp_path / "gallery.md").read_text()
    for script in (ROOT / "examples").glob("[0-9][0-9]_*.py"):
        entry = text.split(f"({script.stem})=")[1].split(")=\n###")[0]
        stored = ROOT / "examples" / "gallery" / "numbers" / f"{script.stem}.json"
        names = json.loads(stored.read_text())["numbers"] if stored.exists() else ()
        assert all(f"| {name} |" in entry for name in names), script
    shown = set(re.findall(r"_generated/pictures/([\w.]+)", text))
    assert shown == {picture.name for picture in (tmp_path / "pictures").iterdir()}
    assert all(path.stat().st_size < 150e3 for path in (tmp_path / "pictures").iterdir())
    films = {film.name for film in (ROOT / "examples").glob("*.webp")}
    assert set(re.findall(r"_generated/films/([\w.]+)", text)) == films
    assert {film.name for film in (tmp_path / "films").iterdir()} == films
    assert text.count('<details class="film">') == len(films) > 0
    assert "| six silicones in tension" in (tmp_path / "robots.md").read_text()
    assert (tmp_path / "device.md").read_text().count("<svg") >= 3
    with pytest.raises(AssertionError, match="no section 'Ghosts'"):
        data.section(ROOT / "README.md", "Ghosts")
