"""What Sphinx is told beyond its settings: pages made from code and data, short signatures,
docstrings that may hold any mark, and links from names in backticks to the reference."""

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from pygments.lexers.python import PythonLexer
from sphinx.addnodes import pending_xref, pending_xref_condition
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

import data_pages
import notebooks
import reference
import signatures
from docstrings import as_rst
from public_names import listed

PATHS = {name.path: name for name in listed()}
CLASSES = {name.value: name.path for name in reversed(listed()) if name.kind == "class"}
_BACKTICKED = re.compile(r"(?:sj\.|sorojax\.)?((?:[A-Za-z]\w*\.)*[A-Za-z]\w*)(?:\(.*\))?", re.S)


def target(text: str, package: str | None = None) -> str | None:
    """The public name that a text in backticks is, `sj.rod.rollout(...)` as well as
    `rod.rollout`; on the page of a package a bare class too, of it or of one other."""
    if not (found := _BACKTICKED.fullmatch(text.strip())):
        return None
    words = found[1]
    for path in (words, f"sorojax.{words}"):
        if path in PATHS and ("." in words or text.startswith(("sj.", "sorojax."))):
            return path
    if "." in words or not words[0].isupper() or package is None:
        return None
    near = f"{package}.{words}"
    far = [path for path in PATHS if path.endswith(f".{words}")]
    return near if near in PATHS else far[0] if len(far) == 1 else None


class LinkNames(SphinxTransform):
    """Makes links of public names in backticks."""

    default_priority = 400

    def apply(self, **kwargs: Any) -> None:
        package = self.package()
        for node in list(self.document.findall(pending_xref)):
            if node.get("refdomain") == "py" and node["reftarget"] not in PATHS:
                first = node.children[0]  # a type of others, or an attribute
                short = isinstance(first, pending_xref_condition)
                node.replace_self(first.children if short else node.children)
        for node in list(self.document.findall(nodes.literal)):
            if isinstance(node.parent, nodes.reference | pending_xref | nodes.title):
                continue
            if path := target(node.astext(), package):
                link = pending_xref(
                    "", refdomain="py", reftype="obj", reftarget=path, refexplicit=True,
                    refdoc=self.env.docname, refwarn=True,
                )  # fmt: skip
                node.replace_self(link)
                link += node

    def package(self) -> str | None:
        folder, _, name = self.env.docname.rpartition("/")
        pages = {reference.file_name(package): package for package in reference.PACKAGES}
        return pages.get(name) if folder == "reference" else None


def _docstring(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]):
    """Escape the marks of reStructuredText, before Google's sections are read."""
    lines[:] = [] if what == "data" else as_rst("\n".join(lines)).split("\n")


def _signature(
    app: Sphinx, what: str, name: str, value: Any, options: Any, given: str | None, back: Any
) -> tuple[str | None, str | None] | None:
    if what not in ("class", "function", "method") or given is None and what != "class":
        return None
    try:
        arguments, answer = signatures.signature(value, CLASSES)
    except (TypeError, ValueError):
        return None
    if what == "method":
        arguments = re.sub(r"^\(self(, )?", "(", arguments)
    if what == "class" and value.__name__.startswith("Abstract"):
        arguments = ""
    return arguments, answer


def _skip(
    app: Sphinx, what: str, name: str, value: Any, skip: bool, options: Any
) -> bool | None:
    """Members are the methods and properties that have a docstring of their own."""
    if what != "class":
        return None
    is_member = callable(value) or isinstance(value, property)
    return not (is_member and getattr(value, "__doc__", None)) or skip


def _write(app: Sphinx) -> None:
    reference.write(Path(app.srcdir) / "reference")
    data_pages.write(Path(app.srcdir) / "_generated")
    notebooks.write(Path(app.srcdir) / "_generated" / "tutorials")


def _offer_notebook(app: Sphinx, page: str, source: list[str]) -> None:
    """A link to the notebook below the title of a tutorial."""
    folder, _, name = page.rpartition("/")
    if folder == "tutorials" and name in [page.stem for page in notebooks.pages()]:
        title, _, rest = source[0].partition("\n")
        file = f"../_generated/tutorials/{name}.ipynb"
        source[0] = f"{title}\n\n{{download}}`This page as a notebook <{file}>`\n{rest}"


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("builder-inited", _write)
    app.connect("source-read", _offer_notebook)
    app.connect("autodoc-process-docstring", _docstring, priority=100)
    app.connect("autodoc-process-signature", _signature)
    app.connect("autodoc-skip-member", _skip)
    app.add_transform(LinkNames)
    app.add_lexer("python-fragment", PythonLexer)
    return {"parallel_read_safe": True}
