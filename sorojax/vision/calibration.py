"""Intrinsics of a camera from pictures of a ChArUco board."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from sorojax._progress import report
from sorojax.vision._opencv import opencv
from sorojax.vision.camera import Camera

_LEAST_CORNERS, _LEAST_VIEWS = 6, 5


class CharucoBoard(NamedTuple):
    """A chess board with ArUco markers on its white squares; sizes in m."""

    columns: int = 8
    rows: int = 6
    square: float = 0.03
    marker: float = 0.022
    dictionary: str = "6X6_250"

    def picture(self, pixels_per_metre: float = 4000.0) -> np.ndarray:
        """The board to print, grey, at true size for 4000 px/m (about 100 dpi)."""
        size = [round(n * self.square * pixels_per_metre) for n in (self.columns, self.rows)]
        return _board(self).generateImage(size)


def calibrate(images: Iterable[np.ndarray], board: CharucoBoard) -> Camera:
    """The camera that took `images` of the board from different sides.

    Ten pictures or more that fill the image and tilt the board by about 30 degrees each way
    give focal lengths to a part in a thousand.

    Raises:
        ValueError: If fewer than five of them show enough of the board, or they are not of
            one size.
    """
    cv2 = opencv()
    detector = cv2.aruco.CharucoDetector(_board(board))
    images, points, pixels, sizes = list(images), [], [], set()
    for count, image in enumerate(images, start=1):
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        sizes.add(grey.shape[::-1])
        corners, ids, _, _ = detector.detectBoard(grey)
        report("calibrate", count, len(images), corners=0 if ids is None else len(ids))
        if ids is None or len(ids) < _LEAST_CORNERS:
            continue
        there, seen = _board(board).matchImagePoints(corners, ids)
        points.append(there.astype(np.float32))
        pixels.append(seen.astype(np.float32))
    if len(points) < _LEAST_VIEWS or len(sizes) != 1:
        raise ValueError(
            f"calibrate: {len(points)} pictures show {_LEAST_CORNERS} corners or more, sizes "
            f"{sorted(sizes)}; need {_LEAST_VIEWS} of one size. Check that `board` has the "
            "numbers of the printed one, and hold it nearer."
        )
    size = sizes.pop()
    rms, matrix, distortion, _, _ = cv2.calibrateCamera(points, pixels, size, None, None)
    (fx, _, cx), (_, fy, cy) = matrix[:2]
    five = tuple(float(k) for k in np.ravel(distortion)[:5])
    return Camera(float(fx), float(fy), float(cx), float(cy), five, *size, float(rms))  # type: ignore


def _board(board: CharucoBoard):
    aruco = opencv().aruco
    words = aruco.getPredefinedDictionary(getattr(aruco, f"DICT_{board.dictionary.upper()}"))
    return aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, words)
