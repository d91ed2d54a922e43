"""A folder of results, each under the key of what made it, whole or not there."""

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sorojax.io import _archive, _files
from sorojax.io._archive import Arrays as Arrays

_CHECK = "sha256"


@dataclass(frozen=True)
class Store:
    """Results in a folder that several drivers and workers may share.

    A file appears by renaming, so nobody reads half of one; a file whose content does not
    match its checksum counts as missing and is made again.

    Attributes:
        folder: Made at the first write.
        max_bytes: Larger files are refused.
    """

    folder: str | os.PathLike
    max_bytes: int = _files.MAX_BYTES

    def path(self, key: str) -> Path:
        return Path(self.folder) / f"{key}.npz"

    def write(self, key: str, result: Arrays) -> None:
        """Keep a result; a second one of the same key replaces the first."""
        target = self.path(key)
        target.parent.mkdir(parents=True, exist_ok=True)
        check = np.frombuffer(digest(result).encode(), np.uint8)

        named = {f"result.{name}": value for name, value in result.items()}

        def fill(file):
            _archive.write(file, named | {_CHECK: check})

        _files.write(target, fill)

    def read(self, key: str) -> Arrays | None:
        """The result of a key; None if there is none, or a damaged one."""
        target = self.path(key)
        if not target.is_file():
            return None
        try:
            content = _files.read("sweep", target, self.max_bytes)
            found = _archive.read(content, self.max_bytes)
            check = found.pop(_CHECK).tobytes().decode()
        except (ValueError, KeyError, OSError):
            return None
        result = {name.removeprefix("result."): array for name, array in found.items()}
        return result if digest(result) == check else None


def digest(result: Arrays) -> str:
    """A hash of names, types, shapes and bits."""
    hashed = hashlib.sha256()
    for name in sorted(result):
        array = np.ascontiguousarray(result[name])
        hashed.update(json.dumps([name, str(array.dtype), array.shape]).encode())
        hashed.update(array.tobytes())
    return hashed.hexdigest()
