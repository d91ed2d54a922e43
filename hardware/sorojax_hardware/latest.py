"""A camera that never keeps a loop waiting."""

import threading

import numpy as np

from sorojax_hardware.protocols import Camera, Image


class Latest:
    """Another camera read by a thread: `read` gives its newest image and never waits.

    Images that nobody took in time are dropped, and so are images whose time does not go
    on (`dropped` counts both). An error of the camera is raised by the next `read`.
    """

    def __init__(self, camera: Camera, *, pause: float = 0.001):
        self._camera, self._lock = camera, threading.Lock()
        self._image: Image | None = None
        self._error: BaseException | None = None
        self._last, self.dropped, self._ended = -np.inf, 0, threading.Event()
        self._pause = pause
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def read(self) -> Image | None:
        with self._lock:
            image, self._image = self._image, None
            error, self._error = self._error, None
        if error is not None:
            raise error
        return image

    def close(self) -> None:
        self._ended.set()
        self._thread.join(5)
        self._camera.close()

    def _work(self) -> None:
        while not self._ended.is_set():
            try:
                image = self._camera.read()
            except Exception as reason:
                with self._lock:
                    self._error = reason
                return
            if image is None:
                self._ended.wait(self._pause)
                continue
            with self._lock:
                late = image.time <= self._last
                self.dropped += late or self._image is not None
                if not late:
                    self._image, self._last = image, image.time
