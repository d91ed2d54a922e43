"""Fields of many points at full speed: compiled once per power of two.

A field made of scalars becomes one loop per output, which reads the coordinates and
writes the result; normals of rows, and a field that searches or holds a table per point,
go in chunks that stay in the cache.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._jax.jit import once
from sorojax._jax.programs import is_one_loop
from sorojax._types import platform, real
from sorojax.math.apart import Alone, apart
from sorojax.sdf.base import AbstractSdf, cast
from sorojax.sdf.query import slope_along, value_and_gradient_at

LARGEST = 2**20  # points in one call of a compiled program
_CHUNK = 2**13  # points of a field that is more than one loop
_WIDE = 2**16  # rows whose columns and slopes are held at a time

Coordinates = tuple[Float[Array, " points"], ...]


def evaluate(shape: AbstractSdf, points: Float[Array, "points dim"]) -> Float[Array, " points"]:
    """Field [m] at many `points` [m]: as `shape(points)`, compiled once for any number.

    The number is padded to a power of two; above 2^20 points come in blocks.
    """
    return _blocks(_value, shape, _checked(shape, points))


def value_and_normal(
    shape: AbstractSdf, points: Float[Array, "points dim"]
) -> tuple[Float[Array, " points"], Float[Array, "points dim"]]:
    """Field [m] and unit normal at many `points` [m], as `evaluate`."""
    return _blocks(_value_and_normal, shape, _checked(shape, points))


def value_and_normal_at(
    shape: AbstractSdf, x: Coordinates
) -> tuple[Float[Array, " points"], Coordinates]:
    """As `value_and_normal` on one array per coordinate, which saves to rearrange them."""
    x = tuple(real(c) for c in x)
    if len(x) != shape.dim or any(c.ndim != 1 or c.shape != x[0].shape for c in x):
        raise ValueError(
            f"value_and_normal_at: got arrays of shape {[c.shape for c in x]}, need "
            f"{shape.dim} of one length. Give one array per coordinate."
        )
    return _blocks(_normals, shape, x)


def _checked(shape: AbstractSdf, points) -> Float[Array, "points dim"]:
    points = real(points)
    if points.ndim != 2 or points.shape[1] != shape.dim:
        raise ValueError(
            f"evaluate: points have shape {points.shape}, need (points, {shape.dim}). "
            "Reshape them to one row per point."
        )
    return points


def _blocks(kernel, shape: AbstractSdf, points):
    """`kernel(shape, points)` on padded blocks of `points`, an array or one per axis."""
    count = len(jax.tree.leaves(points)[0])
    if count and count == min(_padded(count), LARGEST):
        return kernel(shape, points)
    found = []
    for start in range(0, max(count, 1), LARGEST):
        true = min(LARGEST, count - start)
        piece = jax.tree.map(lambda a, start=start: _fill(a[start : start + LARGEST]), points)
        found.append(jax.tree.map(lambda a, true=true: a[:true], kernel(shape, piece)))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)


def _padded(count: int) -> int:
    return 1 << max(0, count - 1).bit_length()


def _fill(piece: Array) -> Array:
    """`piece` up to a power of two, with copies of its last row (zeros where it has none)."""
    rest = [(0, _padded(len(piece)) - len(piece))] + [(0, 0)] * (piece.ndim - 1)
    return jnp.pad(piece, rest, mode="edge" if len(piece) else "constant")


def _is_one_loop(shape: AbstractSdf, x: Coordinates) -> bool:
    """Whether the field is made of scalars alone: no search, no table of a row per point."""
    return is_one_loop(shape.distance, *x)


def _in_chunks(function, points, width: int):
    """`function(points)` at most `width` points at a time."""
    count = len(jax.tree.leaves(points)[0])
    pieces = jax.tree.map(lambda a: a.reshape(-1, min(width, count), *a.shape[1:]), points)
    found = jax.lax.map(function, pieces)
    return jax.tree.map(lambda a: a.reshape(count, *a.shape[2:]), found)


def _in_small_chunks(function, x: Coordinates):
    """For fields of more than one loop; coordinates apart are contiguous, which is fast."""
    return _in_chunks(function, jax.lax.optimization_barrier(x), _CHUNK)


@once
def _value(shape: AbstractSdf, points):
    shape = cast(shape, points.dtype)
    x = tuple(points[:, i] for i in range(shape.dim))
    if _is_one_loop(shape, x):
        return shape.distance(*x)
    return _in_small_chunks(lambda x: shape.distance(*x), x)


def _value_and_normal(shape: AbstractSdf, points):
    return _rows(shape, points, np.True_)


@once
def _rows(shape: AbstractSdf, points, always):
    """Field and normals of rows, a chunk at a time: columns and slopes stay in the cache, and
    results alone are new memory, whose first touch costs as much as the arithmetic."""
    shape = cast(shape, points.dtype)
    alone: Alone = apart(always) if platform() == "cpu" else lambda work: work()
    one_loop = _is_one_loop(shape, tuple(points.T))

    def chunk(points):
        x = alone(lambda: tuple(points.T))
        if one_loop:
            f = alone(lambda: shape.distance(*x))
            slopes = tuple(
                alone(lambda i=i: slope_along(shape, x, i)[1]) for i in range(shape.dim)
            )
        else:
            f, slopes = value_and_gradient_at(shape, x)
        scale = alone(lambda: _unit_scale(slopes))
        return f, alone(lambda: jnp.stack([g * scale for g in slopes], axis=1))

    wide = _WIDE if platform() == "cpu" else len(points)
    return _in_chunks(chunk, points, wide if one_loop else _CHUNK)


def _normals(shape: AbstractSdf, x: Coordinates):
    # Programs of their own: in one, reordering joins their loops, which lose their vector form.
    f, slopes = _value_and_slopes(shape, x)
    return f, _scaled(slopes, _unit_scale(slopes))


@once
def _value_and_slopes(shape: AbstractSdf, x: Coordinates):
    shape = cast(shape, x[0].dtype)
    if not _is_one_loop(shape, x):
        return _in_small_chunks(lambda x: value_and_gradient_at(shape, x), x)
    f, slopes = shape.distance(*x), []
    for i in range(shape.dim):
        # Roots shared by the passes would be written to memory: each has its own.
        x = jax.lax.optimization_barrier(x)
        slopes.append(slope_along(shape, x, i)[1])
    return f, tuple(slopes)


@jax.jit
def _scaled(slopes: Coordinates, scale: Array) -> Coordinates:
    return tuple(g * scale for g in slopes)


@jax.jit
def _unit_scale(slopes: Coordinates) -> Array:
    """One over the length of the vector of `slopes`, zero where that is zero."""
    square = functools.reduce(jnp.add, (g * g for g in slopes))
    some = square > 0
    scale = jax.lax.rsqrt(jnp.where(some, square, jnp.ones_like(square)))
    return jnp.where(some, scale, jnp.zeros_like(square))
