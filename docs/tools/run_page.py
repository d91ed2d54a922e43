"""Run the programs of a page of the documentation and compare what they print with the page.

python docs/tools/run_page.py PAGE... [--pictures] [--write]
"""

import argparse
import contextlib
import io
import math
import re
import sys
import tempfile
import textwrap
import time
import types
import warnings
from pathlib import Path
from typing import NamedTuple

import jax
import matplotlib
from PIL import Image

PICTURES = Path(__file__).resolve().parents[1] / "pictures"
_FENCE = re.compile(r"^```([\w-]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
matplotlib.use("Agg")


class Block(NamedTuple):
    """A program of a page, its first line, and the text that follows, with its place."""

    line: int
    code: str
    expected: str | None
    span: tuple[int, int] | None


def blocks(path: Path) -> list[Block]:
    """The ``python`` blocks of a page, each with the ``text`` block right after it."""
    page, found = path.read_text(), []
    fences = list(_FENCE.finditer(page))
    for fence, after in zip(fences, [*fences[1:], None], strict=True):
        if fence[1] != "python":
            continue
        told = None, None
        if after and after[1] == "text" and not page[fence.end() : after.start()].strip():
            told = after[2], after.span(2)
        found.append(Block(page.count("\n", 0, fence.start(2)) + 1, fence[2], *told))
    return found


def run(path: Path, folder: Path) -> None:
    """Run all programs of a page in one namespace, in `folder`. An `AssertionError` tells page
    and line where they print other words or numbers, or a picture was not drawn."""
    for block, printed in outputs(path, folder):
        if why := difference(block.expected or "", printed):
            raise AssertionError(f"{path}, program at line {block.line}: {why}\n{printed}")
    for name in re.findall(r"(?<!_generated)/pictures/([\w.]+)\)", path.read_text()):
        assert (folder / name).exists(), f"{path}: its programs do not draw {name}"


def outputs(path: Path, folder: Path) -> list[tuple[Block, str]]:
    """The programs of a page and what they print; a warning meant for users is an error."""
    page = types.ModuleType(f"page_{path.stem}")
    sys.modules[page.__name__] = page  # classes of the page look their module up
    found, ranks, kinds = [], jax.numpy_rank_promotion, jax.numpy_dtype_promotion
    with (
        contextlib.chdir(folder), jax.enable_x64(True), warnings.catch_warnings(),
        ranks("allow"), kinds("standard"),
    ):  # fmt: skip
        warnings.simplefilter("error", UserWarning)
        for block in blocks(path):
            code = compile("\n" * (block.line - 1) + block.code, str(path), "exec")
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                exec(code, vars(page))
            found.append((block, printed.getvalue()))
    return found


def difference(expected: str, printed: str) -> str:
    """Where texts differ, but for line breaks and 2 % of a number; empty if nowhere."""
    if _NUMBER.sub("#", expected).split() != _NUMBER.sub("#", printed).split():
        return f"prints other words than\n{expected}"
    pairs = zip(_NUMBER.findall(expected), _NUMBER.findall(printed), strict=True)
    off = [(a, b) for a, b in pairs if not math.isclose(float(a), float(b), rel_tol=0.02)]
    return ", ".join(f"{a} is now {b}" for a, b in off)


def written(path: Path, found: list[tuple[Block, str]]) -> str:
    """The page with its expected texts replaced by what was printed."""
    page = path.read_text()
    for block, printed in reversed(found):
        if block.span is not None:
            lines = [textwrap.fill(line, 92) for line in printed.rstrip().split("\n")]
            page = page[: block.span[0]] + "\n".join([*lines, ""]) + page[block.span[1] :]
    return page


def main(pages: list[Path], pictures: bool, write: bool) -> None:
    for path in pages:
        with tempfile.TemporaryDirectory() as folder:
            if write:
                path.write_text(written(path, outputs(path.resolve(), Path(folder))))
            else:
                run(path.resolve(), Path(folder))
            for picture in Path(folder).glob("*.png") if pictures else ():
                image = Image.open(picture).convert("RGB")
                image.thumbnail((900, 900))
                image.quantize(256).save(PICTURES / picture.name, optimize=True)
        print(f"{path}: done, {time.process_time():.1f} s of CPU up to here")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--pictures", action="store_true", help="keep pictures in the docs")
    parser.add_argument("--write", action="store_true", help="write what is printed into pages")
    main(**vars(parser.parse_args()))
