"""Pages of the reference, one per package, written from what the packages make public."""

import importlib
import inspect
import re
from pathlib import Path

from docstrings import as_rst, first_sentence
from public_names import BENCH, CORE, PACKAGES, Public, page_of, public, reached

FEW = 25  # a package with more names is told in sections
ORDER = ("function", "class", "data")
FIRST = (
    "problem", "model", "shapes", "operations", "network", "blocks", "elements", "plane",
    "solid", "equilibrium", "dynamics", "statics", "loads", "supports", "forces", "contact",
)  # fmt: skip


def file_name(package: str) -> str:
    return package.replace(".", "_")


def pages() -> dict[str, str]:
    """Text of every page by the name of its file, in reStructuredText."""
    found = {f"{file_name(package)}.rst": page(package) for package in PACKAGES}
    return found | {"index.rst": _index()}


def write(folder: Path) -> None:
    """Write the pages, those alone that changed, so that a second build is short."""
    folder.mkdir(exist_ok=True)
    texts = pages()
    for stale in {path.name for path in folder.glob("*.rst")} - texts.keys():
        (folder / stale).unlink()
    for name, text in texts.items():
        if not (folder / name).exists() or (folder / name).read_text() != text:
            (folder / name).write_text(text)


def page(package: str) -> str:
    """Title, what the package is, a table of its names, and an entry for each."""
    module, names = importlib.import_module(package), public(package)
    label = package if package in (*BENCH, "sorojax") else package.removeprefix("sorojax.")
    about = as_rst(inspect.cleandoc(module.__doc__ or ""))
    parts = [heading(label, "="), f".. py:module:: {package}\n", about, ""]
    if package == "sorojax.units":
        return "\n".join([*parts, *_units(names)])
    sections = _sections(names)
    for below in sorted(sections, key=_rank):
        members = sorted(sections[below], key=_place)
        if len(sections) > 1:
            parts.append(heading(_title(package, below), "-"))
        parts += [_table(members), *map(_entry, members)]
    if types := reached(package):
        parts += [heading("Results and other types in these signatures", "-"), _table(types)]
        parts += map(_entry, types)
    return "\n".join(parts)


def _sections(names: list[Public]) -> dict[str, list[Public]]:
    """Names by the folder or module below their package that defines them, or all in one."""
    sections: dict[str, list[Public]] = {}
    for name in names:
        whole = page_of(name.path)  # the board is told module by module
        inside = name.source.startswith(f"{whole}.")
        home = name.source.removeprefix(f"{whole}.").split(".")[0] if inside else ""
        sections.setdefault(home if len(names) > FEW else "", []).append(name)
    return sections


def _rank(below: str) -> tuple[int, str]:
    """What a reader starts with comes first, what another package defines last."""
    early = FIRST.index(below) if below in FIRST else len(FIRST)
    return (early if below else len(FIRST) + 1), below


def _title(package: str, below: str) -> str:
    """The first sentence of the folder or module."""
    if not below:
        return "From other packages"
    text = inspect.cleandoc(importlib.import_module(f"{package}.{below}").__doc__ or "")
    title = " ".join(re.split(r"[.:;](?:\s|$)", text)[0].split())
    return title if len(title) < 64 else title.partition(",")[0]


def _place(name: Public) -> tuple[int, bool, str]:
    return ORDER.index(name.kind), name.name.startswith("Abstract"), name.name.lower()


def _table(names: list[Public]) -> str:
    rows = [".. list-table::", "   :class: names", "   :widths: 30 70", ""]
    for name in names:
        rows.append(f"   * - :py:obj:`{_shown(name)} <{name.path}>`")
        rows.append(f"     - {as_rst(first_sentence(name.text))}")
    return "\n".join([*rows, ""])


def _shown(name: Public) -> str:
    """A name as its table shows it; a module of the board is told with it."""
    is_reached = name.package != name.path.rpartition(".")[0] and name.package in CORE
    return name.name if is_reached else name.path.removeprefix(f"{page_of(name.path)}.")


def _entry(name: Public) -> str:
    directive = {"class": "autoclass", "function": "autofunction", "data": "autodata"}
    lines = [f".. {directive[name.kind]}:: {name.path}"]
    if name.kind == "class":
        lines.append("   :members:")
    if name.kind == "data":
        lines.append("   :no-value:")
    return "\n".join([*lines, ""])


def _units(names: list[Public]) -> list[str]:
    rows = [".. list-table::", "   :widths: 30 70", "   :header-rows: 1", ""]
    rows += ["   * - factor", "     - SI"]
    for name in names:
        target = f".. py:data:: {name.name}\n   :no-typesetting:\n"
        rows.append(f"   * - ``{name.name}``\n     - {name.value:g}")
        rows.insert(0, target)
    return rows


def _index() -> str:
    lines = [heading("Reference", "="), _HOW, heading("sorojax", "-"), *_toctree(CORE)]
    bench = "The bench: boards, cameras and the loop"
    return "\n".join([*lines, heading(bench, "-"), *_toctree(BENCH), ""])


def _toctree(packages: tuple[str, ...]) -> list[str]:
    rows = [".. list-table::", "   :widths: 20 10 70", "   :header-rows: 1", ""]
    rows += ["   * - package", "     - names", "     - what it is"]
    for package in packages:
        text = inspect.cleandoc(importlib.import_module(package).__doc__ or "")
        rows += [
            f"   * - :doc:`{package.removeprefix('sorojax.')} <{file_name(package)}>`",
            f"     - {len(public(package))}",
            f"     - {as_rst(first_sentence(text))}",
        ]
    hidden = ["", ".. toctree::", "   :hidden:", ""]
    hidden += [f"   {file_name(package)}" for package in packages]
    return [*rows, *hidden, ""]


_HOW = """Every public name with its signature, read from the code when these pages are built.
``import sorojax as sj`` is the way in: ``sj.rod.rollout`` is ``rollout`` on the page *rod*.

In signatures ``Float[nodes, 2]`` is an array of real numbers with a row for each node and two
columns, ``Float`` alone is one number, ``Numbers`` whatever becomes such an array: a number, a
list, an array of NumPy or JAX. Everything is in SI units; ``[m]`` in a text is a unit.
"""


def heading(text: str, mark: str) -> str:
    return f"{as_rst(text)}\n{mark * (len(as_rst(text)) + 1)}\n"
