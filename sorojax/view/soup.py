"""Parts of a scene as loose triangles in pixels, ready for the depth buffer."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sorojax.view.camera import Lens
from sorojax.view.glyphs import arrow_triangles, ball_triangles
from sorojax.view.scene import Arrows, Dots, Lines, Part, Scale, Surface

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
        return Soup(
            none, none, none[:, 0], none[:, 0], *(none[:, 0, 0], none[:, 0]), none[:, 0, 0]
        )
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
    points = np.asarray(part.points, float)
    triangles = np.asarray(part.triangles)
    if not np.all(np.isfinite(points)):
        triangles = triangles[np.all(np.isfinite(points[triangles]), axis=(1, 2))]
        points = np.nan_to_num(points)
    count = len(triangles)
    values = np.full((count, 3), np.nan)
    if part.values is not None:
        given = np.asarray(part.values, float)
        per_point = len(given) == len(points) and len(given) != len(part.triangles)
        values = given[triangles] if per_point else np.repeat(given[:, None], 3, axis=1)
    wire = np.zeros((count, 3)) if part.wire is None else np.asarray(part.wire, float)
    return Soup(
        lens(points)[triangles],
        corner_normals(points, triangles),
        values,
        _colours(part.colour, count),
        np.ones(count),
        wire,
        np.full(count, float(number)),
    )


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
    mean[rows] = _beside_creases(corner[rows], across.take(rows // 3, axis=0),
                                 face.take(rows // 3, axis=0))  # fmt: skip
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
    along = ends[:, :2] - starts[:, :2]
    size = np.linalg.norm(along, axis=1)
    unit = along / np.maximum(size, 1e-9)[:, None]
    side = np.stack([-unit[:, 1], unit[:, 0]], axis=1) * max(width, 1.0) / 2
    more = unit * max(width, 1.0) / 2 * (0.0 if part.dashed else 1.0)
    flat = [
        starts[:, :2] - more - side, ends[:, :2] + more - side,
        ends[:, :2] + more + side, starts[:, :2] - more + side,
    ]  # fmt: skip
    ahead = 1.5 * max(width, 1.0) / lens.scale
    depth = [starts[:, 2], ends[:, 2], ends[:, 2], starts[:, 2]]
    corners = [np.column_stack([f, d - ahead]) for f, d in zip(flat, depth, strict=True)]
    quads = np.stack(corners, axis=1)
    pixels = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    count = len(pixels)
    return Soup(
        pixels,
        np.broadcast_to(lens.camera.axes[2], (count, 3, 3)),
        np.full((count, 3), np.nan),
        _colours(part.colour, count),
        np.zeros(count),
        np.zeros((count, 3)),
        np.full(count, float(number)),
    )


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
