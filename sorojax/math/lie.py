"""Planar and spatial rigid motions (SE(2), SE(3)), twists angular first, and unit quaternions.

Quaternions are scalar first, as tuples of four arrays of any one shape: tuples of component
arrays fuse into few elementwise kernels, stacked arrays do not.
"""

import functools
import math
from typing import ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.math.quadrature import polynomial


class SE2(eqx.Module):
    """Planar rigid motions; twist `[omega, v_x, v_y]`."""

    algebra_dim: ClassVar[int] = 3
    space_dim: ClassVar[int] = 2
    rotation_dim: ClassVar[int] = 1

    def exp(self, twist: Float[Array, "3"]) -> Float[Array, "3 3"]:
        """Transform reached after unit time at constant body twist."""
        angle, v = twist[0], twist[1:]
        sine, versine, _ = _coefficients(angle**2)
        turn = jnp.array([[0.0, -1.0], [1.0, 0.0]], dtype=twist.dtype)
        eye = jnp.eye(2, dtype=twist.dtype)
        rotation = (1 - versine * angle**2) * eye + sine * angle * turn
        return homogeneous(rotation, (sine * eye + versine * angle * turn) @ v)


class SE3(eqx.Module):
    """Spatial rigid motions; twist `[omega_x, omega_y, omega_z, v_x, v_y, v_z]`."""

    algebra_dim: ClassVar[int] = 6
    space_dim: ClassVar[int] = 3
    rotation_dim: ClassVar[int] = 3

    def exp(self, twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
        """Transform reached after unit time at constant body twist."""
        omega, v = twist[:3], twist[3:]
        sine, versine, residue = _coefficients(omega @ omega)
        w = skew(omega)
        eye = jnp.eye(3, dtype=twist.dtype)
        rotation = eye + sine * w + versine * w @ w
        left_jacobian = eye + versine * w + residue * w @ w
        return homogeneous(rotation, left_jacobian @ v)


def skew(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Matrix of the cross product `vector x .`."""
    x, y, z = vector
    o = jnp.zeros_like(x)
    return jnp.stack([jnp.stack(row) for row in ([o, -z, y], [z, o, -x], [-y, x, o])])


def homogeneous(
    rotation: Float[Array, "*points dim dim"], position: Float[Array, "*points dim"]
) -> Float[Array, "*points h h"]:
    """Homogeneous matrices from rotations and positions [m]."""
    *points, dim = position.shape
    top = jnp.concatenate([rotation, position[..., None]], axis=-1)
    last = jnp.zeros((*points, 1, dim + 1), position.dtype).at[..., 0, dim].set(1)
    return jnp.concatenate([top, last], axis=-2)


def _coefficients(x: Float[Array, ""]) -> tuple[Array, Array, Array]:
    """sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3 as smooth functions of x = t^2."""
    # The branch not taken is differentiated too, so it must stay finite at zero.
    small = x < 1e-4
    safe = jnp.where(small, jnp.ones_like(x), x)
    angle = jnp.sqrt(safe)
    sine = jnp.sin(angle) / angle
    return (
        jnp.where(small, 1 - x / 6 + x**2 / 120, sine),
        jnp.where(small, 1 / 2 - x / 24 + x**2 / 720, 2 * (jnp.sin(angle / 2) / angle) ** 2),
        jnp.where(small, 1 / 6 - x / 120 + x**2 / 5040, (1 - sine) / safe),
    )


# Logarithms of rigid motions, and how they change


_NEAR = 0.02  # squared angle below which the factors are power series


def logarithm(group: SE2 | SE3, pose: Float[Array, "h h"]) -> Float[Array, " twist"]:
    """Body twist, angular first, that reaches `pose` in unit time; angle up to pi [rad].

    Smooth at the identity; where the angle is pi it picks one of two.

    Reference:
        Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1, 1978.
    """
    if isinstance(group, SE2):
        return _planar(pose)
    return _spatial(pose)[0]


def change_of_logarithm(
    group: SE2 | SE3, twist: Float[Array, " twist"]
) -> Float[Array, "twist twist"]:
    """How log(exp(d) exp(twist)) changes with a small d: the inverse left Jacobian.

    Reference:
        Selig, Geometric Fundamentals of Robotics, 2005, section 7.5, for the form in even
        powers of the adjoint map.
    """
    if isinstance(group, SE2):
        return _planar_change(twist)
    square = twist[:3] @ twist[:3]
    half = jnp.sqrt(jnp.where(square < _NEAR, jnp.ones_like(square), square)) / 2
    return _change(twist, *_even_terms(square, half, jnp.cos(half), jnp.sin(half)))


def logarithm_and_change(
    group: SE2 | SE3, pose: Float[Array, "h h"]
) -> tuple[Float[Array, " twist"], Float[Array, "twist twist"]]:
    """`logarithm` and `change_of_logarithm` of what it gives, which share their angle."""
    if isinstance(group, SE2):
        twist = _planar(pose)
        return twist, _planar_change(twist)
    twist, second, fourth = _spatial(pose)
    return twist, _change(twist, second, fourth)


def _spatial(pose: Float[Array, "4 4"]) -> tuple[Float[Array, "6"], Array, Array]:
    """The twist, and the factors of its change."""
    real, vector = _half_turn(pose[:3, :3])
    square = vector @ vector
    small = square < 1e-6
    sine = jnp.sqrt(jnp.where(small, jnp.ones_like(square), square))
    half = jnp.arctan2(sine, real)
    ratio = jnp.where(small, 2 + square / 3 + 3 * square**2 / 20, 2 * half / sine)
    omega, position = ratio * vector, pose[:3, 3]
    second, fourth = _even_terms(ratio**2 * square, half, real, sine)
    swept = _cross(omega, position)
    moved = position - swept / 2 + second * _cross(omega, swept)
    return jnp.concatenate([omega, moved]), second, fourth


def _change(twist: Float[Array, "6"], second: Array, fourth: Array) -> Float[Array, "6 6"]:
    """The blocks of 1 - A / 2 + second A^2 + fourth (A^4 + |omega|^2 A^2), A = ad(twist)."""
    omega, v, eye = twist[:3], twist[3:], jnp.eye(3, dtype=twist.dtype)
    square, along = jnp.sum(omega * omega), jnp.sum(omega * v)
    turned = omega[:, None] * omega[None, :] - square * eye
    mixed = omega[:, None] * v[None, :]
    mixed = mixed + mixed.T - 2 * along * eye
    turn = eye - skew(omega) / 2 + second * turned
    shift = second * mixed - skew(v) / 2 - 2 * along * fourth * turned
    top = jnp.concatenate([turn, jnp.zeros_like(turn)], axis=1)
    return jnp.concatenate([top, jnp.concatenate([shift, turn], axis=1)])


def _half_turn(rotation: Float[Array, "3 3"]) -> tuple[Array, Float[Array, "3"]]:
    """Unit quaternion with a real part that is not negative."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    x, y, z = h - f, c - g, d - b
    rows = jnp.stack(
        [
            jnp.stack([1 + a + e + i, x, y, z]),
            jnp.stack([x, 1 + a - e - i, b + d, c + g]),
            jnp.stack([y, b + d, 1 - a + e - i, f + h]),
            jnp.stack([z, c + g, f + h, 1 - a - e + i]),
        ]
    )
    row = rows[jnp.argmax(jnp.diagonal(rows))]
    unit = row / jnp.sqrt(row @ row)
    unit = jnp.where(unit[0] < 0, -unit, unit)
    return unit[0], unit[1:]


def _even_terms(square: Array, half: Array, real: Array, sine: Array) -> tuple[Array, Array]:
    """Factors of `_change` at |omega|^2, from half the angle, its cosine and its sine."""
    near = square < _NEAR
    one = jnp.ones_like(square)
    half, sine = jnp.where(near, one, half), jnp.where(near, one, sine)
    second = (1 - half * real / sine) / (4 * half**2)
    fourth = (1 - half * (half + sine * real) / (2 * sine**2)) / (16 * half**4)
    near_second = 1 / 12 + square / 720 + square**2 / 30240 + square**3 / 1209600
    near_fourth = -1 / 720 - square / 15120 - square**2 / 403200 - square**3 / 11975040
    return jnp.where(near, near_second, second), jnp.where(near, near_fourth, fourth)


def _cross(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    return jnp.stack(cross(tuple(a), tuple(b)))  # type: ignore[arg-type]


def _planar(pose: Float[Array, "3 3"]) -> Float[Array, "3"]:
    angle = jnp.arctan2(pose[1, 0], pose[0, 0])
    scale = _half_cotangent(angle)
    x, y = pose[:2, 2]
    return jnp.stack([angle, scale * x + angle / 2 * y, scale * y - angle / 2 * x])


def _half_cotangent(angle: Array) -> Array:
    """(t / 2) cot(t / 2)."""
    small = jnp.abs(angle) < 1e-2
    half = jnp.where(small, jnp.ones_like(angle), angle / 2)
    return jnp.where(small, 1 - angle**2 / 12 - angle**4 / 720, half / jnp.tan(half))


def _planar_change(twist: Float[Array, "3"]) -> Float[Array, "3 3"]:
    angle, x, y = twist
    o = jnp.zeros_like(x)
    adjoint = jnp.stack(
        [jnp.stack([o, o, o]), jnp.stack([y, o, -angle]), jnp.stack([-x, angle, o])]
    )
    # adjoint^3 = -angle^2 adjoint
    small = jnp.abs(angle) < 1e-2
    safe = jnp.where(small, jnp.ones_like(angle), angle)
    far = (1 - _half_cotangent(safe)) / safe**2
    second = jnp.where(small, 1 / 12 + angle**2 / 720, far)
    return jnp.eye(3, dtype=twist.dtype) - adjoint / 2 + second * adjoint @ adjoint


# Unit quaternions, scalar first, as tuples of four arrays of any one shape


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


def quaternion_rate(omega: Float[Array, "3"], q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Rate of a quaternion at an angular velocity in axes of the world."""
    turning = (jnp.zeros_like(omega[0]), omega[0] / 2, omega[1] / 2, omega[2] / 2)
    return jnp.stack(multiply(turning, (q[0], q[1], q[2], q[3])))


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
    twice_x, twice_y, twice_z = 2 * x, 2 * y, 2 * z
    xx, yy, zz = twice_x * x, twice_y * y, twice_z * z
    xy, xz, yz = twice_x * y, twice_x * z, twice_y * z
    wx, wy, wz = twice_x * w, twice_y * w, twice_z * w
    return (
        (1 - (yy + zz), xy + wz, xz - wy),
        (xy - wz, 1 - (xx + zz), yz + wx),
        (xz + wy, yz - wx, 1 - (xx + yy)),
    )


def rotation_matrix(q: Quaternion | Float[Array, "4"]) -> Float[Array, "3 3"]:
    """That of a unit quaternion."""
    w, x, y, z = q
    return jnp.stack([jnp.stack(column) for column in rotation_columns((w, x, y, z))], axis=1)


def plane_rotation(angle: Float[Array, "*points"]) -> Float[Array, "*points 2 2"]:
    """Matrices of rotations in the plane by angles [rad]."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    columns = jnp.stack([cosine, sine], axis=-1), jnp.stack([-sine, cosine], axis=-1)
    return jnp.stack(columns, axis=-1)


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
    return polynomial(coefficients, x)


@_series.defjvp
def _series_jvp(coefficients, primals, tangents):
    slope = tuple(k * c for k, c in enumerate(coefficients))[1:] or (0.0,)
    return _series(coefficients, *primals), _series(slope, *primals) * tangents[0]


# Rotation of a frame whose curvature varies along a cell, by a Magnus expansion


# Coefficients of the expansion (rows) from the moments B_j, h^-j times the integral of
# (s - s_mid)^j kappa(s) over a cell of length h, for j = 0, 1, 2 (columns).
FROM_MOMENTS = np.array([[9 / 4, 0.0, -15.0], [0.0, 12.0, 0.0], [-15.0, 0.0, 180.0]])


def rotation_vector(coefficients: tuple[Vector, Vector, Vector]) -> Vector:
    """Rotation vector of the solution of R' = R hat(kappa) over one cell, order 6.

    Args:
        coefficients: `FROM_MOMENTS` times the moments of the curvature, each as three
            components [rad].

    Reference:
        Blanes, Casas, Oteo, Ros, The Magnus expansion, Physics Reports 470, 2009;
        the bracket has the sign of right multiplication.
    """
    a1, a2, a3 = coefficients
    c1 = cross(a2, a1)
    c2 = cross(tuple(a + c / 2 for a, c in zip(a3, c1, strict=True)), a1)  # type: ignore[arg-type]
    right = tuple(a - c / 30 for a, c in zip(a2, c2, strict=True))
    left = tuple(c - 20 * a - b for a, b, c in zip(a1, a3, c1, strict=True))
    turn = cross(right, left)  # type: ignore[arg-type]
    x, y, z = (a + b / 12 + c / 240 for a, b, c in zip(a1, a3, turn, strict=True))
    return x, y, z
