"""Moments of a shape from cells that halve where its field bends, with their exact slope.

Cells that the Lipschitz constant proves full or empty are never looked at again. In the
others the field is interpolated linearly on simplices of the cell and of its halves, and
the two results are extrapolated. Where the field bends within a cell (an edge, a narrow gap,
a small fillet) the halves are cells of their own, and the two ways of counting are blended by
how much it bends. So the result is a smooth function of the nodal values, whose derivative
is returned with it: that of the number itself, at any size of the cells.

Lengths are in cells, from the middle of the shape's bounding box.
"""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sorojax.sdf.measure import simplices as cut

Field = Callable[[np.ndarray], np.ndarray]
SHIFT = 0.3819660113  # cells; of the golden ratio: no face at a fraction falls on nodes
_STRAIGHT, _BENT = 2e-3, 2e-2  # squared change of slope in a cell: kept as it is, halved
_MOST = 1 << 20  # cells of one level
_PIECE = 4096


class Moments(NamedTuple):
    """Moments of a shape and how they follow from its field.

    Attributes:
        value: (moments,) of the inside.
        points: (n, dim) where the field counts.
        slope: (n, moments) derivative in the field there.
        doubt: Upper bound of the volume where the field bends within the smallest cells.
    """

    value: np.ndarray
    points: np.ndarray
    slope: np.ndarray
    doubt: float


class Level(NamedTuple):
    """Cells with lower corners `low`, their nodes' field, and the weight of each."""

    low: np.ndarray
    edge: float
    field: np.ndarray
    weight: np.ndarray


class _Found(NamedTuple):
    """Pieces of `Moments` as they come up."""

    points: list[np.ndarray]
    slopes: list[np.ndarray]
    doubt: list[float]


@functools.cache
def _lattice(dim: int) -> np.ndarray:
    """The 3^dim nodes of a cell and its halves, in shares of its edge."""
    return np.array(list(itertools.product((0.0, 0.5, 1.0), repeat=dim)))


@functools.cache
def _halves(dim: int) -> np.ndarray:
    return np.array(list(itertools.product((0.0, 0.5), repeat=dim)))


@functools.cache
def _simplices(dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Simplices of the cell and of its halves as nodes, and the factor of each."""
    stride = 3 ** np.arange(dim - 1, -1, -1)
    corners = np.array(list(itertools.product((0, 1), repeat=dim)))
    rows = cut.kuhn(dim)
    coarse = (2 * corners @ stride)[rows]
    fine = [((corners + start) @ stride)[rows] for start in corners]
    factor = np.concatenate([np.full(len(rows), -1 / 3), np.full(len(rows) << dim, 4 / 3)])
    return np.concatenate([coarse, *fine]), factor


@functools.cache
def _differences(dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows that take second and first differences along all lines of three nodes."""
    unit = np.eye(3**dim).reshape(*dim * (3,), 3**dim)
    second, first = [], []
    for axis in range(dim):
        a, b, c = np.moveaxis(unit, axis, 0)
        second.append((a - 2 * b + c).reshape(-1, 3**dim))
        first.append((c - a).reshape(-1, 3**dim))
    return np.concatenate(second), np.concatenate(first)


def bending(field: np.ndarray, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Squared second over squared first differences (n,), and its derivative (n, nodes)."""
    second, first = _differences(dim)
    bend, rise = field @ second.T, field @ first.T
    scale = np.maximum((rise * rise).sum(axis=1), 1e-300)
    ratio = (bend * bend).sum(axis=1) / scale
    slope = 2 * (bend @ second - ratio[:, None] * (rise @ first)) / scale[:, None]
    return ratio, slope


def _blend(ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    t = np.clip((ratio - _STRAIGHT) / (_BENT - _STRAIGHT), 0.0, 1.0)
    return t * t * (3 - 2 * t), 6 * t * (1 - t) / (_BENT - _STRAIGHT)


def first_level(
    field: Field, reach: float, extent: np.ndarray, order: int
) -> tuple[Level, np.ndarray]:
    """Cells of edge 1 that may hold surface, and the moments of the full ones left out.

    Args:
        field: Field at points (n, dim) [cells].
        reach: Lipschitz constant of `field`.
        extent: (dim,) of the box that holds the inside [cells].
        order: Highest degree of a moment.
    """
    dim = len(extent)
    edge = 1.0
    while (extent / edge).max() > 48:
        edge *= 2
    counts = 2 * np.ceil(extent / edge / 2 + 0.5)
    axes = [edge * (np.arange(n) - n / 2) - SHIFT for n in counts]
    low = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
    total = np.zeros(cut.count(dim, order))
    while True:
        low, _, moments = _cull(field, reach, low, np.zeros(len(low), int), edge, order)
        total += moments.sum(axis=0)
        if edge == 1.0:
            break
        low = (low[:, None] + edge * _halves(dim)).reshape(-1, dim)
        edge /= 2
    return _sampled(field, low, edge, np.ones(len(low))), total


def _cull(field, reach, low, parent, edge, order):
    """Cells that may hold surface, their parents, and the moments of the full ones."""
    dim = low.shape[1]
    centers = low + edge / 2
    f = field(centers)
    open_ = ~(np.abs(f) > reach * edge * dim**0.5 / 2 * (1 + 1e-9))
    moments = np.zeros((len(low), cut.count(dim, order)))
    full = ~open_ & (f < 0)
    moments[full] = cut.box_moments(centers[full], edge, order)
    return low[open_], parent[open_], moments


def _sampled(field: Field, low, edge, weight) -> Level:
    dim = low.shape[1]
    points = low[:, None] + edge * _lattice(dim)
    return Level(low, edge, field(points.reshape(-1, dim)).reshape(len(low), 3**dim), weight)


def _counted(level: Level, order: int, slope: bool):
    """Extrapolated moments (n, moments) of cells; cells with both signs and their slopes."""
    dim = level.low.shape[1]
    negative = (level.field < 0).sum(axis=1)
    moments = np.zeros((len(level.low), cut.count(dim, order)))
    full = negative == 3**dim
    moments[full] = cut.box_moments(level.low[full] + level.edge / 2, level.edge, order)
    mixed = np.flatnonzero((negative > 0) & ~full)
    steep = np.zeros((len(mixed) if slope else 0, 3**dim, moments.shape[1]))
    for start in range(0, len(mixed), _PIECE):
        rows = mixed[start : start + _PIECE]
        part = _pieces(level, rows, order, slope)
        moments[rows] = part[0]
        if slope:
            steep[start : start + _PIECE] = part[1]
    return moments, mixed, steep


def _pieces(level: Level, rows, order, slope):
    """As `_counted`, of cells with both signs."""
    dim = level.low.shape[1]
    simplices, factor = _simplices(dim)
    f = level.field[rows][:, simplices]
    below = (f < 0).sum(axis=2)
    moments = np.zeros((len(rows), cut.count(dim, order)))
    steep = np.zeros((len(rows) * 3**dim, moments.shape[1]))
    for mask, whole in ((below == dim + 1, True), ((below > 0) & (below <= dim), False)):
        cell, kind = np.nonzero(mask)
        corners = level.low[rows[cell], None] + level.edge * _lattice(dim)[simplices[kind]]
        if whole:
            found, sharp = cut.simplex_moments(corners, order)[1], None
        else:
            found, sharp = cut.cut_moments(corners, f[cell, kind], order, slope)
        for k in range(moments.shape[1]):
            moments[:, k] += np.bincount(cell, factor[kind] * found[:, k], len(rows))
            if sharp is not None:
                at = (cell[:, None] * 3**dim + simplices[kind]).ravel()
                amount = (factor[kind][:, None] * sharp[:, :, k]).ravel()
                steep[:, k] += np.bincount(at, amount, len(steep))
    return moments, steep.reshape(len(rows), 3**dim, -1)


def integrate(
    field: Field, reach: float, level: Level, levels: int, order: int, slope: bool
) -> Moments:
    """Moments of the cells of `level`, which halve up to `levels` times where they bend."""
    found = _Found([], [], [])
    value = _descend(field, reach, level, levels, order, slope, found).sum(axis=0)
    dim = level.low.shape[1]
    points = np.concatenate([np.zeros((0, dim)), *found.points])
    slopes = np.concatenate([np.zeros((0, len(value))), *found.slopes])
    return Moments(
        value, *_merged(points, slopes, level.edge / 4 / 2**levels), sum(found.doubt)
    )


def _merged(points, slopes, step: float) -> tuple[np.ndarray, np.ndarray]:
    """One row for each point; points are `step` [cells] apart at least."""
    if not len(points):
        return points, slopes
    whole = np.rint((points - points.min(axis=0)) / step).astype(np.int64)
    wide = whole.max(axis=0) + 1
    name = whole[:, 0]
    for axis in range(1, points.shape[1]):
        name = name * wide[axis] + whole[:, axis]
    _, first, which = np.unique(name, return_index=True, return_inverse=True)
    merged = [np.bincount(which, column, len(first)) for column in slopes.T]
    return points[first], np.stack(merged, axis=1)


def _descend(field, reach, level, levels, order, slope, out: _Found) -> np.ndarray:
    """Moments (n, moments) of cells and their halves; what they follow from goes to `out`."""
    dim = level.low.shape[1]
    moments, mixed, steep = _counted(level, order, slope)
    ratio, turn = bending(level.field, dim)
    share, gain = _blend(ratio)
    bent = np.flatnonzero(share > 0)
    if levels == 0 or len(bent) << dim > _MOST:
        near = np.abs(level.field).min(axis=1) <= reach * level.edge * dim**0.5 / 4
        out.doubt.append(float(level.weight[near & (share > 0)].sum()) * level.edge**dim)
        share, gain, bent = 0 * share, 0 * gain, bent[:0]
    inner = moments.copy()
    if len(bent):
        edge = level.edge / 2
        low = (level.low[bent, None] + level.edge * _halves(dim)).reshape(-1, dim)
        low, parent, full = _cull(field, reach, low, np.repeat(bent, 1 << dim), edge, order)
        inner[bent] = full.reshape(len(bent), 1 << dim, -1).sum(axis=1)
        below = _sampled(field, low, edge, level.weight[parent] * share[parent])
        deeper = _descend(field, reach, below, levels - 1, order, slope, out)
        np.add.at(inner, parent, deeper)
    if slope:
        own = level.weight * (1 - share)
        _keep(out, level, mixed, own[mixed, None, None] * steep)
        turning = np.flatnonzero(gain > 0)
        change = (level.weight * gain)[:, None] * (inner - moments)
        _keep(out, level, turning, turn[turning, :, None] * change[turning, None])
    return moments + share[:, None] * (inner - moments)


def _keep(out: _Found, level: Level, rows, slopes) -> None:
    """Note the nodes of cells `rows` that have any of `slopes` (n, nodes, moments)."""
    dim = level.low.shape[1]
    cell, node = np.nonzero((slopes != 0).any(axis=2))
    out.points.append(level.low[rows[cell]] + level.edge * _lattice(dim)[node])
    out.slopes.append(slopes[cell, node])
