"""Which triangle every pixel sees: a depth buffer over spans of rows, in NumPy."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

_CHUNK = 1 << 17  # pixels looked at in one go: they stay in the cache
_DEPTHS = 1 << 30
_NOTHING = np.iinfo(np.int64).max


class Seen(NamedTuple):
    """What a picture shows.

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
    table = np.stack(
        [
            (y[:, 2] - y[:, 0]) / area, (x[:, 0] - x[:, 2]) / area,
            (y[:, 0] - y[:, 1]) / area, (x[:, 1] - x[:, 0]) / area,
            x[:, 0] - 0.5, y[:, 0] - 0.5,
        ]
    ).astype(np.float32)  # fmt: skip
    across = column.astype(np.float32) - table[4][triangle]
    down = row.astype(np.float32) - table[5][triangle]
    second = table[0][triangle] * across + table[1][triangle] * down
    third = table[2][triangle] * across + table[3][triangle] * down
    return np.float32(1.0) - second - third, second, third
