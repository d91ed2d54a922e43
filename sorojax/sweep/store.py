"""A folder of results, each under the key of what made it, whole or not there."""

import hashlib
import io
import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sorojax.io import _files

Arrays = dict[str, np.ndarray]
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

        def fill(file):
            np.savez(file, allow_pickle=False, **{f"result.{k}": v for k, v in result.items()},
                     **{_CHECK: check})  # fmt: skip

        _files.write(target, fill)

    def read(self, key: str) -> Arrays | None:
        """The result of a key; None if there is none, or a damaged one."""
        target = self.path(key)
        if not target.is_file():
            return None
        try:
            content = _files.read("sweep", target, self.max_bytes)
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                if sum(entry.file_size for entry in archive.infolist()) > self.max_bytes:
                    return None
            with np.load(io.BytesIO(content), allow_pickle=False) as file:
                names = [name for name in file.files if name.startswith("result.")]
                result = {name.removeprefix("result."): file[name] for name in names}
                check = file[_CHECK].tobytes().decode()
        except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile):
            return None
        return result if digest(result) == check else None


def digest(result: Arrays) -> str:
    """A hash of names, types, shapes and bits."""
    hashed = hashlib.sha256()
    for name in sorted(result):
        array = np.ascontiguousarray(result[name])
        hashed.update(json.dumps([name, str(array.dtype), array.shape]).encode())
        hashed.update(array.tobytes())
    return hashed.hexdigest()
