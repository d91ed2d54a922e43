"""Numbers of a film as few bytes: int16 differences from frame to frame, deflated.

A column of numbers is cut to 65535 levels between its ends. The first frame is kept, of the
others the difference from a linear prediction of the two before, or from the one before,
whichever packs smaller; low and high bytes are separated, and all goes through zlib. A browser
undoes it with its own DecompressionStream.
"""

import base64
import zlib
from typing import Any

import numpy as np
from jaxtyping import Float

LEVELS = 32767


class Packer:
    """Collects arrays into one run of bytes."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, content: bytes) -> int:
        """Where the content starts."""
        start = self._size
        padded = content + bytes(-len(content) % 4)
        self._parts.append(padded)
        self._size += len(padded)
        return start

    def numbers(self, values: np.ndarray, kind: str) -> dict[str, Any]:
        """Plain little-endian numbers, e.g. of kind "<u4"."""
        flat = np.ascontiguousarray(values, dtype=kind)
        return {"at": self.add(flat.tobytes()), "count": int(flat.size)}

    def frames(
        self, values: Float[np.ndarray, "frames columns points"], low, high, levels=LEVELS
    ) -> dict[str, Any]:
        """Numbers between `low` and `high` of each column, at steps of 1 / (2 levels)."""
        levels = quantised(values, low, high, levels)
        first = np.diff(levels, axis=0, prepend=np.zeros_like(levels[:1]))
        second = np.diff(first, axis=0, prepend=np.zeros_like(first[:1]))
        orders = {1: _planes(first), 2: _planes(second)}
        sizes = {order: len(zlib.compress(planes, 1)) for order, planes in orders.items()}
        order = min(sizes, key=lambda order: sizes[order])
        shape = [int(n) for n in levels.shape]
        return {"at": self.add(orders[order]), "shape": shape, "order": order}

    def text(self) -> str:
        """All of it, deflated and in base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 6)).decode()


def quantised(values: np.ndarray, low, high, levels: int = LEVELS) -> np.ndarray:
    """Whole numbers from -levels to levels between `low` and `high`, one each per column."""
    low, high = (np.asarray(x, float)[None, :, None] for x in (low, high))
    half = np.maximum((high - low) / 2, 1e-300)
    share = np.clip((values - low) / half - 1, -1, 1)
    return np.rint(levels * share).astype(np.int16)


def _planes(steps: np.ndarray) -> bytes:
    """Low bytes, then high bytes; small steps of both signs have zero high bytes."""
    wide = steps.astype(np.int32)
    folded = ((wide << 1) ^ (wide >> 31)).astype(np.uint16)
    return (folded & 0xFF).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()
