"""What a viewer process does with the frames that it sees."""

import abc
import base64
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from sorojax.rod import num_coordinates
from sorojax.view.rigging.rig import Rig, pose

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
        from sorojax.view.web.pack import Packer

        still = actor(self.rig, name=self.title or "robot")
        low, high = web.room([still])
        reach = float(np.max(high - low))
        self._ends = (low - reach, high + reach)
        packer = Packer()
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
        from sorojax.view.web.pack import quantised

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
