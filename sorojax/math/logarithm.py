"""Logarithms of rigid motions, and how they change."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.math.lie import SE2, SE3, skew

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
    rows = jnp.stack([
        jnp.stack([1 + a + e + i, x, y, z]),
        jnp.stack([x, 1 + a - e - i, b + d, c + g]),
        jnp.stack([y, b + d, 1 - a + e - i, f + h]),
        jnp.stack([z, c + g, f + h, 1 - a - e + i]),
    ])  # fmt: skip
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
    (x, y, z), (u, v, w) = a, b
    return jnp.stack([y * w - z * v, z * u - x * w, x * v - y * u])


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
    adjoint = jnp.stack([
        jnp.stack([o, o, o]), jnp.stack([y, o, -angle]), jnp.stack([-x, angle, o]),
    ])  # fmt: skip
    # adjoint^3 = -angle^2 adjoint
    small = jnp.abs(angle) < 1e-2
    safe = jnp.where(small, jnp.ones_like(angle), angle)
    far = (1 - _half_cotangent(safe)) / safe**2
    second = jnp.where(small, 1 / 12 + angle**2 / 720, far)
    return jnp.eye(3, dtype=twist.dtype) - adjoint / 2 + second * adjoint @ adjoint
