"""A solid scene as a picture: light, colours, thin lines, smooth edges; NumPy alone."""

import numpy as np
from jaxtyping import Float, UInt8

from sorojax.view.camera import Lens
from sorojax.view.raster import Seen, barycentric, rasterise
from sorojax.view.scene import Scene, Surface
from sorojax.view.soup import Soup, painted, soup_of

_KEY = np.array([-0.45, 0.62, 0.65])  # right, up, towards the eye
_FILL = np.array([0.70, 0.10, 0.55])
_INK = np.array([0.12, 0.14, 0.19], np.float32)
_SHINE, _SHARP = 0.10, 24


def shade(
    scene: Scene, lens: Lens, *, samples: int = 2, dots_per_point: float = 1.4
) -> UInt8[np.ndarray, "height width 3"]:
    """The scene through `lens` on white paper.

    Args:
        scene: Of dimension 3.
        lens: From `camera.fit`.
        samples: Per pixel and direction; 2 smooths edges.
        dots_per_point: Pixels that a point of print has.
    """
    width, height = lens.size[0] * samples, lens.size[1] * samples
    fine = Lens(lens.camera, lens.centre, lens.distance, (width, height),
                lens.scale * samples, lens.shift * samples)  # fmt: skip
    numbered = list(enumerate(scene.parts))
    clear = [pair for pair in numbered if isinstance(pair[1], Surface) and pair[1].opacity < 1]
    solid = [pair for pair in numbered if pair not in clear]
    points = dots_per_point * samples
    soup = soup_of(solid, fine, points)
    seen = rasterise(soup.pixels, width, height)
    picture = np.ones((height * width, 3), np.float32)
    _paint(picture, soup, seen, fine, scene, np.ones(1), points)
    _outline(picture, soup, seen, samples)
    if clear:
        soup = soup_of(clear, fine, points)
        above = rasterise(soup.pixels, width, height)
        shown = above.triangle.copy()
        shown[above.depth > seen.depth] = -1
        above = Seen(shown, above.depth)
        opacity = np.array([getattr(part, "opacity", 1.0) for part in scene.parts])
        _paint(picture, soup, above, fine, scene, opacity, points)
    picture = picture.reshape(height, width, 3)
    if samples > 1:
        parts = [
            picture[a::samples, b::samples] for a in range(samples) for b in range(samples)
        ]
        picture = sum(parts[1:], parts[0]) / np.float32(samples**2)
    return (255 * np.clip(picture, 0, 1) + 0.5).astype(np.uint8)


def _paint(picture, soup: Soup, seen: Seen, lens: Lens, scene: Scene, opacity, points) -> None:
    """Light what is seen; surfaces that are clear are mixed with what is below."""
    flat = seen.triangle.ravel()
    pixel = np.flatnonzero(flat >= 0)
    if not len(pixel):
        return
    triangle = flat[pixel]
    row, column = np.divmod(pixel, lens.size[0])
    shares = barycentric(soup.pixels, triangle, column, row)
    if lens.camera.opening:
        weights = lens.share(soup.pixels[:, :, 2]).astype(np.float32)
        in_space = [share * weights[triangle, k] for k, share in enumerate(shares)]
        total = in_space[0] + in_space[1] + in_space[2]
        in_space = [share / total for share in in_space]
    else:
        in_space = shares
    colour = painted(soup, triangle, in_space, scene.scale)
    colour = _lit(colour, soup, triangle, in_space, lens.camera.axes)
    colour = _wired(colour, soup, triangle, shares, 0.45 * points)
    if len(opacity) > 1:
        share = opacity[soup.part[triangle].astype(int)][:, None].astype(np.float32)
        colour = share * colour + (1 - share) * picture[pixel]
    picture[pixel] = colour


def _lit(colour, soup: Soup, triangle, shares, axes) -> Float[np.ndarray, "n 3"]:
    """Two lamps that move with the eye; both sides of a surface are lit."""
    turned = (soup.normals @ axes.T).astype(np.float32)
    x, y, z = (sum(shares[c] * turned[:, c, k][triangle] for c in range(3)) for k in range(3))
    size = np.sqrt(x * x + y * y + z * z)
    size = np.where(z < 0, -1, 1) / np.maximum(size, np.float32(1e-12))
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
        light = np.where(lit[triangle], light, np.float32(1.0))
        gleam = np.where(lit[triangle], gleam, np.float32(0.0))
    colour = colour * light[:, None]
    colour += gleam[:, None]
    return np.minimum(colour, np.float32(1.0), out=colour)


def _each(table: Float[np.ndarray, " triangles"], triangle):
    """The number of every sample's triangle; one number where all are equal."""
    return table[0] if np.all(table == table[0]) else table[triangle]


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
        away = np.abs(shares[(k + 2) % 3] * high[triangle, k])
        nearest = np.fmin(nearest, away)
    ink = np.clip(np.float32(width / 2 + 0.5) - nearest, 0, 1)
    strength = (0.55 * np.clip(most / (6 * width), 0.15, 1)).astype(np.float32)
    ink = (ink * strength[triangle])[:, None]
    return colour * (1 - ink) + _INK * ink


def _outline(picture, soup: Soup, seen: Seen, samples: int) -> None:
    """Dark lines where a lit surface stands in front of paper or of something far behind."""
    found = seen.triangle
    if not len(soup.lit) or not np.any(found >= 0):
        return
    lit = soup.lit[found] > 0
    lit &= found >= 0
    depth = np.where(lit, seen.depth, np.inf).astype(np.float32)
    inside = depth[lit]
    if not len(inside):
        return
    jump = np.float32(0.04 * max(float(inside.max() - inside.min()), 1e-12))
    covered = (found >= 0) & ~lit  # a line in front leaves no edge
    edge = np.zeros(lit.shape, bool)
    whole, ahead, behind = slice(None), slice(1, None), slice(None, -1)
    for mine, other in (
        ((ahead, whole), (behind, whole)), ((behind, whole), (ahead, whole)),
        ((whole, ahead), (whole, behind)), ((whole, behind), (whole, ahead)),
    ):  # fmt: skip
        edge[mine] |= (depth[other] > depth[mine] + jump) & ~covered[other]
    where = np.flatnonzero(edge & lit)
    strength = np.float32(0.55 if samples > 1 else 0.45)
    picture[where] = (1 - strength) * picture[where] + strength * _INK
