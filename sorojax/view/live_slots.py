"""A place in shared memory where the latest frame wins: writing never waits."""

import os
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_SLOTS = 3


class Frame(NamedTuple):
    """What was sent: its number from 1 on, the time [s] and the values."""

    number: int
    time: float
    values: Float[np.ndarray, " values"]


class Slots:
    """Three frames in a file that lies in memory, written in turn.

    The number of the latest frame is written after its content. A reader copies that frame
    and takes it only if its slot cannot have been begun again meanwhile.
    """

    def __init__(self, path: Path, size: int):
        rows = np.memmap(path, dtype=np.float64, mode="r+", shape=(_SLOTS + 1, size + 1))
        self.path = path
        self._head = rows[0, :1].view(np.int64)
        self._slots = rows[1:]

    @classmethod
    def new(cls, size: int) -> "Slots":
        """Empty slots for `size` numbers in a new file that only this user can read."""
        memory = "/dev/shm"
        folder = memory if os.access(memory, os.W_OK) else None
        handle, name = tempfile.mkstemp(prefix="sorojax.", dir=folder)
        with os.fdopen(handle, "wb") as file:
            file.write(bytes(8 * (_SLOTS + 1) * (size + 1)))
        return cls(Path(name), size)

    @property
    def latest(self) -> int:
        """Number of the latest frame, 0 before the first."""
        return int(self._head[0])

    def put(self, time: float, values: Float[np.ndarray, " values"]) -> None:
        """Write a frame over the oldest one."""
        number = int(self._head[0]) + 1
        slot = self._slots[number % _SLOTS]
        slot[0] = time
        slot[1:] = values
        self._head[0] = number

    def take(self, after: int) -> Frame | None:
        """A copy of the latest frame if its number is above `after`."""
        while (number := self.latest) > after:
            slot = self._slots[number % _SLOTS].copy()
            if self.latest < number + _SLOTS - 1:
                return Frame(number, float(slot[0]), slot[1:])
        return None
