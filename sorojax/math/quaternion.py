"""Unit quaternions, scalar first, as tuples of four arrays of any one shape.

Tuples of component arrays fuse into few elementwise kernels; stacked arrays do not.
"""

import functools
import math
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Vector: TypeAlias = tuple[Array, Array, Array]
Quaternion: TypeAlias = tuple[Array, Array, Array, Array]

_TERMS = 10
_COSINE = tuple((-1) ** k / math.factorial(2 * k) for k in range(_TERMS))
_SINC = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(_TERMS))


def cross(a: Vector, b: Vector) -> Vector:
    """Cross product of vectors given by components."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def cross_columns(a: Array, b: Array) -> Array:
    """Cross product along axis 1 of arrays."""
    # Reverse mode makes one array of the parts of an `unstack`, and one of each slice.
    return jnp.stack(cross(jnp.unstack(a, axis=1), jnp.unstack(b, axis=1)), axis=1)  # type: ignore[arg-type]


def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product: first rotate by `q`, then by `p`."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


def exponential(vector: Vector) -> Quaternion:
    """Quaternion of the rotation vector `vector` [rad], smooth at zero.

    Cosine and sinc are power series in |vector|^2 / 4: no root, no branch, no division,
    so every derivative at zero is exact. Accurate to round-off up to about 3 rad.
    """
    x = (vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2) / 4
    half_sinc = _series(_SINC, x) / 2
    return (_series(_COSINE, x), *(half_sinc * v for v in vector))  # type: ignore[return-value]


def rotation_columns(q: Quaternion) -> tuple[Vector, Vector, Vector]:
    """Columns of the rotation matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def prefix_product(q: Quaternion) -> Quaternion:
    """Running products q_0, q_0 q_1, ... along the only axis, of shape (points,)."""
    # Written out, XLA repeats the chain in every entry from nine points on.

    def advance(current, factor):
        product = multiply(current, factor)
        return product, product

    one, zero = jnp.ones_like(q[0][0]), jnp.zeros_like(q[0][0])
    return jax.lax.scan(advance, (one, zero, zero, zero), q)[1]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _series(coefficients: tuple[float, ...], x: Float[Array, "..."]) -> Float[Array, "..."]:
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


@_series.defjvp
def _series_jvp(coefficients, primals, tangents):
    slope = tuple(k * c for k, c in enumerate(coefficients))[1:] or (0.0,)
    return _series(coefficients, *primals), _series(slope, *primals) * tangents[0]
