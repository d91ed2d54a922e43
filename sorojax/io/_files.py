"""Files that are checked before they are read and whole when they are written."""

import contextlib
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

MAX_BYTES = 2_000_000_000


def inside(where: str, path: str | os.PathLike, root: str | os.PathLike | None) -> Path:
    """`path` as a `Path`; with `root`, refused where it leads outside, links followed."""
    if "\0" in os.fspath(path):
        raise ValueError(f"{where}: the path holds a zero byte. Give a plain file name.")
    if root is None:
        return Path(path)
    base = Path(root).resolve()
    full = (base / path).resolve()
    if not full.is_relative_to(base) or full == base:
        raise ValueError(
            f"{where}: `{os.fspath(path)}` leads to {full}, need a file below {base}. Use a "
            "relative name without `..` and without links that leave the folder."
        )
    return full


def read(where: str, path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Content of a regular file of at most `max_bytes`; its size is checked first."""
    with open(path, "rb") as file:
        info = os.fstat(file.fileno())
        if not stat.S_ISREG(info.st_mode):
            raise ValueError(f"{where}: {path} is no regular file. Give a file on disk.")
        if info.st_size > max_bytes:
            raise ValueError(
                f"{where}: {path} has {info.st_size} bytes, the limit is {max_bytes}. Raise "
                "`max_bytes` if you trust it and have the memory."
            )
        return file.read(max_bytes)


def write(path: Path, fill: Callable[[BinaryIO], Any]) -> None:
    """Let `fill` write a temporary file beside `path`, then rename it to `path`.

    Nobody ever sees half a file, and an error leaves the old one as it was.
    """
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise


@contextlib.contextmanager
def made_beside(path: Path) -> Iterator[Path]:
    """The same for what writes files by their names: that of the one to write."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}.") as folder:
        made = Path(folder) / path.name
        yield made
        os.replace(made, path)


def _umask() -> int:
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
