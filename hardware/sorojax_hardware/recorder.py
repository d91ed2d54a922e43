"""Every sample of a run on disk, written by a thread of its own."""

import json
import queue
import struct
import threading
from pathlib import Path
from typing import Any

import numpy as np

_MAGIC, _VERSION = b"SOROLOG", 1
_HEAD = struct.Struct("<7sBI")
_MOST = 1 << 16  # length of the description, bytes


class Recorder:
    """A file of rows of float64, one column per number; `load_record` reads it.

    `write` never waits: rows go through a queue to a thread. A file that a crash cut short
    is read up to its last whole row. Use it in a `with` statement.
    """

    def __init__(
        self, path: str | Path, columns: list[str], *, waiting: int = 100_000, **about
    ):
        """
        Args:
            path: The file, overwritten.
            columns: Names, one per number of a row, "pressure[0]" and so on.
            waiting: Rows that may wait for the disk; beyond that they are dropped, counted.
            **about: Written into the head, anything that JSON takes.
        """
        head = json.dumps({"columns": columns, "about": about}).encode()
        if len(head) > _MOST:
            raise ValueError(
                f"Recorder: the description has {len(head)} bytes, need {_MOST} or fewer. "
                "Store large things apart."
            )
        self._width, self.dropped = len(columns), 0
        self._file = open(path, "wb")  # noqa: SIM115 (closed in `close`)
        self._file.write(_HEAD.pack(_MAGIC, _VERSION, len(head)) + head)
        self._rows: queue.Queue = queue.Queue(waiting)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def write(self, *values: Any) -> None:
        """One row: numbers and arrays, end to end."""
        row = np.concatenate([np.ravel(np.asarray(value, float)) for value in values])
        if row.size != self._width:
            raise ValueError(
                f"Recorder: got a row of {row.size} numbers, need {self._width}, one a column."
            )
        try:
            self._rows.put_nowait(row.tobytes())
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Write what waits."""
        if self._thread.is_alive():
            self._rows.put(None)
            self._thread.join()
        self._file.close()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def _work(self) -> None:
        while (row := self._rows.get()) is not None:
            self._file.write(row)
            if self._rows.empty():
                self._file.flush()


def load_record(path: str | Path) -> tuple[dict[str, np.ndarray], dict]:
    """Columns by name, and what was told about the run. "pressure[0]", "pressure[1]" ... come
    back as one array "pressure", a row per sample.

    Args:
        path: File name.

    Returns:
        Columns by name, and what was told about the run.

    Raises:
        ValueError: If the file is no record.
    """
    data = Path(path).read_bytes()
    if len(data) < _HEAD.size or data[:7] != _MAGIC:
        raise ValueError(f"load_record: {path} is no record of a run. Give a Recorder's file.")
    _, version, length = _HEAD.unpack_from(data)
    if version != _VERSION or length > _MOST or len(data) < _HEAD.size + length:
        raise ValueError(f"load_record: {path} has version {version} or is cut short.")
    head = json.loads(data[_HEAD.size : _HEAD.size + length])
    names = head["columns"]
    body = data[_HEAD.size + length :]
    whole = len(body) // (8 * len(names)) * 8 * len(names)
    rows = np.frombuffer(body[:whole], float).reshape(-1, len(names))
    return _gathered(names, rows), head["about"]


def _gathered(names: list[str], rows: np.ndarray) -> dict[str, np.ndarray]:
    groups: dict[str, list[int]] = {}
    for at, name in enumerate(names):
        groups.setdefault(name.split("[")[0], []).append(at)
    return {
        name: rows[:, columns] if "[" in names[columns[0]] else rows[:, columns[0]]
        for name, columns in groups.items()
    }
