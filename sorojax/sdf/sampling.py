"""Fields sampled on the host: two compiled kernels of fixed size per kind of shape."""

from collections.abc import Callable
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from sorojax._jax.trace_state import is_traced
from sorojax.sdf.base import AbstractSdf, cast

CHUNK = 4096  # fits the cache, and one size means one compilation

_value = eqx.filter_jit(lambda shape, p: shape(p))


def value_and_gradient(shape, p):
    """As `query.value_and_gradient`, as one pass over three directions: compiles faster."""
    shape = cast(shape, p.dtype)
    x = tuple(p[:, i] for i in range(shape.dim))

    def pushed(direction):
        along = tuple(jnp.broadcast_to(d, c.shape) for d, c in zip(direction, x, strict=True))
        return jax.jvp(shape.distance, x, along)

    return jax.vmap(pushed, out_axes=(None, 1))(jnp.eye(shape.dim, dtype=p.dtype))


_value_and_gradient = eqx.filter_jit(value_and_gradient)


def in_pieces(function: Callable[..., Any], size: int, *rows: np.ndarray) -> list[np.ndarray]:
    """Results of a compiled `function` of `rows`, at least one, as NumPy arrays.

    It gets `size` rows at a time, the last one again and again where they run out: one size
    means one compilation.
    """
    found = []
    for start in range(0, len(rows[0]), size):
        pieces = [row[start : start + size] for row in rows]
        true = len(pieces[0])
        if true < size:
            pad = np.minimum(np.arange(size), true - 1)
            pieces = [piece[pad] for piece in pieces]
        found.append((jax.tree.leaves(function(*pieces)), true))
    parts = [[np.asarray(leaf)[:true] for leaf in leaves] for leaves, true in found]
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def _as_given(points: np.ndarray) -> np.ndarray:
    # No `jnp.asarray`: the compiled call takes an array over faster as it is.
    return points.astype(jnp.result_type(float), copy=False)


def values(shape: AbstractSdf, points: np.ndarray) -> np.ndarray:
    """Field [m] at `points` (n, dim) [m]."""
    if not len(points):
        return np.zeros(0)
    (f,) = in_pieces(lambda p: _value(shape, p), CHUNK, _as_given(points))
    return f.astype(float)


def values_and_gradients(
    shape: AbstractSdf, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Field [m] and slope [-] at `points` (n, dim) [m]."""
    if not len(points):
        return np.zeros(0), np.zeros((0, shape.dim))
    f, g = in_pieces(lambda p: _value_and_gradient(shape, p), CHUNK, _as_given(points))
    return f.astype(float), g.astype(float)


def unit(vectors: np.ndarray) -> np.ndarray:
    """`vectors` (.., dim) of length one; zero ones stay."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def normals(shape: AbstractSdf, points: np.ndarray) -> np.ndarray:
    """Unit normals of the level sets through `points` (n, dim) [m]."""
    return unit(values_and_gradients(shape, points)[1])


def land(shape: AbstractSdf, points: np.ndarray, steps: int = 12) -> np.ndarray:
    """`points` moved onto the zero set along the slope, to rounding."""
    points = np.array(points, dtype=float)
    for _ in range(steps):
        f, g = values_and_gradients(shape, points)
        square = np.maximum((g * g).sum(axis=1), 1e-12)
        move = (f / square)[:, None] * g
        points -= move
        if np.abs(move).max(initial=0) <= 1e-15 * np.abs(points).max(initial=1e-300):
            break
    return points


def finite_box(where: str, shape: AbstractSdf, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Concrete bounding box of `shape`; raises where it is unknown, open or empty."""
    if shape.dim != dim:
        raise ValueError(
            f"{where}: the shape is {shape.dim}-D, need {dim}-D. Use a section of it or "
            "the function for its dimension."
        )
    if is_traced(shape):
        raise ValueError(
            f"{where}: the shape is traced, need concrete parameters, because the topology "
            "depends on them. Call it outside jit; derivatives follow mesh.move."
        )
    lower, upper = (np.asarray(corner, dtype=float) for corner in shape.bounding_box())
    if not np.all(np.isfinite(lower) & np.isfinite(upper)):
        raise ValueError(
            f"{where}: the shape is unbounded (box {lower} m to {upper} m), need a finite "
            "extent. Intersect it with a Rectangle or a Box."
        )
    if not np.all(upper > lower):
        raise ValueError(
            f"{where}: the shape is empty (box {lower} m to {upper} m), need an inside. "
            "Check that the parts of its intersection overlap."
        )
    return lower, upper


def connected(count: int, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Number of the connected part that each of `count` things is in, by pairs of them."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not count:
        return np.zeros(0, int)
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


class EmptyShape(ValueError):
    """No inside was found."""


def raise_empty(where: str, lower: np.ndarray, upper: np.ndarray, cell: float) -> NoReturn:
    raise EmptyShape(
        f"{where}: the shape is empty: no inside found between {lower} m and {upper} m at a "
        f"resolution of {cell:g} m. Check its signs (negative inside), or lower `size`."
    )


# Points of a shape: random ones inside and on the surface, and regular grids


_BATCH = 4096
_TRIES = 2000
_BAND = 5e-3  # of the extent: half the layer whose points are moved onto the surface


def sample_interior(
    shape: AbstractSdf, count: int, *, key: Key[Array, ""]
) -> Float[Array, "count dim"]:
    """`count` points spread evenly over the inside [m], by rejection.

    Args:
        shape: The shape.
        count: Number of points.
        key: Random key.

    Returns:
        Points [m].
    """
    return _collect("sample_interior", shape, count, key, _inside)


def sample_boundary(
    shape: AbstractSdf, count: int, *, key: Key[Array, ""]
) -> Float[Array, "count dim"]:
    """`count` points spread evenly over the surface [m].

    Points of a thin layer around the surface are moved onto it: even up to the square
    of curvature times 0.5 % of the extent.

    Args:
        shape: The shape.
        count: Number of points.
        key: Random key.

    Returns:
        Points [m].
    """
    return _collect("sample_boundary", shape, count, key, _landed)


def _inside(shape, points, extent):
    return points[values(shape, points) < 0]


def _landed(shape, points, extent):
    f, g = values_and_gradients(shape, points)
    slope = np.linalg.norm(g, axis=1)
    near = points[np.abs(f) <= _BAND * extent * slope]
    return land(shape, near)


def _collect(where, shape, count, key, choose):
    lower, upper = finite_box(where, shape, shape.dim)
    extent = float((upper - lower).max())
    found, total = [], 0
    margin = 2 * _BAND * extent
    for batch in range(_TRIES):
        if total >= count:
            break
        draw = jax.random.uniform(jax.random.fold_in(key, batch), (_BATCH, shape.dim))
        span = upper - lower + 2 * margin
        points = lower - margin + span * np.asarray(draw, dtype=float)
        found.append(choose(shape, points, extent))
        total += len(found[-1])
    if total < count:
        raise_empty(where, lower, upper, extent / (_TRIES * _BATCH) ** (1 / shape.dim))
    points = np.concatenate([*found, np.zeros((0, shape.dim))])[:count]
    return jnp.asarray(points, dtype=jnp.result_type(float))


def grid(shape: AbstractSdf, size: float) -> Float[Array, "*nodes dim"]:
    """Regular nodes [m] over the bounding box, at most `size` [m] apart along each axis.

    Args:
        shape: The shape.
        size: Largest distance of neighbours [m].

    Returns:
        Points [m], indexed along each axis.
    """
    if not size > 0:
        raise ValueError(f"grid: `size` must be positive, got {size} m. Give a distance.")
    lower, upper = finite_box("grid", shape, shape.dim)
    counts = np.ceil((upper - lower) / size - 1e-9).astype(int) + 1
    if np.prod(counts.astype(float)) > 1e9:
        raise ValueError(
            f"grid: {' x '.join(map(str, counts))} nodes are too many. Use a larger `size`."
        )
    axes = [np.linspace(a, b, n) for a, b, n in zip(lower, upper, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return jnp.asarray(nodes, dtype=jnp.result_type(float))
