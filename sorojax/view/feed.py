"""Looking at a robot while it runs: a process of its own draws the latest frame.

The loop that feeds it copies a few numbers into memory and goes on; it never waits, and a
viewer that is slow, hung or gone costs it nothing. When the process that feeds it ends, in
whatever way, the viewer ends too.
"""

import contextlib
import os
import pickle
import subprocess
import sys
import threading
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from sorojax.view.live_sinks import AbstractSink, Browser
from sorojax.view.live_slots import Slots
from sorojax.view.rigging import Rig

_START = 60.0  # s that a viewer may take to start


class Feed:
    """Where a running loop puts its frames.

    Attributes:
        url: Address of the page, or "" if the viewer has none.
        sent: Frames sent so far.
    """

    def __init__(self, sink: AbstractSink, process: subprocess.Popen, slots: Slots, url: str):
        self.url, self.sent = url, 0
        self._size, self._process, self._slots = sink.size, process, slots

    def send(self, time: float, values: Float[Any, " values"]) -> None:
        """Show `values` (the coordinates of a rig) at `time` [s]; the latest frame wins.

        Takes some microseconds and never waits for the viewer. Give NumPy arrays: a JAX
        array is waited for until it is computed. Under a transformation use
        `jax.debug.callback(feed.send, t, q)`.
        """
        row = np.asarray(values, float).reshape(-1)
        if row.size != self._size:
            raise ValueError(
                f"Feed.send: got {row.size} values, need {self._size}. Send the coordinates of "
                "the model that the viewer shows."
            )
        self._slots.put(float(time), row)
        self.sent += 1

    @property
    def alive(self) -> bool:
        """Whether the viewer still runs."""
        return self._process.poll() is None

    def close(self, timeout: float = 10.0) -> None:
        """End the viewer after its last frame; waits for it, so not for a control loop."""
        with contextlib.suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()  # type: ignore[union-attr]
        self._slots.path.unlink(missing_ok=True)

    def __enter__(self) -> "Feed":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def live(what: Rig | AbstractSink, **options: Any) -> Feed:
    """Start a viewer for a running loop; use it in a `with` block.

    Args:
        what: A rig, shown in a page at an address of this machine (`feed.url`), to which its
            coordinates are sent; or another sink: `Viser(rig)` for a scene of the extra
            `live`, `Recording(path, size)`.
        **options: Those of `Browser`: `port`, `title`, `fps`.

    Raises:
        RuntimeError: If the viewer did not start.

    Example:
        with view.live(rig) as feed:
            for tick in run_loop(board, clock, controller, state, ...):
                feed.send(tick.time, tick.state.q)
    """
    sink = Browser(what, **options) if isinstance(what, Rig) else what
    content = _pickled(sink)
    slots = Slots.new(sink.size)
    process = subprocess.Popen(
        [sys.executable, "-m", "sorojax.view.live_viewer", str(slots.path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=_environment(),
    )  # fmt: skip
    assert process.stdin is not None and process.stdout is not None
    late = threading.Timer(_START, process.kill)
    late.start()
    try:
        process.stdin.write(len(content).to_bytes(8, "little") + content)
        process.stdin.flush()
        word, _, url = process.stdout.readline().decode().strip().partition(" ")
    except OSError:
        word, url = "", ""
    finally:
        late.cancel()
    feed = Feed(sink, process, slots, url)
    if word != "ready":
        feed.close()
        raise RuntimeError(
            f"live: the viewer ended with status {process.returncode} before it was ready. Its "
            "message is above; a port in use wants another `port`."
        )
    return feed


def _pickled(sink: AbstractSink) -> bytes:
    if type(sink).__module__ == "__main__":
        raise ValueError(
            f"live: the sink {type(sink).__name__} is defined in the script itself, where "
            "another process cannot find it. Put it into a module."
        )
    return pickle.dumps(sink)


def _environment() -> dict[str, str]:
    """The viewer computes on the CPU, with the same floats, and finds the same modules."""
    found = dict(os.environ)
    found["JAX_PLATFORMS"] = "cpu"
    found["JAX_ENABLE_X64"] = str(int(jax.config.read("jax_enable_x64")))
    found["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    return found
