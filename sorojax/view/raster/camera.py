"""Cameras of solid pictures: presets, paths, and projection to pixels."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

_PRESETS = {
    "iso": (-55.0, 25.0),
    "front": (-90.0, 0.0),
    "back": (90.0, 0.0),
    "left": (180.0, 0.0),
    "right": (0.0, 0.0),
    "top": (-90.0, 90.0),
    "bottom": (-90.0, -90.0),
}


@dataclass(frozen=True)
class Camera:
    """A view of the whole scene from outside; z is up, so nothing is cut by a near plane.

    Attributes:
        azimuth: Of the eye about z, from x [deg].
        elevation: Of the eye above the plane of x and y [deg].
        zoom: 1 fits the scene, more cuts its border.
        opening: Angle of view [deg]; 0 draws parallel lines parallel.
    """

    azimuth: float = -55.0
    elevation: float = 25.0
    zoom: float = 1.0
    opening: float = 24.0

    def __post_init__(self):
        if not 0 <= self.opening < 120 or self.zoom <= 0:
            raise ValueError(
                f"Camera: got opening={self.opening} deg and zoom={self.zoom}, need an opening "
                "of 0 to 120 deg and a positive zoom. Leave them out for the usual view."
            )

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Right, up and towards the eye, as rows."""
        a, e = np.deg2rad(self.azimuth), np.deg2rad(self.elevation)
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        back = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        return np.stack([right, np.cross(back, right), back])


View = str | Camera | Callable[[float], Camera]


def camera_at(view: View, share: float = 0.0) -> Camera:
    """The camera of a preset, or of a path at `share` in [0, 1] of a film.

    Raises:
        ValueError: If there is no preset of that name.
    """
    if isinstance(view, Camera):
        return view
    if callable(view):
        return view(share)
    if view not in _PRESETS:
        raise ValueError(
            f"camera: got {view!r}, need one of {', '.join(_PRESETS)} or a Camera."
        )
    return Camera(*_PRESETS[view])


def orbit(start: str | Camera = "iso", *, turns: float = 1.0) -> Callable[[float], Camera]:
    """A path about the z axis, `turns` times round in a film.

    Args:
        start: Camera or preset at the start.
        turns: Full turns [-].

    Returns:
        A function of the share of the film in [0, 1].
    """
    first = camera_at(start)
    return lambda share: replace(first, azimuth=first.azimuth + 360.0 * turns * share)


def between(first: str | Camera, last: str | Camera) -> Callable[[float], Camera]:
    """A path from one view to another, slow at both ends.

    Args:
        first: Camera or preset at the start.
        last: At the end.

    Returns:
        A function of the share of the film in [0, 1].
    """
    a, b = camera_at(first), camera_at(last)

    def at(share: float) -> Camera:
        s = share * share * (3 - 2 * share)
        names = ("azimuth", "elevation", "zoom", "opening")
        return Camera(*((1 - s) * getattr(a, n) + s * getattr(b, n) for n in names))

    return at


@dataclass(frozen=True)
class Lens:
    """A camera in front of a scene: takes points [m] to pixels and depths."""

    camera: Camera
    centre: Float[np.ndarray, "3"]
    distance: float
    size: tuple[int, int]
    scale: float
    shift: Float[np.ndarray, "2"]

    def raw(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Image plane and depth; the depth is monotonous and straight over a triangle."""
        seen = (np.asarray(points, float) - self.centre) @ self.camera.axes.T
        if not self.camera.opening:
            return np.concatenate([seen[:, :2], -seen[:, 2:]], axis=1)
        away = self.distance - seen[:, 2:]
        flat = seen[:, :2] * self.distance / away
        return np.concatenate([flat, self.distance * (1 - self.distance / away)], axis=1)

    def __call__(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Pixels from the upper left corner, right and down, and the depth [m]."""
        raw = self.raw(points)
        flat = raw[:, :2] * self.scale * np.array([1.0, -1.0]) + self.shift
        return np.concatenate([flat, raw[:, 2:]], axis=1)

    def share(self, depth: np.ndarray) -> np.ndarray:
        """Inverse distance of a depth, up to a factor: what perspective weighs with."""
        if not self.camera.opening:
            return np.ones_like(depth)
        return 1.0 - depth / self.distance


def fit(
    camera: Camera,
    points: Float[np.ndarray, "points 3"],
    size: tuple[int, int],
    margin: float = 0.04,
) -> Lens:
    """The camera so far away and so turned aside that `points` fill the picture."""
    points = np.asarray(points, float)
    lower, upper = points.min(axis=0), points.max(axis=0)
    centre, radius = (lower + upper) / 2, max(float(np.linalg.norm(upper - lower)) / 2, 1e-9)
    distance = 1.15 * radius / np.sin(np.deg2rad(max(camera.opening, 1e-3)) / 2)
    lens = Lens(camera, centre, distance, size, 1.0, np.zeros(2))
    flat = lens.raw(points)[:, :2]
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = np.array(size) * (1 - 2 * margin)
    span = np.maximum(high - low, 1e-6 * radius)
    scale = camera.zoom * float(np.min(room / span))
    middle = (low + high) / 2 * np.array([1.0, -1.0])
    return replace(lens, scale=scale, shift=np.array(size) / 2 - scale * middle)


def box_corners(lower: np.ndarray, upper: np.ndarray) -> Float[np.ndarray, "8 3"]:
    """The corners of a box."""
    grid = np.meshgrid(*zip(lower, upper, strict=True), indexing="ij")
    return np.stack([axis.ravel() for axis in grid], axis=1)
