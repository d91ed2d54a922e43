"""Fields of many points at full speed: compiled once per power of two.

A field made of scalars becomes one loop per output, which reads the coordinates and
writes the result; a field that searches or holds a table per point goes in chunks that
stay in the cache.
"""

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.math.jit import once
from sorojax.sdf.base import AbstractSdf, cast
from sorojax.sdf.query import slope_along, value_and_gradient_at

LARGEST = 2**20  # points in one call of a compiled program
_CHUNK = 2**13  # points of a field that is more than one loop

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
    return _scalars(jax.make_jaxpr(shape.distance)(*x).jaxpr, len(x[0]))


def _scalars(program: Jaxpr, count: int) -> bool:
    for step in program.eqns:
        if step.primitive.name in ("while", "scan", "gather"):
            return False
        if any(getattr(var.aval, "size", 0) > count for var in step.outvars):
            return False
        inner = (v.jaxpr if isinstance(v, ClosedJaxpr) else v for v in step.params.values())
        if not all(_scalars(v, count) for v in inner if isinstance(v, Jaxpr)):
            return False
    return True


def _in_chunks(function, x: Coordinates):
    """`function(x)` a chunk at a time; coordinates apart are contiguous, which is fast."""
    x = jax.lax.optimization_barrier(x)
    count = len(x[0])
    pieces = tuple(c.reshape(-1, min(_CHUNK, count)) for c in x)
    return jax.tree.map(lambda a: a.reshape(count), jax.lax.map(function, pieces))


@once
def _value(shape: AbstractSdf, points):
    shape = cast(shape, points.dtype)
    x = tuple(points[:, i] for i in range(shape.dim))
    if _is_one_loop(shape, x):
        return shape.distance(*x)
    return _in_chunks(lambda x: shape.distance(*x), x)


def _value_and_normal(shape: AbstractSdf, points):
    # Programs of their own: in one, reordering joins their loops, which lose their vector form.
    f, normals = _normals(shape, _columns(points))
    return f, _rows(normals)


def _normals(shape: AbstractSdf, x: Coordinates):
    f, slopes = _value_and_slopes(shape, x)
    return f, _unit(slopes)


@jax.jit
def _columns(points):
    across = jax.lax.optimization_barrier(points.T)
    return tuple(across[i] for i in range(points.shape[1]))


@jax.jit
def _rows(components):
    return jnp.stack(components).T


@once
def _value_and_slopes(shape: AbstractSdf, x: Coordinates):
    shape = cast(shape, x[0].dtype)
    if not _is_one_loop(shape, x):
        return _in_chunks(lambda x: value_and_gradient_at(shape, x), x)
    f, slopes = shape.distance(*x), []
    for i in range(shape.dim):
        # Roots shared by the passes would be written to memory: each has its own.
        x = jax.lax.optimization_barrier(x)
        slopes.append(slope_along(shape, x, i)[1])
    return f, tuple(slopes)


@jax.jit
def _unit(slopes: Coordinates) -> Coordinates:
    """The vector of `slopes` at length one; zero stays zero."""
    units = []
    for i in range(len(slopes)):
        slopes = jax.lax.optimization_barrier(slopes)
        square = sum((g * g for g in slopes[1:]), start=slopes[0] * slopes[0])
        some = square > 0
        scale = jax.lax.rsqrt(jnp.where(some, square, jnp.ones_like(square)))
        units.append(jnp.where(some, slopes[i] * scale, jnp.zeros_like(square)))
    return tuple(units)
