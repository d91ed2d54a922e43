"""A solid scene as a picture with smooth edges, by a depth buffer over spans of rows; NumPy
alone.

The visible triangle is found for every sample of every pixel. Light is expensive and changes
slowly, so it is computed once per pixel, and for all samples only where they differ.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from sorojax.view.raster.camera import Lens
from sorojax.view.raster.glyphs import arrow_triangles, ball_triangles
from sorojax.view.raster.scene import Arrows, Dots, Lines, Part, Scale, Scene, Surface

_CHUNK = 1 << 17  # pixels looked at in one go: they stay in the cache
_DEPTHS = 1 << 30
_NOTHING = np.iinfo(np.int64).max


class Seen(NamedTuple):
    """The pixels of a picture.

    Attributes:
        triangle: Number of the nearest triangle, -1 where there is none.
        depth: Of that triangle; infinite where there is none.
    """

    triangle: Int[np.ndarray, "height width"]
    depth: Float[np.ndarray, "height width"]


def rasterise(corners: Float[np.ndarray, "triangles 3 3"], width: int, height: int) -> Seen:
    """The nearest triangle at the centre of every pixel.

    Args:
        corners: x to the right and y down [pixels], depth; either way round.
        width: Of the picture [pixels].
        height: Of the picture [pixels].
    """
    buffer = np.full(width * height, _NOTHING, np.int64)
    if not len(corners):
        return Seen(np.full((height, width), -1), np.full((height, width), np.inf))
    corners = np.asarray(corners, float)
    depths = corners[:, :, 2]
    nearest, deepest = float(depths.min()), float(depths.max())
    step = max(deepest - nearest, 1e-12) / _DEPTHS
    spans = _spans(corners, width, height)
    ends = np.cumsum(spans.count)
    start = 0
    while start < len(ends):
        before = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, before + _CHUNK, "right")), start + 1)
        _fill(buffer, spans, slice(start, stop), nearest, step, width)
        start = stop
    triangle = buffer.astype(np.int32)  # the lower half of a key, which is -1 in _NOTHING
    depth = (buffer >> 32).astype(float)
    depth *= step
    depth += nearest
    depth[triangle < 0] = np.inf
    return Seen(triangle.reshape(height, width), depth.reshape(height, width))


class _Spans(NamedTuple):
    """Runs of pixels: triangle, row, first column, length; depth at the first, its slope."""

    triangle: np.ndarray
    row: np.ndarray
    column: np.ndarray
    count: np.ndarray
    depth: np.ndarray
    slope: np.ndarray


def _spans(corners: np.ndarray, width: int, height: int) -> _Spans:
    """The rows of every triangle, cut by its three sides."""
    x, y = corners[:, :, 0] - 0.5, corners[:, :, 1] - 0.5  # a pixel is where its centre is
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    first = np.clip(np.ceil(y.min(axis=1)), 0, height).astype(np.int64)
    last = np.clip(np.floor(y.max(axis=1)), -1, height - 1).astype(np.int64)
    rows = np.where(np.abs(area) > 1e-12, np.maximum(last - first + 1, 0), 0)
    owner = np.repeat(np.arange(len(corners)), rows)
    row = np.arange(len(owner)) - np.repeat(np.cumsum(rows) - rows, rows) + first[owner]
    low, high = np.full(len(owner), -np.inf), np.full(len(owner), np.inf)
    turn = np.where(area > 0, 1.0, -1.0)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        rise = (turn * (y[:, b] - y[:, a]))[owner]
        with np.errstate(divide="ignore", invalid="ignore"):
            lean = ((x[:, b] - x[:, a]) / (y[:, b] - y[:, a]))[owner]
            cut = x[owner, a] + lean * (row - y[owner, a])
        np.minimum(high, np.where(rise > 0, cut, np.inf), out=high)
        np.maximum(low, np.where(rise < 0, cut, -np.inf), out=low)
    column = np.clip(np.ceil(low - 1e-9), 0, width).astype(np.int64)
    end = np.clip(np.floor(high + 1e-9), -1, width - 1).astype(np.int64)
    kept = end >= column
    owner, row, column, end = owner[kept], row[kept], column[kept], end[kept]
    z, with_x, with_y = _plane(x, y, corners[:, :, 2], area)
    depth = z[owner] + with_x[owner] * (column - x[owner, 0])
    depth += with_y[owner] * (row - y[owner, 0])
    return _Spans(owner, row, column, end - column + 1, depth, with_x[owner])


def _plane(x, y, z, area) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth at the first corner and its slopes along a row and down a column."""
    safe = np.where(np.abs(area) > 1e-12, area, 1.0)
    one, two = z[:, 1] - z[:, 0], z[:, 2] - z[:, 0]
    with_x = (one * (y[:, 2] - y[:, 0]) - two * (y[:, 1] - y[:, 0])) / safe
    with_y = (two * (x[:, 1] - x[:, 0]) - one * (x[:, 2] - x[:, 0])) / safe
    return z[:, 0], with_x, with_y


def _fill(buffer, spans: _Spans, part: slice, nearest: float, step: float, width: int) -> None:
    count = spans.count[part]
    along = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    pixel = np.repeat(spans.row[part] * width + spans.column[part], count) + along
    depth = np.repeat((spans.depth[part] - nearest) / step, count)
    depth += np.repeat(spans.slope[part] / step, count) * along
    key = np.clip(depth, 0, _DEPTHS).astype(np.int64) << 32
    key |= np.repeat(spans.triangle[part], count)
    np.minimum.at(buffer, pixel, key)


def barycentric(
    corners: Float[np.ndarray, "triangles 3 3"],
    triangle: Int[np.ndarray, " pixels"],
    column: Int[np.ndarray, " pixels"],
    row: Int[np.ndarray, " pixels"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shares of the three corners of `triangle` at the centres of pixels, in the picture."""
    x, y = corners[:, :, 0], corners[:, :, 1]
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    area = np.where(np.abs(area) > 1e-12, area, 1.0)
    rows = [
        (y[:, 2] - y[:, 0]) / area, (x[:, 0] - x[:, 2]) / area,
        (y[:, 0] - y[:, 1]) / area, (x[:, 1] - x[:, 0]) / area, x[:, 0] - 0.5, y[:, 0] - 0.5,
    ]  # fmt: skip
    table = np.stack(rows).astype(np.float32)
    across = column.astype(np.float32) - table[4][triangle]
    down = row.astype(np.float32) - table[5][triangle]
    second = table[0][triangle] * across + table[1][triangle] * down
    third = table[2][triangle] * across + table[3][triangle] * down
    return np.float32(1.0) - second - third, second, third


# Parts of a scene as loose triangles in pixels, ready for the depth buffer


_CREASE = np.cos(np.deg2rad(35.0))
_HALF_CREASE = np.cos(np.deg2rad(35.0 / 2))  # so close to the mean no two are a crease apart


class Soup(NamedTuple):
    """Loose triangles.

    Attributes:
        pixels: Corners: right, down, depth.
        normals: At the corners, in space.
        values: At the corners, coloured by the scale; NaN where `colour` holds.
        colour: Red, green, blue of each triangle.
        lit: Whether light falls on it.
        wire: Which sides are drawn.
        part: Number of the part that it came from.
    """

    pixels: Float[np.ndarray, "n 3 3"]
    normals: Float[np.ndarray, "n 3 3"]
    values: Float[np.ndarray, "n 3"]
    colour: Float[np.ndarray, "n 3"]
    lit: Float[np.ndarray, " n"]
    wire: Float[np.ndarray, "n 3"]
    part: Float[np.ndarray, " n"]


def soup_of(parts: list[tuple[int, Part]], lens: Lens, dots_per_point: float) -> Soup:
    """All parts as triangles; `dots_per_point` makes pixels of line widths."""
    pieces = [_piece(number, part, lens, dots_per_point) for number, part in parts]
    if not pieces:
        none = np.zeros((0, 3, 3))
        return _loose(0, none, none, none[:, 0])
    return Soup(*(np.concatenate(columns) for columns in zip(*pieces, strict=True)))


def _piece(number: int, part: Part, lens: Lens, dots_per_point: float) -> Soup:
    if isinstance(part, Lines):
        return _ribbons(number, part, lens, part.width * dots_per_point)
    if isinstance(part, Surface):
        return _triangles(number, part, lens)
    reach = dots_per_point / lens.scale
    if isinstance(part, Arrows):
        points, triangles = arrow_triangles(part.starts, part.vectors, 1.1 * reach)
    else:
        assert isinstance(part, Dots)
        points, triangles = ball_triangles(part.points, 0.5 * part.size * reach)
    return _triangles(number, Surface(points, triangles, part.colour), lens)


def _triangles(number: int, part: Surface, lens: Lens) -> Soup:
    points, triangles = np.asarray(part.points, float), np.asarray(part.triangles)
    whole: Any = slice(None)
    if not np.all(np.isfinite(points)):
        whole = np.all(np.isfinite(points[triangles]), axis=(1, 2))
        points = np.nan_to_num(points)
    colour = _colours(part.colour, len(triangles))[whole]
    values = None if part.values is None else part.corner_values[whole]
    wire = None if part.wire is None else np.asarray(part.wire, float)[whole]
    triangles = triangles[whole]
    pixels, normals = lens(points)[triangles], corner_normals(points, triangles)
    return _loose(number, pixels, normals, colour, values, wire)


def _loose(number: int, pixels, normals, colour, values=None, wire=None, lit=True) -> Soup:
    """Triangles of the part `number`; without values or drawn sides if none are given."""
    count = len(pixels)
    values = np.full((count, 3), np.nan) if values is None else values
    wire = np.zeros((count, 3)) if wire is None else wire
    part = np.full(count, float(number))
    return Soup(pixels, normals, values, colour, np.full(count, float(lit)), wire, part)


def corner_normals(points: np.ndarray, triangles: np.ndarray) -> Float[np.ndarray, "n 3 3"]:
    """Normals at the corners: the mean over the triangles around, but those across a
    crease."""
    a, b, c = (points.take(triangles[:, k], axis=0) for k in range(3))
    across = np.cross(b - a, c - a)
    face = across / np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]
    corner = triangles.ravel()
    total = _summed(corner, np.repeat(across, 3, axis=0), len(points))
    mean = _unit(total).take(corner, axis=0)
    turned = np.einsum("tci,ti->tc", mean.reshape(-1, 3, 3), face) < _HALF_CREASE
    sharp = np.zeros(len(points), bool)
    sharp[triangles[turned]] = True
    rows = np.flatnonzero(sharp.take(corner))
    mean[rows] = _beside_creases(
        corner[rows], across.take(rows // 3, axis=0), face.take(rows // 3, axis=0)
    )
    return mean.reshape(-1, 3, 3)


def _beside_creases(corner: np.ndarray, across: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Normals of corners at the points `corner`, of triangles with normals `face` and
    `across` times twice their area; all corners at these points are there."""
    order = np.argsort(corner, kind="stable")
    _, number, valence = np.unique(corner, return_inverse=True, return_counts=True)
    start = np.cumsum(valence) - valence
    repeats = valence[number]
    mine = np.repeat(np.arange(len(corner)), repeats)
    nth = np.arange(len(mine)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    other = order[start[number[mine]] + nth]
    kept = np.einsum("pi,pi->p", face[mine], face[other]) > _CREASE
    total = _summed(mine[kept], across[other[kept]], len(corner))
    none = np.linalg.norm(total, axis=1) == 0
    return np.where(none[:, None], face, _unit(total))


def _summed(where: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    columns = [np.bincount(where, rows[:, k], minlength=count) for k in range(3)]
    return np.stack(columns, axis=1)


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(np.linalg.norm(rows, axis=1), 1e-300)[:, None]


def _ribbons(number: int, part: Lines, lens: Lens, width: float) -> Soup:
    """Lines as strips that face the eye, a little in front of what they lie on."""
    runs = [lens(np.asarray(run)) for run in part.runs if len(run) > 1]
    if not runs:
        runs = [np.zeros((2, 3))]
    starts = np.concatenate([run[:-1] for run in runs])
    ends = np.concatenate([run[1:] for run in runs])
    if part.dashed:
        starts, ends = _dashes(starts, ends, 4 * max(width, 1.0))
    along = (ends - starts) * [1.0, 1.0, 0.0]
    unit = along / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    side = np.cross([0.0, 0.0, 1.0], unit) * max(width, 1.0) / 2
    more = unit * max(width, 1.0) / 2 * (0.0 if part.dashed else 1.0)
    starts, ends = starts - more, ends + more
    quads = np.stack([starts - side, ends - side, ends + side, starts + side], axis=1)
    quads[:, :, 2] -= 1.5 * max(width, 1.0) / lens.scale
    pixels = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    normals = np.broadcast_to(lens.camera.axes[2], pixels.shape)
    return _loose(number, pixels, normals, _colours(part.colour, len(pixels)), lit=False)


def _dashes(starts: np.ndarray, ends: np.ndarray, length: float):
    """Every second stretch of `length` pixels along segments laid end to end."""
    size = np.linalg.norm((ends - starts)[:, :2], axis=1)
    count = np.maximum(np.ceil(size / (2 * length)).astype(int), 1)
    owner = np.repeat(np.arange(len(starts)), count)
    nth = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    first = nth / count[owner]
    last = first + 0.5 / count[owner]
    span = (ends - starts)[owner]
    return starts[owner] + first[:, None] * span, starts[owner] + last[:, None] * span


def _colours(colour, count: int) -> Float[np.ndarray, "n 3"]:
    from matplotlib.colors import to_rgb

    if isinstance(colour, str):
        return np.broadcast_to(np.array(to_rgb(colour)), (count, 3))
    return np.asarray(colour, float)


def painted(soup: Soup, triangle, shares, scale: Scale | None) -> Float[np.ndarray, "pixels 3"]:
    """Colour of every pixel before light falls on it."""
    colour = soup.colour.astype(np.float32).take(triangle, axis=0)
    if scale is None or not np.any(np.isfinite(soup.values)):
        return colour
    values = soup.values.astype(np.float32)
    value = sum(share * values[:, k].take(triangle) for k, share in enumerate(shares))
    table = scale.table()
    step = np.float32(len(table) / (scale.high - scale.low))
    place = (value - np.float32(scale.low)) * step
    known = np.isfinite(place)
    place = np.clip(np.where(known, place, 0), 0, len(table) - 1).astype(np.int32)
    return np.where(known[:, None], table.take(place, axis=0), colour)


# What a pixel looks like: the colour of the triangle that it sees, light, lines of cells


INK = np.array([0.12, 0.14, 0.19], np.float32)
KEY = np.array([-0.45, 0.62, 0.65])  # the first lamp: right, up, towards the eye
_FILL = np.array([0.70, 0.10, 0.55])
_SHINE = 0.10


def lit_colour(
    soup: Soup,
    lens: Lens,
    scale: Scale | None,
    triangle: Int[np.ndarray, " n"],
    pixel: Int[np.ndarray, " n"],
    wire: float,
    dark: Any = 0.0,
) -> Float[np.ndarray, "n 3"]:
    """Red, green and blue of pixels that see `triangle`.

    Args:
        soup: Loose triangles, in pixels of `lens`.
        lens: Of the picture.
        scale: Of values.
        triangle: What each pixel sees.
        pixel: Their numbers, row by row.
        wire: Width of the sides of cells [pixels].
        dark: Share of the light of the first lamp that is kept off each pixel.
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
    colour = _lit(colour, soup, triangle, in_space, lens.camera.axes, np.float32(1) - dark)
    return _wired(colour, soup, triangle, shares, wire)


def _lit(colour, soup: Soup, triangle, shares, axes, reached) -> Float[np.ndarray, "n 3"]:
    """Two lamps that move with the eye, of the first the share that is `reached`; both sides
    of a surface are lit."""
    turned = (soup.normals @ axes.T).astype(np.float32)
    x, y, z = (
        sum(shares[c] * turned[:, c, k].take(triangle) for c in range(3)) for k in range(3)
    )
    size = np.sqrt(x * x + y * y + z * z)
    size = np.where(z < 0, np.float32(-1), np.float32(1)) / np.maximum(size, np.float32(1e-12))
    normal = (x * size, y * size, z * size)
    key, fill = KEY / np.linalg.norm(KEY), _FILL / np.linalg.norm(_FILL)
    half = key + np.array([0, 0, 1.0])
    bright, weak = _facing(normal, key), _facing(normal, fill)
    gleam = _facing(normal, half / np.linalg.norm(half))
    for _ in range(3):
        gleam = gleam**2
    gleam = np.float32(_SHINE) * gleam * gleam * gleam  # to the power 24
    valued, lit = np.isfinite(soup.values[:, 0]), soup.lit > 0

    def weight(coloured: float, plain: float):
        return _each(np.where(valued, coloured, plain).astype(np.float32), triangle)

    light = weight(0.72, 0.42) + weight(0.10, 0.16) * weak
    light = light + weight(0.24, 0.52) * bright * reached
    gleam *= weight(0.4, 1.0) * reached
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


# A solid scene as a picture with smooth edges; NumPy alone


_STEP = 0.02  # of red, green or blue between pixels: from there on all samples are lit
_FAR = 0.04  # of the depth of the scene: from there on a nearer surface has an outline


class _Layer(NamedTuple):
    """Triangles with the samples that see them; of each part its share of the colour; of each
    sample the share of light that others keep off."""

    soup: Soup
    triangle: Int[np.ndarray, " samples"]
    edge: Bool[np.ndarray, " samples"]
    opacity: Float[np.ndarray, " parts"] | None = None
    dark: Float[np.ndarray, " samples"] | None = None


Shadow = Callable[
    [Scene, Lens, Float[np.ndarray, "height width"]], Float[np.ndarray, " samples"]
]


def shade(
    scene: Scene,
    lens: Lens,
    *,
    samples: int = 2,
    dots_per_point: float = 1.4,
    shadow: Shadow | None = None,
) -> UInt8[np.ndarray, "height width 3"]:
    """The scene through `lens` on white paper.

    Args:
        scene: Of dimension 3.
        lens: From `camera.fit`.
        samples: Per pixel and direction; 2 smooths edges.
        dots_per_point: Pixels that a point of print has.
        shadow: Of the scene, the lens and the depth of every sample, the share of the light of
            the first lamp that does not get there; nothing is kept off if omitted.
    """
    width, height = lens.size
    size = (width * samples, height * samples)
    fine = replace(lens, size=size, scale=lens.scale * samples, shift=lens.shift * samples)
    points = dots_per_point * samples
    layers = _layers(scene, fine, points, shadow)

    def lit(at: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        return _lit_colours(layers, at, scene, fine, points, samples)

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


def _layers(scene: Scene, lens: Lens, points: float, shadow: Shadow | None) -> list[_Layer]:
    """The opaque layer, and the transparent one before it."""
    numbered: list[tuple[int, Part]] = list(enumerate(scene.parts))
    clear = [pair for pair in numbered if isinstance(pair[1], Surface) and pair[1].opacity < 1]
    solid = [pair for pair in numbered if pair not in clear]
    soup = soup_of(solid, lens, points)
    seen = rasterise(soup.pixels, *lens.size)
    dark = None if shadow is None else shadow(scene, lens, seen.depth)
    layers = [_Layer(soup, seen.triangle.ravel(), _outlined(soup, seen).ravel(), dark=dark)]
    if clear:
        soup = soup_of(clear, lens, points)
        above = rasterise(soup.pixels, *lens.size)
        shown = np.where(above.depth > seen.depth, -1, above.triangle).ravel()
        opacity = [getattr(part, "opacity", 1.0) for part in scene.parts]
        none = np.zeros(shown.shape, bool)
        layers.append(_Layer(soup, shown, none, np.array(opacity, np.float32)))
    return layers


def _lit_colours(layers, at, scene: Scene, lens: Lens, points: float, samples: int):
    """Red, green and blue of the samples `at`: every layer over the one below."""
    colours = np.ones((len(at), 3), np.float32)
    for soup, seen, edge, opacity, dark in layers:
        triangle = seen.take(at)
        hit = np.flatnonzero(triangle >= 0)
        if not len(hit):
            continue
        triangle = triangle.take(hit).astype(np.intp)
        kept_off = 0.0 if dark is None else dark.take(at.take(hit))
        wire = 0.45 * points
        found = lit_colour(soup, lens, scene.scale, triangle, at.take(hit), wire, kept_off)
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
    for soup, triangle, edge, *_ in layers:
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
        ((ahead, whole), (behind, whole)),
        ((behind, whole), (ahead, whole)),
        ((whole, ahead), (whole, behind)),
        ((whole, behind), (whole, ahead)),
    ):
        stands = depth[other] > depth[mine] + jump
        edge[mine] |= stands if covered is None else stands & ~covered[other]
    return edge
