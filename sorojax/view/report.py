"""One self-contained HTML file: headings, text, pictures and tables of numbers."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Union

from sorojax.view.film.film import Film
from sorojax.view.picture import Picture
from sorojax.view.style import asset, png

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Drawn = Union["Figure", Picture, Film, bytes]


@dataclass(frozen=True)
class Number:
    """A row of a table: `name` and `value` of what was found with its `unit`, what was asked
    for (`bar`, as text), and whether it `holds`, None where nothing was asked."""

    name: str
    value: float | int | str
    unit: str = ""
    bar: str = ""
    holds: bool | None = None


@dataclass(frozen=True)
class Section:
    """A `heading` with `text`, whose paragraphs are split at empty lines, then `pictures` as
    (caption, picture), and `numbers` as the rows of a table."""

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

    Returns:
        The page as text.
    """
    body = "\n".join(_section(section, k) for k, section in enumerate(sections))
    links = "".join(
        f'<a href="#s{k}">{escape(section.heading)}</a>' for k, section in enumerate(sections)
    )
    parts = {"lead": _paragraphs(lead, "lead"), "links": links, "body": body}
    look = "\n" + asset("report.css")
    return asset("report.html").format(title=escape(title), style=look, **parts)


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
