"""Sources of images: webcam, video file, folder, a drawing function; all fit `Camera`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sorojax_hardware.protocols import Clock, Image


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as missing:
        raise ImportError("camera: need OpenCV. pip install 'sorojax[vision]'") from missing
    return cv2


class VideoCamera:
    """A webcam by number, or a video file by path.

    A file's images carry the times that it was recorded with, and are read one by one as
    fast as they are asked for; a webcam's carry `clock`. Reading waits for the next image
    of a webcam: put it in `Latest` for a loop.
    """

    def __init__(self, source: int | str | Path, clock: Clock | None = None, *, size=None):
        """
        Args:
            source: Number of the device, or a file.
            clock: Where the times of a webcam come from.
            size: Wanted (width, height) [px].

        Raises:
            ConnectionError: If it does not open.
        """
        cv2 = _opencv()
        self._live, self._clock, self._count = isinstance(source, int), clock, 0
        self._video = cv2.VideoCapture(source if self._live else str(source))
        if not self._video.isOpened():
            what = f"camera {source}" if self._live else f"video file {source}"
            raise ConnectionError(
                f"VideoCamera: {what} does not open. Check that it is there and not in use."
            )
        if size is not None:
            self._video.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            self._video.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        self._rate = self._video.get(cv2.CAP_PROP_FPS) or 30.0

    def read(self) -> Image | None:
        seen, colour = self._video.read()
        if not seen:
            return None
        self._count += 1
        if self._live and self._clock is not None:
            return Image(self._clock.now(), colour)
        return Image((self._count - 1) / self._rate, colour)

    def close(self) -> None:
        self._video.release()


class FolderCamera:
    """The images of a folder in the order of their names.

    Colour images are .png or .jpg; `NAME.depth.npy` beside one is its depth [m]. `times.txt`
    holds one time [s] per line; without it there are `rate` images a second.
    """

    def __init__(self, folder: str | Path, *, rate: float = 30.0):
        self._folder = Path(folder)
        names = (p for p in self._folder.iterdir() if p.suffix in (".png", ".jpg"))
        self._files, self._next = sorted(names), 0
        if not self._files:
            raise ValueError(f"FolderCamera: {folder} holds no .png and no .jpg.")
        times = self._folder / "times.txt"
        if times.exists():
            self._times = np.loadtxt(times, ndmin=1)
        else:
            self._times = np.arange(len(self._files)) / rate
        if len(self._times) != len(self._files):
            raise ValueError(
                f"FolderCamera: {times} has {len(self._times)} times for {len(self._files)} "
                "images, need one each."
            )

    def read(self) -> Image | None:
        if self._next == len(self._files):
            return None
        file, time = self._files[self._next], float(self._times[self._next])
        self._next += 1
        colour = _opencv().imread(str(file))
        if colour is None:
            raise ValueError(f"FolderCamera: {file} is no image.")
        beside = file.with_suffix(".depth.npy")
        depth = np.load(beside, allow_pickle=False) if beside.exists() else None
        return Image(time, colour, depth)

    def close(self) -> None:
        pass


class DrawnCamera:
    """Images drawn when they are due: `draw(t)` gives the picture of the time t [s].

    `draw` returns a colour image, or (colour, depth [m]).
    """

    def __init__(self, draw: Callable[[float], Any], clock: Clock, *, rate: float = 60.0):
        self._draw, self._clock, self._rate = draw, clock, rate
        self._start, self._drawn = clock.now(), -1

    def read(self) -> Image | None:
        now = self._clock.now() - self._start
        due = int(np.floor(now * self._rate + 1e-9))
        if due == self._drawn:
            return None
        self._drawn = due
        picture = self._draw(due / self._rate)
        colour, depth = picture if isinstance(picture, tuple) else (picture, None)
        return Image(self._start + due / self._rate, colour, depth)

    def close(self) -> None:
        pass
