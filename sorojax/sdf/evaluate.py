"""Fields of many points at full speed: compiled once per power of two."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.sdf.base import AbstractSdf, cast
from sorojax.sdf.query import value_and_gradient_at
from sorojax.sdf.scalar import norm, quotient

LARGEST = 2**20  # points in one call of a compiled program
_CHUNK = 2**13  # points whose derivatives stay in the cache


def evaluate(shape: AbstractSdf, points: Float[Array, "points dim"]) -> Float[Array, " points"]:
    """Field [m] at many `points` [m]: as `shape(points)`, compiled once for any number.

    The number is padded to a power of two; above 2^20 points come in blocks.
    """
    return _blocks(_value, shape, points)


def value_and_normal(
    shape: AbstractSdf, points: Float[Array, "points dim"]
) -> tuple[Float[Array, " points"], Float[Array, "points dim"]]:
    """Field [m] and unit normal at many `points` [m], as `evaluate`."""
    return _blocks(_value_and_normal, shape, points)


def _blocks(kernel, shape: AbstractSdf, points):
    points = real(points)
    if points.ndim != 2 or points.shape[1] != shape.dim:
        raise ValueError(
            f"evaluate: points have shape {points.shape}, need (points, {shape.dim}). "
            "Reshape them to one row per point."
        )
    count = len(points)
    if count and count == min(_padded(count), LARGEST):
        return kernel(shape, points)
    found = []
    for start in range(0, count, LARGEST):
        piece = points[start : start + LARGEST]
        rows = _padded(len(piece))
        filled = jnp.pad(piece, ((0, rows - len(piece)), (0, 0)), mode="edge")
        result, true = kernel(shape, filled), len(piece)
        found.append(jax.tree.map(lambda a, true=true: a[:true], result))
    if not found:
        return jax.tree.map(
            lambda a: a[:0], kernel(shape, jnp.zeros_like(points, shape=(1, shape.dim)))
        )
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)


def _padded(count: int) -> int:
    return 1 << max(0, count - 1).bit_length() if count else 0


@eqx.filter_jit
def _value(shape: AbstractSdf, points):
    return shape(points)


@eqx.filter_jit
def _value_and_normal(shape: AbstractSdf, points):
    shape = cast(shape, points.dtype)
    count = len(points)
    chunk = min(_CHUNK, count)

    # Apart, the coordinates are contiguous, which is what makes the loops fast.
    x = tuple(points[:, i].reshape(-1, chunk) for i in range(shape.dim))
    x = jax.lax.optimization_barrier(x)
    f, slopes = jax.lax.map(lambda x: value_and_gradient_at(shape, x), x)
    # In a loop of its own: fused with others, each component would repeat all the work.
    scale = jax.lax.map(lambda g: quotient(jnp.ones_like(g[0]), norm(*g)), slopes)
    normals = jnp.stack([(g * scale).reshape(count) for g in slopes], axis=-1)
    return f.reshape(count), normals
