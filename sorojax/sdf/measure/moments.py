"""Area, volume, centroid, second moments and inertia of shapes, with the derivative of the
computed number itself.

Smooth solids are measured by six-node triangles on the surface, to fourth order in the cell;
plane shapes and solids with edges, narrow gaps or small fillets by cells that halve there. The
grid moves with the bounding box, so a derivative needs only that of the field at fixed places
of that frame, and agrees with finite differences at any resolution. Where the numbers of a
shape are traced, `traced` counts the same cells in arrays of fixed size.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.trace_state import is_traced, is_tracer
from sorojax._types import Numbers, real
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.measure import simplices as cut, simplices as six_node, traced
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
from sorojax.sdf.measure.simplices import turned
from sorojax.sdf.query import shape_tangent
from sorojax.sdf.sampling import finite_box, raise_empty, values
from sorojax.sdf.surface.blocks import LEAF, Grid, active_blocks
from sorojax.sdf.surface.marching import Surface, marching_cubes

# Moments of a shape from cells that halve where its field bends, with their exact slope.
#
# Cells that the Lipschitz constant proves full or empty are never looked at again. In the
# others the field is interpolated linearly on simplices of the cell and of its halves, and
# the two results are extrapolated. Where the field bends within a cell (an edge, a narrow gap,
# a small fillet) the halves are cells of their own, and the two ways of counting are blended by
# how much it bends. So the result is a smooth function of the nodal values, whose derivative
# is returned with it: that of the number itself, at any size of the cells.
#
# Lengths are in cells, from the middle of the shape's bounding box.


Field = Callable[[np.ndarray], np.ndarray]
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


def bending(field: np.ndarray, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Squared second over squared first differences (n,), and its derivative (n, nodes)."""
    second, first = differences_of(dim)
    bend, rise = field @ second.T, field @ first.T
    scale = np.maximum((rise * rise).sum(axis=1), 1e-300)
    ratio = (bend * bend).sum(axis=1) / scale
    slope = 2 * (bend @ second - ratio[:, None] * (rise @ first)) / scale[:, None]
    return ratio, slope


def _blend(ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    t = np.clip((ratio - STRAIGHT) / (BENT - STRAIGHT), 0.0, 1.0)
    return t * t * (3 - 2 * t), 6 * t * (1 - t) / (BENT - STRAIGHT)


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
        low = (low[:, None] + edge * halves_of(dim)).reshape(-1, dim)
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
    points = low[:, None] + edge * lattice_of(dim)
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
    simplices, factor = parts_of(dim)
    f = level.field[rows][:, simplices]
    below = (f < 0).sum(axis=2)
    moments = np.zeros((len(rows), cut.count(dim, order)))
    steep = np.zeros((len(rows) * 3**dim, moments.shape[1]))
    for mask, whole in ((below == dim + 1, True), ((below > 0) & (below <= dim), False)):
        cell, kind = np.nonzero(mask)
        corners = level.low[rows[cell], None] + level.edge * lattice_of(dim)[simplices[kind]]
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
        low = (level.low[bent, None] + level.edge * halves_of(dim)).reshape(-1, dim)
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
    out.points.append(level.low[rows[cell]] + level.edge * lattice_of(dim)[node])
    out.slopes.append(slopes[cell, node])


# Moments of shapes with the derivative of the computed number itself


_SMOOTH = 2e-2  # squared change of slope in a cell that six-node triangles follow
_DOUBT = 1e-2  # of the volume within cells that may hide something
_ROWS = 1 << 12


@eqx.filter_custom_jvp
def moments(shape: AbstractSdf, rule: Rule) -> Float[Array, " moments"]:
    """Moments of the inside in cells, about the middle of `frame`: see `cut_simplices`."""
    if is_traced(shape):
        return traced.counted(shape, rule)
    return jnp.asarray(_found(shape, rule, False).value, dtype=jnp.result_type(float))


@moments.def_jvp
def _moments_jvp(primals, tangents):
    shape, rule = primals
    if is_traced(shape):
        return _traced_jvp(shape, rule, tangents[0])
    found = _found(shape, rule, True)
    dtype = jnp.result_type(float)
    if not len(found.points):
        value = jnp.asarray(found.value, dtype=dtype)
        return value, jnp.zeros_like(value)
    points, weight = _chunked(found.points, found.slope)
    dot = shape_tangent(
        lambda s: _weighted(s, points, weight, rule.resolution), shape, tangents[0]
    )
    return jnp.asarray(found.value, dtype=dtype), dot


def _traced_jvp(shape: AbstractSdf, rule: Rule, shape_dot: Any) -> tuple[Array, Array]:
    """Moments of a shape with traced numbers, and how they move with them."""
    moving = jax.tree.map(lambda dot: dot is not None, shape_dot, is_leaf=lambda d: d is None)
    varied, held = eqx.partition(shape, moving)
    value, rows = traced.counted_with_rows(varied, held, rule)
    dot = jnp.zeros_like(value)
    pairs = zip(jax.tree.leaves(rows), jax.tree.leaves(shape_dot), strict=True)
    for row, along in pairs:
        dot = dot + row.reshape(len(value), -1) @ along.ravel()
    return value, dot


def _chunked(points: np.ndarray, slope: np.ndarray) -> tuple[Array, Array]:
    """Chunks (k, rows, dim) of points and (k, rows, moments) of slopes; k a power of two.

    A few sizes mean a few compilations.
    """
    count = 1 << max(0, (-(-len(points) // _ROWS) - 1).bit_length())
    pad = ((0, count * _ROWS - len(points)), (0, 0))
    # Places beside a true point have numbers; their weight is zero.
    rows = (np.pad(points, pad, mode="edge"), np.pad(slope, pad))
    first, second = (
        jnp.asarray(r.reshape(count, _ROWS, -1), dtype=jnp.result_type(float)) for r in rows
    )
    return first, second


@eqx.filter_jit
def _weighted(shape, points, weight, resolution):
    """Sum of the field times `weight`, chunk by chunk, nothing kept for the way back."""
    middle, size = frame(shape, resolution)

    @jax.checkpoint
    def add(total, chunk):
        p, w = chunk
        return total + shape(middle[None] + size * p) @ w, None

    start = jnp.zeros(weight.shape[-1], weight.dtype)
    return jax.lax.scan(add, start, (points, weight))[0]


def _found(shape: AbstractSdf, rule: Rule, slope: bool) -> Moments:
    lower, upper = finite_box(rule.where, shape, shape.dim)
    middle, size = (lower + upper) / 2, float((upper - lower).max()) / rule.resolution

    turn = turn_of(shape.dim)

    def field(points):
        return values(shape, middle + size * points @ turn.T) / size

    reach = float(shape.lipschitz)
    extent = np.abs(turn).T @ (upper - lower) / size
    level, full = first_level(field, reach, extent, rule.order)
    if np.isnan(level.field).any():
        raise ValueError(
            f"{rule.where}: the field of the shape is NaN at {np.isnan(level.field).sum()} "
            "points, need numbers. Check its parameters."
        )
    if shape.dim == 3 and bending(level.field, 3)[0].max(initial=0) <= _SMOOTH:
        found = _smooth(shape, rule, middle, size, upper - lower, slope)
    else:
        found = integrate(field, reach, level, LEVELS[shape.dim], rule.order, slope)
        back = turned(turn, rule.order)
        found = found._replace(
            value=back @ (found.value + full),
            points=found.points @ turn.T,
            slope=found.slope @ back.T / size,
        )
    if not found.value[0] > 0:
        raise_empty(rule.where, lower, upper, size)
    if found.doubt > _DOUBT * found.value[0]:
        _check.warn(
            f"{rule.where}: details too fine for cells of {size:g} m, halved "
            f"{LEVELS[shape.dim]} times, fill {100 * found.doubt / found.value[0]:.2g} % of "
            "the shape: the result may be off by as much. Raise `resolution`."
        )
    return found


def _smooth(shape, rule, middle, size, extent, slope) -> Moments:
    counts = np.ceil((extent / size + 3) / 2 / LEAF).astype(np.int64) * 2 * LEAF
    grid = Grid(middle - size * (counts / 2 + SHIFT), size, counts)
    surface = Surface(*marching_cubes(shape, grid, active_blocks(rule.where, shape, grid)))
    return Moments(*six_node.moments(shape, surface, grid, middle, rule.order, slope), 0.0)


# Volume, centroid and inertia of solid shapes, differentiable in their parameters


def volume(
    shape: AbstractSdf, resolution: int = 128, *, most_cells: int | None = None
) -> Float[Array, ""]:
    """Volume of a solid shape, differentiable in its parameters.

    Smooth shapes are integrated over a closed surface of six-node triangles, to fourth order in
    the cell. Shapes with edges, narrow gaps or small fillets are integrated over cells that the
    surface cuts, halved where the field bends. The derivative is that of the computed number.
    Warns where details finer than the smallest cells could change the result by 0.1 %.

    Args:
        shape: A bounded solid shape. Where its numbers are traced, by `jit` or `vmap`, smooth
            solids are counted in cells too; what has no volume then is NaN, no error.
        resolution: Cells along the longest side of its bounding box, 8 to 1024. Not traced.
        most_cells: Where the shape is traced, cells that may hold surface, at most: memory is
            laid out for them. If omitted, 16 for each cell of a face, and as for 128 at least;
            the volume is NaN if there are more.

    Returns:
        The volume [m^3].

    Raises:
        ValueError: If the shape is not solid, empty or unbounded; if `resolution` or
            `most_cells` is traced or out of range.

    Example:
        >>> ball = sdf.Sphere([0, 0, 0], 10 * mm)
        >>> print(f"{float(sdf.volume(ball, resolution=16)) / 1e-6:.3f} cm^3")
        4.189 cm^3

    Reference:
        Min and Gibou, Geometric integration over irregular domains with application to
        level-set methods, J. Comput. Phys. 226, 2007, for the cut cells.
    """
    rule = _rule("volume", shape, 3, resolution, 0, most_cells)
    return frame(shape, rule.resolution)[1] ** 3 * moments(shape, rule)[0]


@jax.jit
def _middle_of_mass(
    m: Float[Array, " moments"], middle: Float[Array, " dim"], size: Float[Array, ""]
) -> Float[Array, " dim"]:
    """Centroid [m] from moments in cells of `size` [m] about `middle` [m]."""
    return middle + size * m[1 : 1 + len(middle)] / m[0]


def inertia_tensor(
    shape: AbstractSdf,
    density: Numbers = 1.0,
    resolution: int = 128,
    *,
    most_cells: int | None = None,
) -> Float[Array, "3 3"]:
    """Moments of inertia [kg m^2] about the centroid, differentiable as `volume` is.

    Args:
        shape: A bounded solid shape.
        density: Mass per volume [kg/m^3].
        resolution: Cells along the longest side of its bounding box.
        most_cells: As in `volume`.

    Returns:
        A symmetric matrix [kg m^2].
    """
    rule = _rule("inertia_tensor", shape, 3, resolution, 2, most_cells)
    size = frame(shape, rule.resolution)[1]
    return real(density) * _inertia(moments(shape, rule), size)


@jax.jit
def _inertia(m: Float[Array, "10"], size: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Of unit density [m^5], from moments in cells of `size` [m]; one program, not twenty."""
    xx, yy, zz, xy, yz, zx = m[4:]
    second = jnp.stack([xx, xy, zx, xy, yy, yz, zx, yz, zz]).reshape(3, 3)
    second = second - m[1:4, None] * m[None, 1:4] / m[0]
    identity = jnp.eye(3, dtype=m.dtype)
    return size**5 * (jnp.trace(second) * identity - second)


_INSTEAD = {
    2: "sdf.volume, sdf.centroid and sdf.inertia_tensor for solids",
    3: "sdf.area, sdf.centroid and sdf.second_moments for plane shapes",
}


def _rule(
    where: str, shape: AbstractSdf, dim: int, resolution: int, order: int, most: int | None
) -> Rule:
    if shape.dim != dim:
        raise ValueError(
            f"{where}: the shape is {shape.dim}-D, need {dim}-D. Use {_INSTEAD[dim]}."
        )
    for name, given in (("resolution", resolution), ("most_cells", most)):
        if is_tracer(given):
            raise ValueError(
                f"{where}: `{name}` is traced, need a whole number that is fixed when the "
                "program is compiled. Leave it out of the arguments of jit, vmap and grad."
            )
    if not 8 <= resolution <= 1024:
        raise ValueError(
            f"{where}: `resolution` is {resolution} cells, need 8 to 1024. 128 is usual."
        )
    if most is None:
        most = 16 * resolution * (1 if dim == 2 else max(resolution, 128))
    if not 1 <= most <= 1 << 24:
        raise ValueError(
            f"{where}: `most_cells` is {most}, need 1 to {1 << 24}. Leave it out: "
            "it is 16 for each cell along the box in the plane, on its face in space."
        )
    whole = -(-int(most) // traced.CHUNK) * traced.CHUNK
    return Rule(where, dim, int(resolution), order, whole)


# Area, centroid and second moments of plane shapes, differentiable in their parameters


_CELLS = 512  # along the longest side; halved eight times at corners and narrow gaps


def area(shape: AbstractSdf, *, most_cells: int | None = None) -> Float[Array, ""]:
    """Area of a plane shape, differentiable in its parameters.

    The integral over the cells that the boundary cuts, 512 along the longest side of the
    bounding box and halved at corners and narrow gaps. The derivative is that of the computed
    number.

    Args:
        shape: A bounded plane shape. Where its numbers are traced, by `jit` or `vmap`, the
            cells are the same; what has no area then is NaN, no error.
        most_cells: Where the shape is traced, cells that may hold boundary, at most: memory is
            laid out for them. 8192 if omitted; the area is NaN if there are more.

    Returns:
        The area [m^2].

    Raises:
        ValueError: If the shape is not plane, empty or unbounded, or `most_cells` is out of
            range.

    Example:
        >>> plate = sdf.Rectangle([0, 0], [20 * mm, 10 * mm]) - sdf.Circle([0, 0], 5 * mm)
        >>> print(f"{float(sdf.area(plate)) / mm**2:.3f} mm^2")  # 200 - 25 pi / 4
        180.365 mm^2

    Reference:
        Min and Gibou, Geometric integration over irregular domains with application to
        level-set methods, J. Comput. Phys. 226, 2007.
    """
    m = moments(shape, _rule("area", shape, 2, _CELLS, 0, most_cells))
    return frame(shape, _CELLS)[1] ** 2 * m[0]


def centroid(shape: AbstractSdf, *, most_cells: int | None = None) -> Float[Array, " dim"]:
    """Centroid [m] of a shape, differentiable and traced as `area` and, in space, `volume`.

    Args:
        shape: A bounded shape.
        most_cells: As in `volume`.

    Returns:
        The point [m].
    """
    cells = _CELLS if shape.dim == 2 else 128
    rule = _rule("centroid", shape, shape.dim, cells, 1, most_cells)
    return _middle_of_mass(moments(shape, rule), *frame(shape, rule.resolution))


def second_moments(shape: AbstractSdf, *, most_cells: int | None = None) -> Float[Array, "2 2"]:
    """Integral of r r^T over a plane shape, r from its centroid [m^4], as `area` is.

    Entry (0, 0) is that of x^2, which resists bending in x; the trace is the polar moment.

    Args:
        shape: A bounded plane shape.
        most_cells: As in `volume`.

    Returns:
        A symmetric matrix [m^4].
    """
    m = moments(shape, _rule("second_moments", shape, 2, _CELLS, 2, most_cells))
    return _second(m, frame(shape, _CELLS)[1])


@jax.jit
def _second(m: Float[Array, "6"], size: Float[Array, ""]) -> Float[Array, "2 2"]:
    """About the centroid [m^4], from moments in cells of `size` [m]."""
    xx, yy, xy = m[3:] - jnp.stack([m[1] * m[1], m[2] * m[2], m[1] * m[2]]) / m[0]
    return size**4 * jnp.stack([xx, xy, xy, yy]).reshape(2, 2)
