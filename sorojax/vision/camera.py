"""The pinhole camera with Brown-Conrady distortion, and depth images.

Camera frame: x right, y down, z along the optical axis. Pixel (0, 0) is the centre of the
first one. NumPy, because a frame is seen by several programs that do not run JAX.

Reference: D. C. Brown, "Close-range camera calibration", Photogrammetric Engineering 37,
1971; the order k1 k2 p1 p2 k3 of the coefficients is that of OpenCV and RealSense.
"""

import functools
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

_NONE = (0.0, 0.0, 0.0, 0.0, 0.0)


class Camera(NamedTuple):
    """Intrinsics of a camera and the size of its images.

    Attributes:
        fx, fy: Focal lengths [px].
        cx, cy: Principal point [px].
        distortion: Coefficients k1, k2, p1, p2, k3 of OpenCV's model [-].
        width, height: Of the image [px].
        rms: Error of the calibration that found them [px].
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = _NONE
    width: int = 640
    height: int = 480
    rms: float = 0.0

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])


class Pose(NamedTuple):
    """Maps points of its own frame to another one: `rotation` @ x + `translation` [m]."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]

    def apply(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        return points @ self.rotation.T + self.translation

    def inverse(self) -> "Pose":
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)


def project(camera: Camera, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Pixels of points in the camera frame [m]; NaN behind the camera.

    Args:
        camera: Its calibration.
        points: In the camera frame [m].

    Returns:
        Column and row [px].
    """
    points = np.asarray(points, float)
    depth = points[..., 2:]
    plane = np.divide(
        points[..., :2], depth, where=depth > 0, out=np.full(points[..., :2].shape, np.nan)
    )
    return _distorted(camera, plane) * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def deproject(
    camera: Camera, pixels: Float[np.ndarray, "*n 2"], depth: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n 3"]:
    """Points in the camera frame [m] from pixels and their depth along the axis [m]; NaN
    where the depth is not positive, as a sensor marks what it could not see.

    Args:
        camera: Its calibration.
        pixels: Column and row [px].
        depth: Along the axis [m].

    Returns:
        Points [m].
    """
    depth = np.asarray(depth, float)
    depth = np.where(depth > 0, depth, np.nan)[..., None]
    plane = rays(camera, pixels)
    return np.concatenate([plane * depth, depth], axis=-1)


def rays(camera: Camera, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Undistorted coordinates x/z, y/z of pixels, by Newton's method."""
    pixels = np.asarray(pixels, float)
    wanted = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    if not any(camera.distortion):
        return wanted
    plane, change = wanted, np.inf
    for _ in range(20):
        if not change > 1e-14:  # NaN ends it too
            break
        left = wanted - _distorted(camera, plane)
        (a, b), (c, d) = _slopes(camera, plane)
        x, y = left[..., 0], left[..., 1]
        move = np.stack([d * x - b * y, a * y - c * x], axis=-1) / (a * d - b * c)[..., None]
        plane, change = plane + move, np.max(np.abs(move), initial=0.0)
    return plane


def on_plane(
    camera: Camera,
    pixels: Float[np.ndarray, "*n 2"],
    plane: Pose,
    height: float | Float[np.ndarray, "*n"] = 0.0,
) -> Float[np.ndarray, "*n 2"]:
    """Where the rays of pixels meet a plane: places of markers that one colour camera sees.

    Args:
        camera: Its calibration.
        pixels: Column and row [px].
        plane: Frame whose x and y lie in the plane, as the camera sees it: from `world_frame`
            or `marker_pose`.
        height: Of all markers over the plane, or of each, along its z axis [m].

    Returns:
        x and y in the frame of the plane [m]; NaN where a ray does not meet it before the
        camera.

    Example:
        >>> lens = vision.Camera(fx=600, fy=600, cx=320, cy=240)
        >>> wall = vision.Pose(np.eye(3), np.array([0.0, 0.0, 0.5]))  # half a metre away
        >>> pixels = vision.project(lens, wall.apply(np.array([[0.02, 0.03, 0.0]])))
        >>> vision.on_plane(lens, pixels, wall).round(6)
        array([[0.02, 0.03]])
    """
    ways = deproject(camera, pixels, np.ones(np.shape(pixels)[:-1])) @ plane.rotation
    eye = plane.inverse().translation
    gap = np.broadcast_to(height - eye[2], ways[..., 2].shape)
    depth = np.divide(gap, ways[..., 2], where=ways[..., 2] != 0, out=np.zeros(gap.shape))
    depth = np.where(depth > 0, depth, np.nan)
    return eye[:2] + ways[..., :2] * depth[..., None]


def depth_at(
    depth: Float[np.ndarray, "height width"], pixels: Float[np.ndarray, "n 2"], reach: int = 2
) -> Float[np.ndarray, " n"]:
    """Median of the known depths within `reach` pixels [m]; zero where none is known.

    Args:
        depth: Of every pixel [m].
        pixels: Column and row [px].
        reach: Half of the side of the window [px].

    Returns:
        Depths [m].
    """
    height, width = depth.shape
    found = np.zeros(len(pixels))
    for k, (x, y) in enumerate(np.rint(pixels).astype(int)):
        top, left = max(y - reach, 0), max(x - reach, 0)
        window = depth[top : min(y + reach + 1, height), left : min(x + reach + 1, width)]
        known = window[np.isfinite(window) & (window > 0)]
        found[k] = np.median(known) if known.size else 0.0
    return found


def _distorted(camera: Camera, plane: np.ndarray) -> np.ndarray:
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = plane[..., 0], plane[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    across = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    down = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([x * radial + across, y * radial + down], axis=-1)


def _slopes(camera: Camera, plane: np.ndarray):
    """Derivative of `_distorted`, two rows of two arrays."""
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = plane[..., 0], plane[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    rise = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    mixed = x * y * rise + 2 * (p1 * x + p2 * y)
    return (
        (radial + x * x * rise + 2 * p1 * y + 6 * p2 * x, mixed),
        (mixed, radial + y * y * rise + 6 * p1 * y + 2 * p2 * x),
    )


def save_camera(path: str | Path, camera: Camera) -> None:
    """Write a calibration as JSON.

    Args:
        path: File name.
        camera: The calibration.
    """
    Path(path).write_text(json.dumps(camera._asdict(), indent=1))


def load_camera(path: str | Path) -> Camera:
    """Read a calibration.

    Args:
        path: File name.

    Returns:
        The camera.

    Raises:
        ValueError: If the file does not hold a camera.
    """
    try:
        record = json.loads(Path(path).read_text())
        record["distortion"] = tuple(float(k) for k in record["distortion"])
        camera = Camera(**record)
        numbers = [*camera[:4], *camera.distortion, camera.width, camera.height]
        fine = len(numbers) == 11 and bool(np.all(np.isfinite(np.array(numbers, float))))
        fine = fine and min(camera.fx, camera.fy, camera.width) > 0
    except (KeyError, TypeError, ValueError, UnicodeDecodeError):
        fine = False
    if not fine:
        raise ValueError(
            f"load_camera: {path} holds no camera, need what `save_camera` wrote. Calibrate "
            "again."
        )
    return camera


# OpenCV, loaded where an image is looked at.


@functools.cache
def opencv() -> Any:
    """The module `cv2`.

    Raises:
        ImportError: If it is not installed.
    """
    try:
        import cv2
    except ImportError as missing:
        raise ImportError(
            "sorojax.vision: need OpenCV. pip install 'sorojax[vision]'"
        ) from missing
    return cv2


def marker_words(where: str, dictionary: str) -> Any:
    """The ArUco dictionary of that name.

    Raises:
        ValueError: If OpenCV has no such one.
    """
    aruco = opencv().aruco
    code = getattr(aruco, f"DICT_{dictionary.upper()}", None)
    if code is None:
        names = [name[5:] for name in dir(aruco) if name.startswith("DICT_")]
        raise ValueError(
            f"{where}: got dictionary {dictionary!r}, need one of {', '.join(names)}."
        )
    return aruco.getPredefinedDictionary(code)
