"""One small progress mechanism for every long call.

A long call reports `Progress(label, done, total, **numbers)` to a listener. The default
listener is a line that rewrites itself on a terminal, a bar in a notebook, and silence
elsewhere; `listen(callback)` replaces it for a block, `silent()` drops it. An exception
that a callback raises ends the call.
"""

import contextlib
import html
import math
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TextIO

_PAUSE = 0.1  # s between two pictures of a bar
_WORTH = 1.0  # s that a call must have taken for its last line to stay


class Progress(NamedTuple):
    """How far a call is: `done` of `total`, with the numbers that matter."""

    label: str
    done: float
    total: float
    numbers: Mapping[str, float] = MappingProxyType({})

    @property
    def fraction(self) -> float:
        return min(1.0, self.done / self.total) if self.total else 1.0


Listener = Callable[[Progress], None]


class View(NamedTuple):
    """The display of a bar: a line of text, and whether it is the last of its call."""

    text: str
    fraction: float
    elapsed: float
    finished: bool


class Watch:
    """Start times of the calls that run, of which some run inside others, and a limit on how
    often they are shown."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._calls: dict[str, tuple[float, float, float]] = {}

    def look(self, progress: Progress) -> View | None:
        """The picture of a report, None if the one before is too young."""
        now, label, share = self._clock(), progress.label, progress.fraction
        start, before, last = self._calls.get(label, (now, 0.0, -math.inf))
        if share < before:
            start = now  # the call was made again
        finished, due = share >= 1.0, now - last >= _PAUSE
        self._calls[label] = (start, share, now if due else last)
        if finished:
            del self._calls[label]
        elif not due:
            return None
        elapsed = now - start
        left = _span(elapsed * (1 / max(share, 1e-9) - 1)) if share > 0 and elapsed > 0 else "?"
        tail = f"{_span(elapsed)}, done" if finished else f"{left} left"
        numbers = "".join(f"  {name} {value:.4g}" for name, value in progress.numbers.items())
        text = f"{label}: {100 * share:3.0f} %{numbers}  {tail}"
        return View(text, share, elapsed, finished)


class Terminal:
    """Rewrites one line, at most ten times a second."""

    def __init__(self, stream: TextIO | None = None, watch: Watch | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._watch = Watch() if watch is None else watch

    def __call__(self, progress: Progress) -> None:
        view = self._watch.look(progress)
        if view is None:
            return
        stays = view.finished and view.elapsed >= _WORTH
        width = shutil.get_terminal_size().columns - 1
        line = view.text[:width] if stays or not view.finished else ""
        self._stream.write("\r\x1b[K" + line + ("\n" if stays else ""))
        self._stream.flush()


class Notebook:
    """A bar in the output of the cell, one for each call."""

    def __init__(self, display: Callable[..., Any], watch: Watch | None = None) -> None:
        self._display = display
        self._watch = Watch() if watch is None else watch
        self._bars: dict[str, Any] = {}

    def __call__(self, progress: Progress) -> None:
        view = self._watch.look(progress)
        if view is None:
            return
        picture = {
            "text/html": f'<progress value="{view.fraction:.4f}" max="1"></progress> '
            f"<code>{html.escape(view.text)}</code>",
            "text/plain": view.text,
        }
        bar = self._bars.get(progress.label)
        if bar is None:
            self._bars[progress.label] = self._display(picture, raw=True, display_id=True)
        else:
            bar.update(picture, raw=True)
        if view.finished:
            del self._bars[progress.label]


def _span(seconds: float) -> str:
    """A time as people say it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 90 else f"{minutes / 60:.1f} h"


def _default() -> Listener | None:
    shell = sys.modules.get("IPython")
    running = shell.get_ipython() if shell is not None else None
    if running is not None and hasattr(running, "kernel"):
        from IPython.display import display  # type: ignore[import-not-found]

        return Notebook(display)
    return Terminal() if sys.stderr.isatty() else None


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
def reported_if_long(label: str, total: float) -> Iterator[Callable[..., None]]:
    """A function like `report` of how much is done, silent in the first second of the block;
    what it told ends with all being done."""
    start, told = time.monotonic(), False

    def tell(done: float, **numbers: float) -> None:
        nonlocal told
        if time.monotonic() - start >= _WORTH:
            told = True
            report(label, done, total, **numbers)

    yield tell
    if told:
        report(label, total, total)


@contextlib.contextmanager
def listen(listener: Listener | None) -> Iterator[None]:
    """Send progress to `listener` inside the block.

    Args:
        listener: Called with every report; None for none at all.

    Returns:
        A context manager.
    """
    global _listener
    before, _listener = _listener, listener
    try:
        yield
    finally:
        _listener = before


def silent() -> contextlib.AbstractContextManager[None]:
    """No progress inside the block.

    Returns:
        A context manager.
    """
    return listen(None)
