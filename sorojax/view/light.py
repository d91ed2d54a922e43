"""What a pixel looks like: the colour of the triangle that it sees, light, lines of cells."""

import numpy as np
from jaxtyping import Float, Int

from sorojax.view.camera import Lens
from sorojax.view.raster import barycentric
from sorojax.view.scene import Scale
from sorojax.view.soup import Soup, painted

INK = np.array([0.12, 0.14, 0.19], np.float32)
_KEY = np.array([-0.45, 0.62, 0.65])  # right, up, towards the eye
_FILL = np.array([0.70, 0.10, 0.55])
_SHINE = 0.10


def lit_colour(
    soup: Soup,
    lens: Lens,
    scale: Scale | None,
    triangle: Int[np.ndarray, " n"],
    pixel: Int[np.ndarray, " n"],
    wire: float,
) -> Float[np.ndarray, "n 3"]:
    """Red, green and blue of pixels that see `triangle`.

    Args:
        soup: Loose triangles, in pixels of `lens`.
        lens: Of the picture.
        scale: Of values.
        triangle: What each pixel sees.
        pixel: Their numbers, row by row.
        wire: Width of the sides of cells [pixels].
    """
    row, column = np.divmod(pixel, lens.size[0])
    shares = barycentric(soup.pixels, triangle, column, row)
    in_space = shares
    if lens.camera.opening:
        weights = lens.share(soup.pixels[:, :, 2]).astype(np.float32)
        in_space = [share * weights[:, k].take(triangle) for k, share in enumerate(shares)]
        total = in_space[0] + in_space[1] + in_space[2]
        in_space = [share / total for share in in_space]
    colour = painted(soup, triangle, in_space, scale)
    colour = _lit(colour, soup, triangle, in_space, lens.camera.axes)
    return _wired(colour, soup, triangle, shares, wire)


def _lit(colour, soup: Soup, triangle, shares, axes) -> Float[np.ndarray, "n 3"]:
    """Two lamps that move with the eye; both sides of a surface are lit."""
    turned = (soup.normals @ axes.T).astype(np.float32)
    x, y, z = (
        sum(shares[c] * turned[:, c, k].take(triangle) for c in range(3)) for k in range(3)
    )
    size = np.sqrt(x * x + y * y + z * z)
    size = np.where(z < 0, np.float32(-1), np.float32(1)) / np.maximum(size, np.float32(1e-12))
    normal = (x * size, y * size, z * size)
    key, fill = _KEY / np.linalg.norm(_KEY), _FILL / np.linalg.norm(_FILL)
    half = key + np.array([0, 0, 1.0])
    bright, weak = _facing(normal, key), _facing(normal, fill)
    gleam = _facing(normal, half / np.linalg.norm(half))
    gleam = gleam**2
    gleam = gleam**2
    gleam = gleam**2
    gleam = np.float32(_SHINE) * gleam * gleam * gleam  # to the power 24
    valued, lit = np.isfinite(soup.values[:, 0]), soup.lit > 0

    def weight(coloured: float, plain: float):
        return _each(np.where(valued, coloured, plain).astype(np.float32), triangle)

    light = weight(0.72, 0.42) + weight(0.24, 0.52) * bright + weight(0.10, 0.16) * weak
    gleam *= weight(0.4, 1.0)
    if not np.all(lit):
        shown = lit.take(triangle)
        light = np.where(shown, light, np.float32(1.0))
        gleam = np.where(shown, gleam, np.float32(0.0))
    colour = colour * light[:, None]
    colour += gleam[:, None]
    return np.minimum(colour, np.float32(1.0), out=colour)


def _each(table: Float[np.ndarray, " triangles"], triangle):
    """The number of every sample's triangle; one number where all are equal."""
    return table[0] if np.all(table == table[0]) else table.take(triangle)


def _facing(normal, lamp) -> np.ndarray:
    x, y, z = (np.float32(a) * n for a, n in zip(lamp, normal, strict=True))
    return np.maximum(x + y + z, np.float32(0.0))


def _wired(colour, soup: Soup, triangle, shares, width: float) -> Float[np.ndarray, "n 3"]:
    """Sides of cells as lines of `width` pixels, fainter where cells are tiny."""
    if not np.any(soup.wire):
        return colour
    corners = soup.pixels[:, :, :2]
    sides = np.stack([corners[:, (k + 1) % 3] - corners[:, k] for k in range(3)], axis=1)
    area = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    high = area[:, None] / np.maximum(np.linalg.norm(sides, axis=2), 1e-9)
    most = high.max(axis=1)
    high = np.where(soup.wire > 0, high, 1e12).astype(np.float32)
    nearest = np.full(len(triangle), np.inf, np.float32)
    for k in range(3):  # side k is opposite to the corner k + 2
        away = np.abs(shares[(k + 2) % 3] * high[:, k].take(triangle))
        nearest = np.fmin(nearest, away)
    ink = np.clip(np.float32(width / 2 + 0.5) - nearest, 0, 1)
    strength = (0.55 * np.clip(most / (6 * width), 0.15, 1)).astype(np.float32)
    ink = (ink * strength.take(triangle))[:, None]
    return colour * (1 - ink) + INK * ink
