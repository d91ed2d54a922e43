"""A live view of a robot: a process of its own draws the latest frame.

The loop that feeds it copies a few numbers into shared memory, where the latest frame
replaces the one before, and goes on; it never waits, and a viewer that is slow, hung or gone
costs it nothing. When the process that feeds it ends, the viewer ends too.
"""

import abc
import base64
import contextlib
import json
import os
import pickle
import subprocess
import sys
import tempfile
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from sorojax.rod import num_coordinates
from sorojax.view import style
from sorojax.view.rigging.rig import Rig, pose

_SLOTS = 3


class Frame(NamedTuple):
    """One message: its number from 1 on, the time [s] and the values."""

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


# What a viewer process does with the frames that it sees


_PATIENCE = 1.0  # s between two signs of life of a page without news


class AbstractSink(abc.ABC):
    """Takes frames of `size` numbers in the viewer process, at most `fps` a second."""

    size: int
    fps: float = 30.0

    @abc.abstractmethod
    def open(self) -> str:
        """Start, in the viewer process; returns an address or ""."""

    @abc.abstractmethod
    def show(self, time: float, values: np.ndarray) -> None:
        """Show one frame."""

    @abc.abstractmethod
    def close(self) -> None:
        """End, also after the process that sent the frames has died."""


class Recording(AbstractSink):
    """Keeps the frames that it sees and writes them at the end, `time` and `values`, to an
    NPZ file: for runs without a display."""

    def __init__(self, path: str | Path, size: int, fps: float = 30.0):
        self.path, self.size, self.fps = Path(path).resolve(), size, fps
        self._seen: list[tuple[float, np.ndarray]] = []

    def open(self) -> str:
        self.path.touch()  # so that a wrong name is found at the start
        return ""

    def show(self, time: float, values: np.ndarray) -> None:
        self._seen.append((time, values))

    def close(self) -> None:
        times = np.array([time for time, _ in self._seen])
        rows = np.array([values for _, values in self._seen]).reshape(-1, self.size)
        with self.path.open("wb") as file:
            np.savez(file, time=times, values=rows)


class Browser(AbstractSink):
    """Serves a page that follows a rig, to browsers of this machine only; reach it from
    another one through an SSH tunnel.

    Args:
        rig: What is shown; its coordinates are sent.
        port: Of the page; a free one if 0.
        title: Shown above the picture.
        fps: Most frames per second.
    """

    def __init__(self, rig: Rig, port: int = 0, title: str = "", fps: float = 30.0):
        self.rig, self.port, self.title, self.fps = rig, port, title, fps
        self.size = num_coordinates(rig.model)

    def open(self) -> str:
        from sorojax.view.web import page as web
        from sorojax.view.web.actor import actor

        still = actor(self.rig, name=self.title or "robot")
        low, high = web.room([still])
        reach = float(np.max(high - low))
        self._ends = (low - reach, high + reach)
        packer = web.Packer()
        meta: dict[str, Any] = {
            "title": self.title, "stamps": ["waiting"], "seconds": [0.0], "speed": 1,
            "autoplay": False, "label": "", "limits": [0, 1], "levels": 1,
            "ramp": web.colours_of_map(), "live": "frames",
            "box": [(low - reach / 4).tolist(), (high + reach / 4).tolist()],
            "actors": [web.described(still, (0.0, 1.0), packer, self._ends)],
        }  # fmt: skip
        self._stream = _Stream(web.filled(meta, packer))
        server = ThreadingHTTPServer(("127.0.0.1", self.port), self._stream.handler())
        server.daemon_threads = True
        self._server, port = server, server.server_address[1]
        self._stream.hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}
        threading.Thread(target=server.serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{port}/"

    def show(self, time: float, values: np.ndarray) -> None:
        from sorojax.view.web.page import quantised

        points = np.asarray(pose(self.rig, values))
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        levels = quantised(points.T[None], *self._ends)
        coded = base64.b64encode(levels.astype("<i2").tobytes()).decode()
        self._stream.put(json.dumps({"stamp": f"t = {time:.2f} s", "points": coded}))

    def close(self) -> None:
        self._stream.put("")
        self._server.shutdown()


class _Stream:
    """The page, and its latest news for every browser that looks."""

    def __init__(self, page: str):
        self.page, self.hosts = page.encode(), set[str]()
        self._news, self._number = "", 0
        self._changed = threading.Condition()

    def put(self, news: str) -> None:
        with self._changed:
            self._news, self._number = news, self._number + 1
            self._changed.notify_all()

    def after(self, number: int) -> tuple[int, str]:
        """The latest news, waited for if there is none after `number`."""
        with self._changed:
            if self._number == number:
                self._changed.wait(_PATIENCE)
            return self._number, self._news

    def handler(self) -> type[BaseHTTPRequestHandler]:
        stream = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                # A page of another site must not read it through a name of its own.
                if self.headers.get("Host") not in stream.hosts:
                    self.send_error(403)
                elif self.path == "/":
                    self._head("text/html; charset=utf-8", len(stream.page))
                    self.wfile.write(stream.page)
                elif self.path == "/frames":
                    self._head("text/event-stream")
                    self._follow()
                else:
                    self.send_error(404)

            def _head(self, kind: str, length: int | None = None) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Cache-Control", "no-store")
                if length is not None:
                    self.send_header("Content-Length", str(length))
                self.end_headers()

            def _follow(self) -> None:
                number = 0
                try:
                    while True:
                        before = number
                        number, news = stream.after(number)
                        if number and not news:
                            return
                        line = f"data: {news}\n\n" if number > before else ": waiting\n\n"
                        self.wfile.write(line.encode())
                        self.wfile.flush()
                except OSError:
                    return  # the browser went away

            def log_message(self, format: str, *args: Any) -> None:
                del format, args

        return Handler


# Looking at a robot while it runs: a process of its own draws the latest frame


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

    Returns:
        The feed, a context manager.

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
        [sys.executable, "-m", "sorojax.view.viewer", str(slots.path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=_environment(),
    )
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


# A live view in viser (extra `live`): orbit, pick, and add to its scene


class Viser(AbstractSink):
    """Serves a rig in a viser scene, to browsers of this machine only.

    Args:
        rig: What is shown; its coordinates are sent.
        port: Of the page; one above that is free if it is taken.
        title: Above the scene.
        fps: Most frames per second.

    Raises:
        ModuleNotFoundError: In the viewer process, without the extra `live`.
    """

    def __init__(self, rig: Rig, port: int = 8080, title: str = "robot", fps: float = 30.0):
        self.rig, self.port, self.title, self.fps = rig, port, title, fps
        self.size = num_coordinates(rig.model)

    def open(self) -> str:
        try:
            import viser
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "Viser: viser is not installed. pip install 'sorojax[live]', or pass the rig "
                "itself to view.live for the page that needs nothing."
            ) from error
        with contextlib.redirect_stdout(sys.stderr):  # where `live` waits for its own word
            self._server = viser.ViserServer("127.0.0.1", self.port, self.title, verbose=False)
        self._server.scene.set_up_direction("+z")
        self._mesh = self._server.scene.add_mesh_simple(
            "/robot",
            self._points(None),
            np.asarray(self.rig.triangles),
            color=tuple(bytes.fromhex(style.BODY[1:])),
            side="double",
        )
        self._stamp = self._server.gui.add_text("time", "waiting", disabled=True)
        return f"http://127.0.0.1:{self._server.get_port()}/"

    def show(self, time: float, values: np.ndarray) -> None:
        self._mesh.vertices = self._points(values)
        self._stamp.value = f"t = {time:.2f} s"

    def close(self) -> None:
        self._server.flush()
        self._server.stop()

    def _points(self, values: np.ndarray | None) -> np.ndarray:
        points = np.asarray(pose(self.rig, values), np.float32)
        return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
