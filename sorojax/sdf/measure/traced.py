"""Moments of a shape whose numbers are traced: the cells of `moments`, in arrays of fixed size.

The same cells, halved where the field bends, give the same numbers, to rounding, where the host
counts cells too. Only as many cells as there are are visited; under `vmap` as many as the lane
with the most has. The derivative is a matrix, of the moments in the numbers of the shape, made
along with them: so it is linear, in forward and reverse mode, and nothing is kept for either.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from sorojax.math.host import largest_of_lanes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.measure import simplices as cut
from sorojax.sdf.measure.cells import (
    BENT,
    LEVELS,
    SHIFT,
    STRAIGHT,
    Rule,
    differences_of,
    frame,
    halves_of,
    lattice_of,
    parts_of,
    turn_of,
)

CHUNK = 256  # cells at a time: what they need stays in the cache
_WIDEST = 48  # cells of the first level along an axis

Field = Callable[[Float[Array, "n dim"]], Float[Array, " n"]]


class _Cells(NamedTuple):
    """The cells of one level; those from `count` on are none."""

    low: Float[Array, "most dim"]
    parent: Int[Array, " most"]
    weight: Float[Array, " most"]
    count: Int[Array, ""]


class _Level(NamedTuple):
    """What is found in them: `moments` of a cell as it is, the `share` of its halves, and the
    moments of those `within` it that are full."""

    cells: _Cells
    edge: Float[Array, ""]
    moments: Float[Array, "most moments"]
    share: Float[Array, " most"]
    within: Float[Array, "most moments"]


class _Tree(NamedTuple):
    """All levels, stacked, and the moments of what each cell holds."""

    levels: _Level
    inner: Float[Array, "levels most moments"]
    total: Float[Array, " moments"]


@eqx.filter_jit
def counted(shape: AbstractSdf, rule: Rule) -> Float[Array, " moments"]:
    """Moments of the inside in cells, about the middle of `frame`; NaN where the cells do not
    suffice, or the field is no number."""
    return _back(rule, _tree(shape, rule).total)


@eqx.filter_jit
def counted_with_rows(varied: Any, held: Any, rule: Rule) -> tuple[Any, PyTree]:
    """As `counted`, of a shape in two parts, with the derivative in the numbers of the first:
    (moments, *shape) for each of its leaves."""
    tree = _tree(eqx.combine(varied, held), rule)
    eye = jnp.eye(len(tree.total), dtype=tree.total.dtype)

    def piece(varied, edge, low, own, change):
        field = _field(eqx.combine(varied, held), rule)
        moments, share, _ = _of_cells(field, low, edge, rule)
        return own @ moments + share @ change

    numbers, build = ravel_pytree(varied)
    few = numbers.size <= 2 * len(eye)  # one tangent costs about half of one cotangent

    def slopes(function):
        if few:
            matrix = jax.jacfwd(lambda x: function(build(x)))(numbers)
            return jax.vmap(build)(matrix)
        (rows,) = jax.vmap(jax.vjp(function, varied)[1])(eye)
        return rows

    def add(rows, level: tuple[_Level, Array]):
        one, inner = level
        kept = one.cells.weight * (1 - one.share)
        halved = jnp.where(one.share > 0, one.cells.weight, jnp.zeros_like(kept))
        change = halved[:, None] * (inner - one.moments)

        def chunk(rows, at):
            low, own, turning = (_slice(x, at, rule) for x in (one.cells.low, kept, change))
            here = jnp.arange(len(low), dtype=jnp.int32) + at < one.cells.count
            own = jnp.where(here, own, jnp.zeros_like(own))
            turning = jnp.where(here[:, None], turning, jnp.zeros_like(turning))
            more = slopes(lambda v: piece(v, one.edge, low, own, turning))
            return jax.tree.map(jnp.add, rows, more)

        return _chunks(one.cells.count, rule, chunk, rows), None

    none = jax.tree.map(lambda x: jnp.zeros((len(eye), *x.shape), x.dtype), varied)
    rows, _ = jax.lax.scan(add, none, (tree.levels, tree.inner))
    return _back(rule, tree.total), jax.tree.map(lambda r: _back(rule, r), rows)


def _back(rule: Rule, moments: Array) -> Array:
    """Moments along the axes of those along the cells."""
    matrix = jnp.asarray(cut.turned(turn_of(rule.dim), rule.order), moments.dtype)
    return jnp.tensordot(matrix, moments, axes=1)


def _field(shape: AbstractSdf, rule: Rule) -> Field:
    """Field [cells] at points [cells]."""
    middle, size = frame(shape, rule.resolution)

    def field(points):
        turned = points @ jnp.asarray(turn_of(rule.dim).T, points.dtype)
        return shape(middle[None] + size * turned) / size

    return field


def _tree(shape: AbstractSdf, rule: Rule) -> _Tree:
    shape = jax.lax.stop_gradient(shape)
    field = _field(shape, rule)
    cells, full, fits = _first(shape, field, rule)
    # In as many steps as levels, each a program of its own size: one to compile.
    dtype = full.dtype
    edges = jnp.asarray(0.5 ** np.arange(LEVELS[rule.dim] + 1), dtype)
    last = jnp.asarray(np.arange(LEVELS[rule.dim] + 1) == LEVELS[rule.dim])
    reach = jnp.asarray(shape.lipschitz, dtype)

    def down(cells, at):
        return _halved(field, reach, cells, *at, rule)

    (_, sound), levels = jax.lax.scan(down, (cells, fits), (edges, last))

    def up(below, level: _Level):
        deeper, parent, count = below
        here = jnp.arange(rule.most, dtype=jnp.int32) < count
        deeper = jnp.where(here[:, None], deeper, jnp.zeros_like(deeper))
        inner = level.within + jnp.zeros_like(deeper).at[parent].add(deeper)
        value = level.moments + level.share[:, None] * (inner - level.moments)
        return (value, level.cells.parent, level.cells.count), inner

    nothing = jnp.zeros_like(levels.within[0]), jnp.zeros_like(cells.parent), cells.count * 0
    (value, _, count), inner = jax.lax.scan(up, nothing, levels, reverse=True)
    here = jnp.arange(rule.most, dtype=jnp.int32) < count
    value = jnp.where(here[:, None], value, jnp.zeros_like(value)).sum(axis=0)
    whole = full + value
    return _Tree(levels, inner, jnp.where(sound & (whole[0] > 0), whole, jnp.nan))


def _first(shape, field: Field, rule: Rule):
    """Cells of edge 1 that may hold surface, the moments of full ones, and whether all fit."""
    lower, upper = shape.bounding_box()
    size = frame(shape, rule.resolution)[1]
    dtype = size.dtype
    extent = jnp.asarray(np.abs(turn_of(rule.dim)).T, dtype) @ (
        (upper - lower).astype(dtype) / size
    )
    edge, start = _coarse(rule)
    low = jnp.asarray(start, dtype)
    # The axis of a flat box has no cells beyond it.
    half = edge * jnp.ceil(extent / edge / 2 + 0.5)
    keep = jnp.all(jnp.abs(low + edge / 2 + SHIFT) <= half[None], axis=1)
    reach = jnp.asarray(shape.lipschitz, dtype)
    total, fits = jnp.zeros(cut.count(rule.dim, rule.order), dtype), jnp.array(True)
    while True:
        open_, full = _culled(field(low + edge / 2), reach, edge, rule)
        box = _box_moments(low + edge / 2, edge, rule.order)
        total = total + jnp.where((full & keep)[:, None], box, jnp.zeros_like(box)).sum(axis=0)
        open_ = open_ & keep
        count = jnp.sum(open_, dtype=jnp.int32)
        fits = fits & (count <= rule.most)
        width = rule.most if edge == 1 else min(rule.most, len(low))
        (at,) = jnp.nonzero(open_, size=width, fill_value=0)
        low, keep = low[at], jnp.arange(width, dtype=jnp.int32) < count
        if edge == 1:
            break
        edge /= 2
        low = (low[:, None] + edge * 2 * jnp.asarray(halves_of(rule.dim), dtype)[None]).reshape(
            -1, rule.dim
        )
        keep = jnp.repeat(keep, 1 << rule.dim)
    ones = jnp.ones(rule.most, dtype)
    none = jnp.zeros(rule.most, jnp.int32)
    return _Cells(low, none, ones, jnp.minimum(count, rule.most)), total, fits


def _coarse(rule: Rule) -> tuple[float, np.ndarray]:
    """Edge and lower corners of the largest cells, over any box of this resolution."""
    extent = rule.resolution * np.abs(turn_of(rule.dim)).sum(axis=0)
    edge = 1.0
    while extent.max() / edge > _WIDEST:
        edge *= 2
    counts = 2 * np.ceil(extent / edge / 2 + 0.5)
    axes = [edge * (np.arange(n) - n / 2) - SHIFT for n in counts]
    return edge, np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, rule.dim)


def _culled(f, reach, edge, rule: Rule) -> tuple[Bool[Array, "..."], Bool[Array, "..."]]:
    """Which cells may hold surface, and which are full, by the field in their middles."""
    open_ = ~(jnp.abs(f) > reach * edge * (math.sqrt(rule.dim) / 2 * (1 + 1e-9)))
    return open_, ~open_ & (f < 0)


def _halved(field: Field, reach, state, edge, last, rule: Rule):
    """The next level, and this one as it was found."""
    cells, sound = state
    size, dim = rule.most, rule.dim
    number = cut.count(dim, rule.order)
    dtype = cells.low.dtype
    halves = jnp.asarray(halves_of(dim), dtype)

    def chunk(found, at):
        moments, share, within, open_, fine = found
        low = _slice(cells.low, at, rule)
        m, s, numbers = _of_cells(field, low, edge, rule)
        centers = (low[:, None] + edge * (halves + 0.25)[None]).reshape(-1, dim)
        may, full = _culled(field(centers), reach, edge / 2, rule)
        box = _box_moments(centers, edge / 2, rule.order)
        box = jnp.where(full[:, None], box, jnp.zeros_like(box))
        here = jnp.arange(len(low), dtype=jnp.int32) + at < cells.count
        fine = fine & jnp.all(numbers | ~here)
        new = (
            jnp.where(here[:, None], m, jnp.zeros_like(m)),
            jnp.where(here, s, jnp.zeros_like(s)),
            box.reshape(len(low), 1 << dim, number).sum(axis=1),
            may.reshape(len(low), 1 << dim) & (here & (s > 0))[:, None],
        )
        old = moments, share, within, open_
        put = [
            jax.lax.dynamic_update_slice_in_dim(a, b, at, 0)
            for a, b in zip(old, new, strict=True)
        ]
        return (*put, fine)

    start = (
        jnp.zeros((size, number), dtype),
        jnp.zeros(size, dtype),
        jnp.zeros((size, number), dtype),
        jnp.zeros((size, 1 << dim), bool),
        sound,
    )
    moments, share, within, open_, sound = _chunks(cells.count, rule, chunk, start)
    wanted = jnp.sum(open_, dtype=jnp.int32)
    stop = last | (wanted > size)  # as they are: the host has its limit too
    share = jnp.where(stop, jnp.zeros_like(share), share)
    (at,) = jnp.nonzero(open_.ravel(), size=size, fill_value=0)
    at = at.astype(jnp.int32)
    parent, which = at >> dim, at & ((1 << dim) - 1)
    below = _Cells(
        cells.low[parent] + edge * halves[which],
        parent,
        cells.weight[parent] * share[parent],
        jnp.where(stop, jnp.zeros_like(wanted), wanted),
    )
    return (below, sound), _Level(cells, edge, moments, share, within)


def _slice(x: Array, at, rule: Rule) -> Array:
    return jax.lax.dynamic_slice_in_dim(x, at, CHUNK, 0)


def _chunks(count, rule: Rule, chunk: Callable[[Any, Any], Any], start: Any) -> Any:
    """`start` after `chunk` of all cells; as often in all lanes, so none is copied for it."""
    width = CHUNK
    times = (largest_of_lanes(count) + width - 1) // width
    return jax.lax.fori_loop(0, times, lambda i, x: chunk(x, i * width), start)


def _of_cells(field: Field, low, edge, rule: Rule):
    """Extrapolated moments of cells as they are, the share of their halves, and whether the
    field is a number in each."""
    dim, order = rule.dim, rule.order
    dtype = low.dtype
    parts, factor = parts_of(dim)
    points = low[:, None] + edge * jnp.asarray(lattice_of(dim), dtype)[None]
    f = field(points.reshape(-1, dim)).reshape(len(low), -1)
    found = _cut_moments(points[:, parts], f[:, parts], order)
    mixed = jnp.einsum("s,csm->cm", jnp.asarray(factor, dtype), found)
    full = jnp.all(f < 0, axis=1)[:, None]
    moments = jnp.where(full, _box_moments(low + edge / 2, edge, order), mixed)
    return moments, _share(f, rule), ~jnp.any(jnp.isnan(f), axis=1)


def _share(f, rule: Rule) -> Float[Array, " cells"]:
    """Share of the halves of a cell in its moments, by how much the field bends in it."""
    second, first = (jnp.asarray(d, f.dtype) for d in differences_of(rule.dim))
    rise = jnp.sum((f @ first.T) ** 2, axis=1)
    steady = rise > 0
    ratio = jnp.sum((f @ second.T) ** 2, axis=1) / jnp.where(steady, rise, jnp.ones_like(rise))
    t = jnp.clip((ratio - STRAIGHT) / (BENT - STRAIGHT), 0.0, 1.0)
    return jnp.where(steady, t * t * (3 - 2 * t), jnp.zeros_like(t))


def _second(centers: Array) -> Array:
    """xx, yy[, zz], xy[, yz, zx] of (.., dim)."""
    pairs = cut.pairs(centers.shape[-1])
    return jnp.stack([centers[..., i] * centers[..., j] for i, j in pairs], axis=-1)


def _box_moments(centers: Array, edge, order: int) -> Array:
    """Moments (n, moments) of cubes."""
    dim = centers.shape[1]
    columns = [jnp.ones_like(centers[:, :1]), centers]
    if order == 2:
        own = np.zeros(len(cut.pairs(dim)))
        own[:dim] = 1 / 12
        columns.append(_second(centers) + edge**2 * jnp.asarray(own, centers.dtype)[None])
    return edge**dim * jnp.concatenate(columns[: order + 1], axis=1)


def _simplex_moments(x: Array, order: int) -> Array:
    """Moments (.., moments) of simplices with corners `x` (.., dim + 1, dim)."""
    dim = x.shape[-1]
    e = x[..., 1:, :] - x[..., :1, :]
    if dim == 2:
        volume = e[..., 0, 0] * e[..., 1, 1] - e[..., 0, 1] * e[..., 1, 0]
    else:
        volume = jnp.sum(e[..., 0, :] * jnp.cross(e[..., 1, :], e[..., 2, :]), axis=-1)
    volume = jnp.abs(volume)[..., None] / math.factorial(dim)
    total = x.sum(axis=-2)
    columns = [volume, volume * total / (dim + 1)]
    if order == 2:
        square = _second(x).sum(axis=-2) + _second(total)
        columns.append(volume * square / ((dim + 1) * (dim + 2)))
    return jnp.concatenate(columns[: order + 1], axis=-1)


def _cut_moments(x: Array, f: Array, order: int) -> Array:
    """Moments (.., moments) of the part f < 0 of simplices with corners `x`."""
    dim = x.shape[-1]
    rank = jnp.argsort(f, axis=-1, stable=True)
    f = jnp.take_along_axis(f, rank, axis=-1)
    x = jnp.take_along_axis(x, rank[..., None], axis=-2)
    inside = jnp.sum(f < 0, axis=-1)[..., None]
    # The one corner of its sign is first or last.
    other = (inside == dim)[..., None]
    x_apex, f_apex = (
        jnp.where(other, x[..., ::-1, :], x),
        jnp.where(other[..., 0], f[..., ::-1], f),
    )
    at_corner = _apart(x_apex, f_apex, order)
    whole = _simplex_moments(x, order)
    none = jnp.zeros_like(whole)
    found = jnp.where(inside == 1, at_corner, none)
    found = jnp.where(inside == dim, whole - at_corner, found)
    found = jnp.where(inside == dim + 1, whole, found)
    if dim == 3:
        found = jnp.where(inside == 2, _wedge(x, f, order), found)
    return found


def _between(x: Array, f: Array, i: int, j: int) -> Array:
    """Where the field vanishes between corners `i` and `j`; anywhere if it does not."""
    fi, fj = f[..., i], f[..., j]
    signs = (fi < 0) != (fj < 0)
    t = jnp.where(signs, fi, 0 * fi) / jnp.where(signs, fi - fj, jnp.ones_like(fi))
    return x[..., i, :] + t[..., None] * (x[..., j, :] - x[..., i, :])


def _apart(x: Array, f: Array, order: int) -> Array:
    """Moments of the part about the first corner, the only one of its sign."""
    ends = [_between(x, f, 0, j) for j in range(1, f.shape[-1])]
    return _simplex_moments(jnp.stack([x[..., 0, :], *ends], axis=-2), order)


def _wedge(x: Array, f: Array, order: int) -> Array:
    """Moments of a wedge (0, 02, 03)-(1, 12, 13): the first two corners inside."""
    near = x[..., 0, :], _between(x, f, 0, 2), _between(x, f, 0, 3)
    far = x[..., 1, :], _between(x, f, 1, 2), _between(x, f, 1, 3)
    rows = (*near, far[2]), (near[0], near[1], far[1], far[2]), (near[0], *far)
    return sum(
        (_simplex_moments(jnp.stack(row, axis=-2), order) for row in rows[1:]),
        start=_simplex_moments(jnp.stack(rows[0], axis=-2), order),
    )
