"""A solid scene as a picture with smooth edges; NumPy alone.

Which triangle is seen is found for every sample of every pixel. Light is dear and changes
slowly, so it is worked out once per pixel, and for all samples only where they differ.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from sorojax.view.camera import Lens
from sorojax.view.light import INK, lit_colour
from sorojax.view.raster import Seen, rasterise
from sorojax.view.scene import Part, Scene, Surface
from sorojax.view.soup import Soup, soup_of

_STEP = 0.02  # of red, green or blue between pixels: from there on all samples are lit
_FAR = 0.04  # of the depth of the scene: from there on a nearer surface has an outline


class _Layer(NamedTuple):
    """Triangles with the samples that see them; of each part its share of the colour."""

    soup: Soup
    triangle: Int[np.ndarray, " samples"]
    edge: Bool[np.ndarray, " samples"]
    opacity: Float[np.ndarray, " parts"] | None = None


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
    width, height = lens.size
    fine = Lens(lens.camera, lens.centre, lens.distance, (width * samples, height * samples),
                lens.scale * samples, lens.shift * samples)  # fmt: skip
    points = dots_per_point * samples
    layers = _layers(scene, fine, points)

    def lit(at: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        return _colours(layers, at, scene, fine, points, samples)

    row = width * samples * np.arange(samples)
    within = (row[:, None] + np.arange(samples)).ravel()
    row = width * samples**2 * np.arange(height)
    first = (row[:, None] + samples * np.arange(width)).ravel()
    picture = lit(first)
    if samples > 1:
        rough = np.flatnonzero(_rough(layers, picture, lens.size, samples))
        every = lit((first[rough, None] + within).ravel()).reshape(-1, samples**2, 3)
        picture[rough] = np.add.reduce(every, axis=1) / np.float32(samples**2)
    picture = picture.reshape(height, width, 3)
    return (255 * np.clip(picture, 0, 1) + 0.5).astype(np.uint8)


def _layers(scene: Scene, lens: Lens, points: float) -> list[_Layer]:
    """What is opaque, and before it what is clear."""
    numbered: list[tuple[int, Part]] = list(enumerate(scene.parts))
    clear = [pair for pair in numbered if isinstance(pair[1], Surface) and pair[1].opacity < 1]
    solid = [pair for pair in numbered if pair not in clear]
    soup = soup_of(solid, lens, points)
    seen = rasterise(soup.pixels, *lens.size)
    layers = [_Layer(soup, seen.triangle.ravel(), _outlined(soup, seen).ravel())]
    if clear:
        soup = soup_of(clear, lens, points)
        above = rasterise(soup.pixels, *lens.size)
        shown = np.where(above.depth > seen.depth, -1, above.triangle).ravel()
        opacity = [getattr(part, "opacity", 1.0) for part in scene.parts]
        none = np.zeros(shown.shape, bool)
        layers.append(_Layer(soup, shown, none, np.array(opacity, np.float32)))
    return layers


def _colours(layers, at, scene: Scene, lens: Lens, points: float, samples: int):
    """Red, green and blue of the samples `at`: every layer over the one below."""
    colours = np.ones((len(at), 3), np.float32)
    for soup, seen, edge, opacity in layers:
        triangle = seen.take(at)
        hit = np.flatnonzero(triangle >= 0)
        if not len(hit):
            continue
        triangle = triangle.take(hit).astype(np.intp)
        found = lit_colour(soup, lens, scene.scale, triangle, at.take(hit), 0.45 * points)
        if opacity is not None:
            share = opacity.take(soup.part.take(triangle).astype(int))[:, None]
            found = share * found + (1 - share) * colours[hit]
        colours[hit] = found
        inked = np.flatnonzero(edge.take(at))
        strength = np.float32(0.55 if samples > 1 else 0.45)
        colours[inked] = (1 - strength) * colours[inked] + strength * INK
    return colours


def _rough(layers, picture, size: tuple[int, int], samples: int) -> Bool[np.ndarray, "h w"]:
    """Pixels whose samples see different parts or an outline, or which differ from the next."""
    width, height = size
    rough = np.zeros((height, width), bool)
    for soup, triangle, edge, _ in layers:
        part = np.append(soup.part, -1).astype(np.int16).take(triangle)  # -1 takes the last
        for whole, differ in ((part, np.not_equal), (edge, np.logical_or)):
            block = whole.reshape(height, samples, width, samples)
            first = block[:, 0, :, 0]
            for k in range(1, samples**2):
                rough |= differ(block[:, k // samples, :, k % samples], first)
    shown = picture.reshape(height, width, 3)
    for after, before in (
        ((slice(1, None),), (slice(None, -1),)),
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
    ):
        step = np.abs(shown[after] - shown[before]).max(axis=2) > _STEP
        rough[after] |= step
        rough[before] |= step
    return rough


def _outlined(soup: Soup, seen: Seen) -> Bool[np.ndarray, "height width"]:
    """Where a lit surface stands in front of paper or of something far behind."""
    found = seen.triangle
    edge = np.zeros(found.shape, bool)
    depth, covered = seen.depth.astype(np.float32), None
    if not np.all(soup.lit):
        lit = np.append(soup.lit, 0).take(found) > 0
        covered = (found >= 0) & ~lit  # a line in front leaves no edge
        depth[~lit] = np.inf
    inside = depth[np.isfinite(depth)]
    if not len(inside):
        return edge
    jump = np.float32(_FAR * max(float(inside.max() - inside.min()), 1e-12))
    whole, ahead, behind = slice(None), slice(1, None), slice(None, -1)
    for mine, other in (
        ((ahead, whole), (behind, whole)), ((behind, whole), (ahead, whole)),
        ((whole, ahead), (whole, behind)), ((whole, behind), (whole, ahead)),
    ):  # fmt: skip
        stands = depth[other] > depth[mine] + jump
        edge[mine] |= stands if covered is None else stands & ~covered[other]
    return edge
