"""Points of a shape: random ones inside and on the surface, and regular grids."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import finite_box, land, raise_empty, values, values_and_gradients

_BATCH = 4096
_TRIES = 2000
_BAND = 5e-3  # of the extent: half the layer whose points are moved onto the surface


def sample_interior(
    shape: AbstractSdf, count: int, *, key: Key[Array, ""]
) -> Float[Array, "count dim"]:
    """`count` points spread evenly over the inside [m], by rejection."""
    return _collect("sample_interior", shape, count, key, _inside)


def sample_boundary(
    shape: AbstractSdf, count: int, *, key: Key[Array, ""]
) -> Float[Array, "count dim"]:
    """`count` points spread evenly over the surface [m].

    Points of a thin layer around the surface are moved onto it: even up to the square
    of curvature times 0.5 % of the extent.
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
    """Regular nodes [m] over the bounding box, at most `size` [m] apart along each axis."""
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
