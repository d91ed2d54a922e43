"""The viewer process: `python -m sorojax.view.viewer SLOTS`, started by `view.live`.

It reads its sink from the standard input, whose end then signals that the process that feeds
it is gone.
"""

import os
import pickle
import signal
import sys
import threading
import time
from pathlib import Path
from typing import BinaryIO

from sorojax._cache import enable_compilation_cache
from sorojax.view.live_view import AbstractSink, Slots

_NICE = 5


def main(path: str, source: BinaryIO) -> None:
    """Show what comes until the source ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that feeds it gets it too
    if hasattr(os, "nice"):
        os.nice(_NICE)  # the loop that is looked at comes first
    size = int.from_bytes(source.read(8), "little")
    sink = pickle.loads(source.read(size))
    slots = Slots(Path(path), sink.size)
    enable_compilation_cache()
    url = sink.open()
    gone = threading.Event()
    threading.Thread(target=_wait, args=(source, gone), daemon=True).start()
    print(f"ready {url}", flush=True)
    try:
        follow(sink, slots, gone)
    finally:
        sink.close()
        slots.path.unlink(missing_ok=True)


def follow(sink: AbstractSink, slots: Slots, gone: threading.Event) -> None:
    """Give the sink the latest frame whenever there is a new one."""
    seen, period = 0, 1 / sink.fps
    while True:
        begin = time.monotonic()
        ended = gone.is_set()
        if (frame := slots.take(seen)) is not None:
            sink.show(frame.time, frame.values)
            seen = frame.number
        elif ended:
            return
        gone.wait(max(0.0, period - (time.monotonic() - begin)))


def _wait(source: BinaryIO, gone: threading.Event) -> None:
    source.read()
    gone.set()


if __name__ == "__main__":
    main(sys.argv[1], sys.stdin.buffer)
