"""Pictures with known answers: discs, markers, boards and balls, with blur and noise."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sorojax.vision.camera import Camera, Pose, marker_words, opencv, project, rays
from sorojax.vision.discs import Image
from sorojax.vision.fiducials import marker_corners

#: Blue, green, red of discs that the colours RED, GREEN and BLUE find.
PAINTS = ((40.0, 40.0, 210.0), (45.0, 190.0, 50.0), (205.0, 70.0, 40.0))


class Disturbance(NamedTuple):
    """Errors of lens and sensor, standard deviations: `blur` [px] and `noise` [grey levels]."""

    blur: float = 0.8
    noise: float = 4.0


def background(width: int, height: int) -> Float[np.ndarray, "height width 3"]:
    """A dim, uneven grey.

    Args:
        width: Of the canvas [px].
        height: Of the canvas [px].

    Returns:
        A canvas to draw on.
    """
    x, y = np.arange(width), np.arange(height)[:, None]
    grey = 110 + 25 * np.sin(x / 190) + 12 * np.cos(y / 130)
    return np.repeat(grey[..., None], 3, axis=2)


def draw_discs(
    canvas: Float[np.ndarray, "height width 3"],
    centres: Float[np.ndarray, "n 2"],
    radius: Float[np.ndarray, " n"],
    colour: Int[np.ndarray, " n"],
    fine: int = 8,
) -> Float[np.ndarray, "height width 3"]:
    """Discs on a canvas, edges covered to 1 / `fine`^2 of a pixel.

    Args:
        canvas: Blue, green, red, 0 to 255.
        centres: Column and row [px].
        radius: Of each disc [px].
        colour: Number of the colour of each disc.
        fine: Samples per pixel and direction.

    Returns:
        The canvas.
    """
    canvas = canvas.copy()
    for (x, y), r, kind in zip(centres, radius, colour, strict=True):
        x0, y0, side = int(np.floor(x - r)) - 2, int(np.floor(y - r)) - 2, 2 * int(r) + 6
        if x0 + side <= 0 or y0 + side <= 0 or x0 >= canvas.shape[1] or y0 >= canvas.shape[0]:
            continue
        at = (np.arange(side * fine) + 0.5) / fine - 0.5
        inside = (x0 + at[None] - x) ** 2 + (y0 + at[:, None] - y) ** 2 < r * r
        part = inside.reshape(side, fine, side, fine).mean(axis=(1, 3))[..., None]
        top, left = max(-y0, 0), max(-x0, 0)
        target = canvas[y0 + top : y0 + side, x0 + left : x0 + side]
        part = part[top : top + target.shape[0], left : left + target.shape[1]]
        target[:] = target * (1 - part) + np.array(PAINTS[int(kind)]) * part
    return canvas


def draw_plane(
    canvas: Float[np.ndarray, "height width 3"],
    camera: Camera,
    pose: Pose,
    picture: np.ndarray,
    size: tuple[float, float],
    fine: int = 4,
) -> Float[np.ndarray, "height width 3"]:
    """A flat grey picture of `size` [m] in space, as the camera sees it.

    The picture's middle is the origin of `pose`, x to its right, y up. Exact: every sample
    of a pixel is followed back to the plane, distortion included.

    Args:
        canvas: Blue, green, red, 0 to 255.
        camera: Its calibration.
        pose: Of the plane in the camera frame.
        picture: Grey levels.
        size: Width and height [m].
        fine: Samples per pixel and direction.

    Returns:
        The canvas.
    """
    outline = project(camera, pose.apply(marker_corners(1.0) * [*size, 0]))
    x0, y0 = np.clip(np.floor(outline.min(axis=0)) - 1, 0, None).astype(int)
    x1, y1 = np.minimum(np.ceil(outline.max(axis=0)) + 2, canvas.shape[1::-1]).astype(int)
    canvas = canvas.copy()
    if x1 <= x0 or y1 <= y0:
        return canvas
    part = (np.arange(fine) + 0.5) / fine - 0.5
    x, y = (np.add.outer(np.arange(a, b), part).ravel() for a, b in ((x0, x1), (y0, y1)))
    ray = rays(camera, np.stack(np.meshgrid(x, y), axis=-1))
    ray = np.concatenate([ray, np.ones_like(ray[..., :1])], axis=-1) @ pose.rotation
    origin = pose.rotation.T @ -pose.translation
    there = origin[:2] - ray[..., :2] * (origin[2] / ray[..., 2])[..., None]
    rows, columns = picture.shape[:2]
    u = np.floor((there[..., 0] / size[0] + 0.5) * columns).astype(int)
    v = np.floor((0.5 - there[..., 1] / size[1]) * rows).astype(int)
    inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    value = picture[np.clip(v, 0, rows - 1), np.clip(u, 0, columns - 1)].astype(float)
    window = canvas[y0:y1, x0:x1]
    shape = (y1 - y0, fine, x1 - x0, fine)
    cover = inside.reshape(shape).mean(axis=(1, 3))[..., None]
    ink = np.where(inside, value, 0.0).reshape(shape).mean(axis=(1, 3))[..., None]
    window[:] = window * (1 - cover) + ink
    return canvas


def fiducial_picture(number: int, dictionary: str = "6X6_250") -> np.ndarray:
    """A marker with a quiet zone of one square around it: 10 by 10 squares for 6X6.

    Args:
        number: Of the marker.
        dictionary: Name in OpenCV without `DICT_`.

    Returns:
        Grey levels.
    """
    words = marker_words("fiducial_picture", dictionary)
    side = words.markerSize + 2
    picture = opencv().aruco.generateImageMarker(words, number, side, borderBits=1)
    return np.pad(picture, 1, constant_values=255)


def photograph(
    canvas: Float[np.ndarray, "height width 3"],
    disturbance: Disturbance,
    random: np.random.Generator,
) -> Image:
    """The image that a sensor makes of a canvas.

    Args:
        canvas: Blue, green, red, 0 to 255.
        disturbance: Blur and noise.
        random: Source of the noise.

    Returns:
        The image.
    """
    cv2 = opencv()
    if disturbance.blur > 0:
        canvas = cv2.GaussianBlur(canvas, (0, 0), disturbance.blur)
    noisy = canvas + disturbance.noise * random.standard_normal(canvas.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


# A robot before a camera: balls in space, in colour and depth, near ones before far ones.


#: Blue, green, red of what no colour of a marker finds: a body, or something in the way.
DULL = (72.0, 70.0, 68.0)


class Balls(NamedTuple):
    """Balls in the camera frame: markers, or in a row a body, or what hides them.

    Attributes:
        centre: Where [m].
        radius: How large [m].
        paint: Which of `PAINTS`; `DULL` where negative.
    """

    centre: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, " n"]
    paint: Int[np.ndarray, " n"]


def draw_balls(
    canvas: Float[np.ndarray, "height width 3"], camera: Camera, balls: Balls, fine: int = 4
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"]]:
    """The canvas with balls in front of it, and the depth of their surfaces along the optical
    axis [m], zero where there is none.

    Rays of `fine`^2 samples a pixel meet the balls exactly, distortion included. Balls hide
    each other in the order of their distances.

    Args:
        canvas: Blue, green, red, 0 to 255.
        camera: Its calibration.
        balls: Centres [m], radii [m] and colours.
        fine: Samples per pixel and direction.

    Returns:
        The canvas, and the depth of every pixel [m].
    """
    canvas, depth = canvas.copy(), np.full(canvas.shape[:2], np.inf)
    part = (np.arange(fine) + 0.5) / fine - 0.5
    for k in np.argsort(-balls.centre[:, 2], kind="stable"):
        centre, radius = np.asarray(balls.centre[k], float), float(balls.radius[k])
        window = _window(camera, centre, radius, canvas.shape)
        if window is None:
            continue
        (x0, x1), (y0, y1) = window
        x, y = (np.add.outer(np.arange(a, b), part).ravel() for a, b in window)
        near = _surface(rays(camera, np.stack(np.meshgrid(x, y), axis=-1)), centre, radius)
        near = near.reshape(y1 - y0, fine, x1 - x0, fine).swapaxes(1, 2)
        near = near.reshape(y1 - y0, x1 - x0, fine * fine)
        hit = np.isfinite(near)
        cover, paint = hit.mean(axis=2)[..., None], int(balls.paint[k])
        ink = np.array(DULL if paint < 0 else PAINTS[paint])
        seen = canvas[y0:y1, x0:x1]
        seen[:] = seen * (1 - cover) + ink * cover
        # a pixel has the depth of what fills most of it
        mean = np.where(hit, near, 0.0).sum(axis=2) / np.maximum(hit.sum(axis=2), 1)
        behind = depth[y0:y1, x0:x1]
        behind[:] = np.where(cover[..., 0] >= 0.5, np.minimum(mean, behind), behind)
    return canvas, np.where(np.isfinite(depth), depth, 0.0)


def _window(camera: Camera, centre, radius: float, shape):
    """Columns and rows that a ball can reach, or None if it is out of sight."""
    if centre[2] <= radius:
        return None
    place = project(camera, centre)
    # seen askew a ball is long: by the cosine twice
    long = 1 + float(centre[:2] @ centre[:2]) / centre[2] ** 2
    reach = 1.2 * max(camera.fx, camera.fy) * radius / (centre[2] - radius) * long + 2
    spans = []
    for at, most in zip(place, (shape[1], shape[0]), strict=True):
        low, high = max(int(np.floor(at - reach)), 0), min(int(np.ceil(at + reach)) + 1, most)
        if low >= high:
            return None
        spans.append((low, high))
    return spans


def _surface(plane, centre, radius: float) -> np.ndarray:
    """Depth at which rays (x/z, y/z, 1) first meet a ball, NaN where they do not."""
    along = plane @ centre[:2] + centre[2]
    square = np.sum(plane**2, axis=-1) + 1
    under = along**2 - square * (centre @ centre - radius**2)
    return (along - np.sqrt(np.where(under >= 0, under, np.nan))) / square
