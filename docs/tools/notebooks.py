"""The tutorials as notebooks, with what their programs print and draw stored in them.

The pages are the source, and the tests compare what their programs print with them: a notebook
takes text and pictures from its page, and nothing is run.
"""

import base64
import re
from pathlib import Path

import nbformat
from nbformat import v4

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = ROOT / "docs" / "tutorials"
SITE = "https://github.com/sorojax/sorojax/blob/main"
_PIECE = re.compile(
    r"^```(?P<kind>python|text)\n(?P<body>.*?)^```$|^!\[[^\]]*\]\((?P<picture>\S+\.png)\)$",
    re.MULTILINE | re.DOTALL,
)
_LINK = re.compile(r"(?<!!)(\[[^\]]*\]\()(?![a-z]+:|#)([^)\s#]+)")


def pages() -> list[Path]:
    """The tutorials, in order."""
    return sorted(TUTORIALS.glob("[0-9][0-9]_*.md"))


def write(folder: Path) -> None:
    """Write the notebooks into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for page in pages():
        text, target = nbformat.writes(notebook(page)), folder / f"{page.stem}.ipynb"
        if not target.exists() or target.read_text() != text:
            target.write_text(text)


def notebook(page: Path) -> nbformat.NotebookNode:
    """A page as a notebook: programs as cells, what follows them as their outputs."""
    text, cells, at = page.read_text(), [], 0
    for piece in _PIECE.finditer(text):
        between = text[at : piece.start()].strip()
        code = [cell for cell in cells if cell.cell_type == "code"]
        at = piece.end()
        if between:
            cells.append(_words(between, page))
        if piece["kind"] == "python":
            look = {"execution_count": len(code) + 1}
            cells.append(v4.new_code_cell(piece["body"].rstrip("\n"), **look))
        elif piece["kind"] == "text" and not between and code:
            code[-1].outputs.append(v4.new_output("stream", text=piece["body"]))
        elif piece["kind"] == "text":
            cells.append(_words(piece[0], page))
        else:
            picture = (page.parent / piece["picture"]).resolve()
            (drawn,) = [cell for cell in code if f'"{picture.name}"' in cell.source]
            data = {"image/png": base64.b64encode(picture.read_bytes()).decode()}
            drawn.outputs.append(v4.new_output("display_data", data))
    if rest := text[at:].strip():
        cells.append(_words(rest, page))
    for k, cell in enumerate(cells):
        cell.id = f"cell-{k}"  # the same at every build
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return v4.new_notebook(cells=cells, metadata={"kernelspec": kernel})


def _words(text: str, page: Path) -> nbformat.NotebookNode:
    """A cell of text, whose links to other pages work wherever the notebook lies."""

    def absolute(link: re.Match[str]) -> str:
        target = (page.parent / link[2]).resolve()
        return f"{link[1]}{SITE}/{target.relative_to(ROOT).as_posix()}"

    return v4.new_markdown_cell(_LINK.sub(absolute, text))
