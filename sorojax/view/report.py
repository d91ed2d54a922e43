"""One self-contained HTML file: headings, text, pictures and tables of numbers."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Union

from sorojax.view.film.film import Film
from sorojax.view.picture import Picture
from sorojax.view.style import png

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Drawn = Union["Figure", Picture, Film, bytes]


@dataclass(frozen=True)
class Number:
    """A row of a table: what was found, what was asked for, whether it holds."""

    name: str
    value: float | int | str
    unit: str = ""
    bar: str = ""
    holds: bool | None = None


@dataclass(frozen=True)
class Section:
    """A heading with text, pictures and a table; paragraphs are split at empty lines."""

    heading: str
    text: str = ""
    pictures: Sequence[tuple[str, Drawn]] = ()
    numbers: Sequence[Number] = ()


def html_report(title: str, sections: Sequence[Section], *, lead: str = "") -> str:
    """The report as one HTML page that loads nothing from elsewhere.

    Args:
        title: Title of the page.
        sections: `Section`s; their pictures are `(caption, figure)`, where a figure is a
            `Picture`, a matplotlib figure, a `Film`, or the bytes of a PNG or GIF file.
        lead: Short text under the title.
    """
    body = "\n".join(_section(section, k) for k, section in enumerate(sections))
    links = "".join(
        f'<a href="#s{k}">{escape(section.heading)}</a>' for k, section in enumerate(sections)
    )
    return _PAGE.format(
        title=escape(title),
        style=_STYLE,
        lead=_paragraphs(lead, "lead"),
        links=links,
        body=body,
    )


def format_number(value: float | int | str) -> str:
    """Four significant digits; powers of ten only where they are needed."""
    if isinstance(value, str | bool | int):
        return str(value)
    number = float(value)
    if number == 0 or 1e-3 <= abs(number) < 1e6:
        return f"{number:.4g}" if abs(number) < 1e4 else f"{number:,.0f}"
    return f"{number:.3e}".replace("e-0", "e-").replace("e+0", "e")


def _section(section: Section, k: int) -> str:
    parts = [f'<section id="s{k}"><h2>{escape(section.heading)}</h2>']
    parts.append(_paragraphs(section.text))
    parts += [_picture(caption, picture) for caption, picture in section.pictures]
    if section.numbers:
        parts.append(_table(section.numbers))
    return "\n".join([part for part in parts if part] + ["</section>"])


def _paragraphs(text: str, kind: str = "") -> str:
    tag = f'<p class="{kind}">' if kind else "<p>"
    blocks = [block.strip() for block in text.split("\n\n") if block.strip()]
    return "\n".join(f"{tag}{escape(block)}</p>" for block in blocks)


def _picture(caption: str, picture: Drawn) -> str:
    if isinstance(picture, Film):
        data = picture.gif
    elif isinstance(picture, Picture):
        data = picture.png
    else:
        data = picture if isinstance(picture, bytes) else png(picture)
    kind = "gif" if data.startswith(b"GIF8") else "png"
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    note = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure><img alt="{escape(caption)}" src="{source}">{note}</figure>'


def _table(numbers: Sequence[Number]) -> str:
    judged = any(number.bar or number.holds is not None for number in numbers)
    extra = "<th>asked for</th><th></th>" if judged else ""
    head = f'<tr><th>quantity</th><th class="n">value</th><th>unit</th>{extra}</tr>'
    rows = "\n".join(_row(number, judged) for number in numbers)
    return f'<div class="table"><table><thead>{head}</thead><tbody>{rows}</tbody></table></div>'


def _row(number: Number, judged: bool) -> str:
    cells = f"<td>{escape(number.name)}</td>"
    cells += f'<td class="n">{escape(format_number(number.value))}</td>'
    cells += f"<td>{escape(number.unit)}</td>"
    if judged:
        cells += f"<td>{escape(number.bar)}</td><td>{_mark(number.holds)}</td>"
    return f"<tr>{cells}</tr>"


def _mark(holds: bool | None) -> str:
    if holds is None:
        return ""
    word, sign = ("holds", "\u2713") if holds else ("missed", "\u2717")
    return f'<span class="{word}">{sign} {word}</span>'


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<header><h1>{title}</h1>
{lead}
<nav>{links}</nav></header>
<main>
{body}
</main>
</body>
</html>
"""

_STYLE = """
:root { color-scheme: light dark; --ink: #1f2430; --soft: #5b6270; --paper: #ffffff;
  --rule: #e1e4e9; --accent: #0067a3; --good: #00734f; --bad: #b03a00; --row: #f6f7f9; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e8ec; --soft: #a3aab6;
  --paper: #16181d; --rule: #333842; --accent: #6bb8ec; --good: #4cc79c; --bad: #f08a5d;
  --row: #1d2027; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", "Helvetica Neue", Arial, sans-serif; }
header, main { max-width: 900px; margin: 0 auto; padding: 0 24px; }
header { padding-top: 40px; }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 8px; letter-spacing: -0.01em; }
h2 { font-size: 21px; line-height: 1.3; margin: 40px 0 8px; padding-top: 16px;
  border-top: 1px solid var(--rule); }
p { margin: 8px 0; max-width: 68ch; }
.lead { color: var(--soft); font-size: 18px; }
nav { display: flex; flex-wrap: wrap; gap: 4px 18px; margin: 16px 0 0; font-size: 14px; }
a { color: var(--accent); text-decoration: none; }
a:hover { text-decoration: underline; }
figure { margin: 16px 0; }
img { display: block; max-width: 100%; height: auto; margin: 0 auto; padding: 8px;
  background: #ffffff; border: 1px solid var(--rule); border-radius: 8px; }
figcaption { color: var(--soft); font-size: 14px; margin-top: 6px; max-width: 78ch; }
.table { overflow-x: auto; margin: 16px 0; }
table { border-collapse: collapse; width: 100%; font-size: 15px;
  font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 600; color: var(--soft); font-size: 13px; }
th, td { padding: 6px 12px 6px 8px; border-bottom: 1px solid var(--rule); }
tbody tr:nth-child(even) { background: var(--row); }
.n { text-align: right; }
.holds { color: var(--good); white-space: nowrap; }
.missed { color: var(--bad); font-weight: 600; white-space: nowrap; }
main { padding-bottom: 64px; }
@media print { nav { display: none; } figure, tr { break-inside: avoid; } }
"""
