"""One small progress mechanism for every long call.

A long call reports `Progress(label, done, total, **numbers)` to a listener. The
default listener prints one line that rewrites itself on a terminal and stays
silent elsewhere; `listen(callback)` replaces it for a block, `silent()` drops it.
"""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Progress:
    """How far a call is: `done` of `total`, with the numbers that matter."""

    label: str
    done: float
    total: float
    numbers: dict[str, float] = field(default_factory=dict)

    @property
    def fraction(self) -> float:
        return min(1.0, self.done / self.total) if self.total else 1.0


Listener = Callable[[Progress], None]


class _Terminal:
    """Rewrites one line per label, at most ten times a second."""

    def __init__(self) -> None:
        self.label = ""
        self.start = self.last = 0.0

    def __call__(self, progress: Progress) -> None:
        now = time.monotonic()
        if progress.label != self.label:
            self.label, self.start, self.last = progress.label, now, 0.0
        finished = progress.fraction >= 1.0
        if now - self.last < 0.1 and not finished:
            return
        self.last = now
        left = (now - self.start) * (1 / max(progress.fraction, 1e-9) - 1)
        numbers = "  ".join(f"{k} {v:.4g}" for k, v in progress.numbers.items())
        tail = "done" if finished else f"{left:.0f} s left"
        line = f"{progress.label}: {100 * progress.fraction:3.0f} %  {numbers}  {tail}"
        sys.stderr.write("\r\x1b[K" + line + ("\n" if finished else ""))
        sys.stderr.flush()


def _default() -> Listener | None:
    return _Terminal() if sys.stderr.isatty() else None


_UNSET: Listener | None = lambda _: None  # noqa: E731
_listener: Listener | None = _UNSET


def report(label: str, done: float, total: float, **numbers: float) -> None:
    """Tell the listener how far `label` is; costs nothing without a listener."""
    global _listener
    if _listener is _UNSET:
        _listener = _default()
    if _listener is not None:
        _listener(Progress(label, done, total, numbers))


@contextlib.contextmanager
def listen(listener: Listener | None) -> Iterator[None]:
    """Send progress to `listener` inside the block."""
    global _listener
    before, _listener = _listener, listener
    try:
        yield
    finally:
        _listener = before


def silent() -> contextlib.AbstractContextManager[None]:
    """No progress inside the block."""
    return listen(None)
