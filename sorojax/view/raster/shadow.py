"""Cast shadows by a shadow map (Williams, SIGGRAPH 1978), softened over its pixels (percentage
closer, Reeves, Salesin and Cook, SIGGRAPH 1987).

A picture from the lamp, along parallel rays, holds how far light gets; what a sample of the
picture sees is in shadow where it lies behind that.
"""

import numpy as np
from jaxtyping import Float, Int

from sorojax.view.raster.camera import Camera, Lens, fit
from sorojax.view.raster.raster import KEY, rasterise, soup_of
from sorojax.view.raster.scene import Lines, Part, Scene, corners_of

_SIZE = 1400  # pixels across the map
_SOFT = 3  # half width of the softened edge [pixels of the map]
# Depth that does not count as behind [pixels of the map]: what a face that is lit at 54
# degrees from its normal rises over the width of the softened edge.
_BIAS = 7.0


def lamp_of(camera: Camera) -> Camera:
    """The first lamp of a picture as a camera with parallel rays."""
    x, y, z = KEY / np.linalg.norm(KEY) @ camera.axes
    azimuth, elevation = np.rad2deg([np.arctan2(y, x), np.arcsin(z)])
    return Camera(float(azimuth), float(elevation), opening=0.0)


def in_shadow(
    scene: Scene,
    lens: Lens,
    depth: Float[np.ndarray, "height width"],
) -> Float[np.ndarray, " samples"]:
    """Share of the light of the lamp that does not reach what is seen, row by row.

    Args:
        scene: Its opaque surfaces, arrows and dots keep light off; lines do not.
        lens: Of the picture.
        depth: Of what is seen at every pixel of `lens`; infinite where there is nothing.
    """
    shade = np.zeros(depth.size, np.float32)
    solid: list[tuple[int, Part]] = [
        (k, part)
        for k, part in enumerate(scene.parts)
        if not isinstance(part, Lines) and getattr(part, "opacity", 1.0) == 1
    ]
    solid = [(k, part) for k, part in solid if len(corners_of(part))]
    seen = np.flatnonzero(np.isfinite(depth.ravel()))
    if not solid or not len(seen):
        return shade
    points = np.concatenate([corners_of(part) for _, part in solid])
    points = points[np.all(np.isfinite(points), axis=1)]
    lamp = fit(lamp_of(lens.camera), points, (_SIZE, _SIZE))
    reached = rasterise(soup_of(solid, lamp, 1.0).pixels, *lamp.size).depth
    places = lamp(_places(lens, seen, depth.ravel()[seen]))
    shade[seen] = _behind(reached, places, _BIAS / lamp.scale)
    return shade


def _places(
    lens: Lens, pixel: Int[np.ndarray, " n"], depth: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Points [m] that pixels of these depths show: `Lens.raw` backwards."""
    row, column = np.divmod(pixel, lens.size[0])
    right = (column + 0.5 - lens.shift[0]) / lens.scale
    up = (lens.shift[1] - row - 0.5) / lens.scale
    if lens.camera.opening:
        away = lens.distance / (1 - depth / lens.distance)
        right, up = right * away / lens.distance, up * away / lens.distance
        depth = away - lens.distance
    return lens.centre + np.stack([right, up, -depth], axis=1) @ lens.camera.axes


def _behind(
    reached: Float[np.ndarray, "height width"], places: Float[np.ndarray, "n 3"], bias: float
) -> Float[np.ndarray, " n"]:
    """Share of the pixels around each place where light ends before it."""
    high, wide = reached.shape
    total = np.zeros(len(places), np.float32)
    steps = range(-_SOFT, _SOFT + 1, 2)
    for down in steps:
        row = np.clip(places[:, 1] + down, 0, high - 1).astype(np.intp)
        for aside in steps:
            column = np.clip(places[:, 0] + aside, 0, wide - 1).astype(np.intp)
            total += places[:, 2] - bias > reached[row, column]
    return total / np.float32(len(steps) ** 2)
