"""A synthetic scene before a camera: balls in space, in colour and depth, nearer ones in
front.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sorojax.vision.camera import Camera, project, rays
from sorojax.vision.synthetic import PAINTS

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
