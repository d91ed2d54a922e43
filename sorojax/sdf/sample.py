"""Fields sampled on the host: two compiled kernels of fixed size per kind of shape."""

from typing import NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

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


def _chunks(points: np.ndarray):
    """Pieces of `points` padded to one length, with the number of true rows."""
    dtype = jnp.result_type(float)
    for start in range(0, len(points), CHUNK):
        piece = points[start : start + CHUNK]
        padded = np.concatenate([piece, np.repeat(piece[-1:], CHUNK - len(piece), axis=0)])
        yield jnp.asarray(padded, dtype=dtype), len(piece)


def values(shape: AbstractSdf, points: np.ndarray) -> np.ndarray:
    """Field [m] at `points` (n, dim) [m]."""
    if not len(points):
        return np.zeros(0)
    found = [np.asarray(_value(shape, p))[:n] for p, n in _chunks(points)]
    return np.concatenate(found).astype(float)


def values_and_gradients(
    shape: AbstractSdf, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Field [m] and slope [-] at `points` (n, dim) [m]."""
    if not len(points):
        return np.zeros(0), np.zeros((0, shape.dim))
    pairs = [(_value_and_gradient(shape, p), n) for p, n in _chunks(points)]
    f = np.concatenate([np.asarray(f)[:n] for (f, _), n in pairs]).astype(float)
    return f, np.concatenate([np.asarray(g)[:n] for (_, g), n in pairs]).astype(float)


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


class EmptyShape(ValueError):
    """No inside was found."""


def raise_empty(where: str, lower: np.ndarray, upper: np.ndarray, cell: float) -> NoReturn:
    raise EmptyShape(
        f"{where}: the shape is empty: no inside found between {lower} m and {upper} m at a "
        f"resolution of {cell:g} m. Check its signs (negative inside), or lower `size`."
    )
