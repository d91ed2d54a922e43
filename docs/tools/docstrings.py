"""Docstrings in plain words as reStructuredText: what it would read as a mark is escaped."""

import re

_SPAN = re.compile(r"(`+)(.+?)\1", re.S)
_BULLET = re.compile(r"^\s*[*-] ")


def as_rst(text: str) -> str:
    """`text` with its names in backticks kept, examples and indented code as they are."""
    out: list[str] = []
    for block, is_code in _blocks(text.split("\n")):
        if is_code and not block[0].lstrip().startswith(">>>") and out:
            out[-1 - (not out[-1])] += ":"  # "as follows:" becomes "as follows::"
        out += block if is_code else _escaped("\n".join(block)).split("\n")
    return "\n".join(out)


def _blocks(lines: list[str]) -> list[tuple[list[str], bool]]:
    """Runs of lines that are words, or code."""
    found: list[tuple[list[str], bool]] = []
    before = ""
    code_at: int | None = None  # indentation that ends a block of code
    for i, line in enumerate(lines):
        indent = len(line) - len(line.lstrip())
        if line.lstrip().startswith(">>>"):
            code_at = -1
        elif code_at is not None and _ends(line, indent, code_at):
            code_at = None
        elif code_at is None and _introduces(before, lines, i):
            code_at = len(before) - len(before.lstrip())
        is_code = code_at is not None
        if found and found[-1][1] == is_code:
            found[-1][0].append(line)
        else:
            found.append(([line], is_code))
        before = line if line.strip() else before
    return found


def _ends(line: str, indent: int, code_at: int) -> bool:
    """An example ends at an empty line, other code where the indentation does."""
    return not line.strip() if code_at == -1 else bool(line.strip()) and indent <= code_at


def _introduces(before: str, lines: list[str], i: int) -> bool:
    """Whether line `i` begins what a line that ends in a colon, and an empty one, announce."""
    line = lines[i]
    indent, last = (len(x) - len(x.lstrip()) for x in (line, before))
    announced = before.rstrip().endswith(":") and i > 0 and not lines[i - 1].strip()
    return announced and bool(line.strip()) and indent > last and not _BULLET.match(line)


def _escaped(text: str) -> str:
    parts, end = [], 0
    for span in _SPAN.finditer(text):
        parts += [_words(text[end : span.start()]), _span(text, span)]
        end = span.end()
    return "".join([*parts, _words(text[end:])])


def _span(text: str, span: re.Match[str]) -> str:
    """A name in backticks, set apart from a word that it touches."""
    before, after = text[: span.start()][-1:], text[span.end() :][:1]
    opens = "\\ " if before.isalnum() or before in ("^", "*", "_", "/", "=", ")") else ""
    closes = "\\ " if after.isalnum() or after in ("^", "*", "_", "(", "=") else ""
    return f"{opens if before else ''}{span[0]}{closes if after else ''}"


def _words(text: str) -> str:
    bullets = [_BULLET.match(line) for line in text.split("\n")]
    lines = []
    for line, bullet in zip(text.split("\n"), bullets, strict=True):
        head = bullet[0] if bullet else ""
        lines.append(head + re.sub(r"([\\*|_`])", r"\\\1", line[len(head) :]))
    return "\n".join(lines)


def first_sentence(text: str) -> str:
    """Up to the first full stop of the first paragraph, on one line."""
    head, dot, _ = " ".join(text.split("\n\n")[0].split()).partition(". ")
    return head + dot.strip()
