"""ArUco markers: corners to a few hundredths of a pixel, poses, and the world frame.

Corners come from the edges: on normals of each side the gradient-weighted place of the
edge, a total least squares line through them, and the intersections of neighbouring lines.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sorojax._progress import report
from sorojax.vision.camera import Camera, Pose, marker_words, opencv


class Fiducials(NamedTuple):
    """Identity (`ids`) and `corners` [px] of markers, from the marker's own top left,
    clockwise."""

    ids: Int[np.ndarray, " n"]
    corners: Float[np.ndarray, "n 4 2"]


def find_fiducials(image: np.ndarray, dictionary: str = "6X6_250") -> Fiducials:
    """The ArUco markers of an image, grey or in colour.

    Args:
        image: Of 8-bit numbers.
        dictionary: Name in OpenCV without `DICT_`.

    Returns:
        Numbers of the markers, and their corners [px].

    Raises:
        ValueError: If OpenCV has no such dictionary.
    """
    cv2 = opencv()
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    words = marker_words("find_fiducials", dictionary)
    corners, ids, _ = cv2.aruco.ArucoDetector(words).detectMarkers(grey)
    if ids is None:
        return Fiducials(np.zeros(0, int), np.zeros((0, 4, 2)))
    rough = np.array(corners, float).reshape(-1, 4, 2)
    refined = np.stack([_refined(grey, one) for one in rough])
    order = np.argsort(ids.ravel(), kind="stable")
    return Fiducials(ids.ravel()[order], refined[order])


def marker_corners(size: float) -> Float[np.ndarray, "4 3"]:
    """Corners of a marker of side `size` [m] in its frame: x right, y up, z to the viewer.

    Args:
        size: Side of the marker [m].

    Returns:
        Corners [m], from the upper left one clockwise.
    """
    return size / 2 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])


def marker_pose(camera: Camera, corners: Float[np.ndarray, "4 2"], size: float) -> Pose:
    """Pose of one marker of side `size` [m] in the camera frame.

    Args:
        camera: Its calibration.
        corners: In the image [px], in the order of `marker_corners`.
        size: Side of the marker [m].

    Returns:
        The pose.
    """
    cv2 = opencv()
    points, bent = marker_corners(size), np.array(camera.distortion)
    method = cv2.SOLVEPNP_IPPE_SQUARE
    _, turn, place = cv2.solvePnP(points, corners, camera.matrix, bent, flags=method)
    return Pose(cv2.Rodrigues(turn)[0], place.ravel())


def world_frame(
    camera: Camera,
    found: Fiducials,
    places: Mapping[int, Float[np.ndarray, "4 3"]],
) -> Pose:
    """Pose of the world in the camera frame, from markers whose corners [m] are known there.

    Args:
        camera: Its calibration.
        found: From `find_fiducials`.
        places: Corners of each marker in the world [m], by its number.

    Returns:
        The pose.

    Raises:
        ValueError: If none of the known markers was found.
    """
    cv2 = opencv()
    known = [k for k, one in enumerate(found.ids) if int(one) in places]
    if not known:
        raise ValueError(
            f"world_frame: found markers {found.ids.tolist()}, need one of {sorted(places)}. "
            "Turn the camera to the board, or give the places of the markers it sees."
        )
    points = np.concatenate([np.asarray(places[int(found.ids[k])], float) for k in known])
    pixels = np.concatenate([found.corners[k] for k in known])
    distortion = np.array(camera.distortion)
    method = cv2.SOLVEPNP_SQPNP
    _, turn, place = cv2.solvePnP(points, pixels, camera.matrix, distortion, flags=method)
    turn, place = cv2.solvePnPRefineLM(points, pixels, camera.matrix, distortion, turn, place)
    left, _, right = np.linalg.svd(cv2.Rodrigues(turn)[0])
    return Pose(left @ right, place.ravel())


def _refined(grey: np.ndarray, corners: np.ndarray) -> np.ndarray:
    for reach in (3.0, 2.0):
        corners = _from_edges(grey, corners, reach)
    return corners


def _from_edges(grey: np.ndarray, corners: np.ndarray, reach: float) -> np.ndarray:
    sides = np.roll(corners, -1, axis=0) - corners
    along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)
    start = corners[:, None] + np.linspace(0.12, 0.88, 24)[None, :, None] * sides[:, None]
    offset = _edge_offsets(grey, start, across, reach)
    points = start + offset[..., None] * across[:, None]
    lines = [_line(p, o) for p, o in zip(points, offset, strict=True)]
    refined = np.array([_crossing(lines[k - 1], lines[k]) for k in range(4)])
    # a corner that runs away had no edge to hold on to
    fine = np.linalg.norm(refined - corners, axis=1) < 2 * reach
    return np.where(fine[:, None], refined, corners)


def _edge_offsets(grey, start, across, reach: float) -> np.ndarray:
    """Where on the normal through each point the grey value changes most [px]."""
    cv2, steps = opencv(), np.arange(-reach, reach + 0.01, 0.5)
    at = start[:, :, None] + steps[None, None, :, None] * across[:, None, None]
    x, y = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
    size = x.shape
    values = cv2.remap(grey, x.reshape(size[0], -1), y.reshape(size[0], -1), cv2.INTER_LINEAR)
    values = values.reshape(size).astype(float)
    slope, middle = np.abs(values[..., 2:] - values[..., :-2]), steps[1:-1]
    peak = middle[np.argmax(slope, axis=-1)]
    weight = slope * (np.abs(middle - peak[..., None]) <= 1.6)
    return (weight * middle).sum(axis=-1) / np.maximum(weight.sum(axis=-1), 1e-9)


def _line(points: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, float]:
    """Normal and distance of the line nearest to the points that agree with each other."""
    kept = points[np.abs(offset - np.median(offset)) < 0.6]
    middle = kept.mean(axis=0)
    normal = np.linalg.svd(kept - middle)[2][1]
    return normal, float(normal @ middle)


def _crossing(one, other) -> np.ndarray:
    return np.linalg.solve(np.stack([one[0], other[0]]), np.array([one[1], other[1]]))


# Intrinsics of a camera from pictures of a ChArUco board


_LEAST_CORNERS, _LEAST_VIEWS = 6, 5


class CharucoBoard(NamedTuple):
    """A chess board with ArUco markers on its white squares.

    Attributes:
        columns, rows: Squares across and down.
        square, marker: Sides of a square and of a marker [m].
        dictionary: Name of the ArUco dictionary, without `DICT_`.
    """

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
    """Intrinsics and distortion of a camera from pictures of a ChArUco board.

    Least squares on the projected corners (Zhang's method, by OpenCV). Ten pictures or more
    that fill the image and tilt the board by about 30 degrees each way give focal lengths to a
    part in a thousand.

    Args:
        images: Pictures of the board from different sides, grey or BGR of 8 bits, of one size
            [px].
        board: The printed board; lengths of its squares and markers [m].

    Returns:
        The camera, lengths in [px], with the root mean square error of the corners [px].

    Raises:
        ValueError: If fewer than five of them show enough of the board, or they are not of
            one size.

    Example:
        >>> board = vision.CharucoBoard()
        >>> camera = vision.Camera(300.0, 300.0, 160.0, 120.0, width=320, height=240)
        >>> images, picture = [], board.picture(1500.0)
        >>> for a, b in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5), (0.4, 0.4), (0.4, -0.4)):
        ...     turn = np.asarray(SE3().exp(jnp.array([a, b, 0.0, 0, 0, 0])))[:3, :3]
        ...     pose = vision.Pose(turn @ np.diag([1.0, -1, -1]), np.array([0.0, 0, 0.33]))
        ...     canvas = np.full((240, 320, 3), 90.0)
        ...     canvas = vision.draw_plane(canvas, camera, pose, picture, (0.24, 0.18))
        ...     images.append(canvas.astype(np.uint8))
        >>> found = vision.calibrate(images, board)
        >>> bool(abs(found.fx / 300 - 1) < 0.02)
        True

    Reference:
        Zhang, A flexible new technique for camera calibration, IEEE TPAMI 22, 2000.
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
    words, size = marker_words("CharucoBoard", board.dictionary), (board.columns, board.rows)
    return opencv().aruco.CharucoBoard(size, board.square, board.marker, words)
