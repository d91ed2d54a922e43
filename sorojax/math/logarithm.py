"""Logarithms of rigid motions, and how they change."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.math.lie import SE2, SE3, skew


def logarithm(group: SE2 | SE3, pose: Float[Array, "h h"]) -> Float[Array, " twist"]:
    """Body twist, angular first, that reaches `pose` in unit time; angle up to pi [rad].

    Smooth at the identity; where the angle is pi it picks one of two.

    Reference:
        Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1, 1978.
    """
    if isinstance(group, SE2):
        return _planar(pose)
    real, vector = _half_turn(pose[:3, :3])
    square = vector @ vector
    small = square < 1e-6
    sine = jnp.sqrt(jnp.where(small, jnp.ones_like(square), square))
    half = jnp.arctan2(sine, real)
    ratio = jnp.where(small, 2 + square / 3 + 3 * square**2 / 20, 2 * half / sine)
    omega = ratio * vector
    far = (1 - half * real / sine) / (4 * jnp.where(small, jnp.ones_like(half), half) ** 2)
    share = jnp.where(small, 1 / 12 + 4 * square / 720, far)
    turn, position = skew(omega), pose[:3, 3]
    swept = turn @ position
    return jnp.concatenate([omega, position - swept / 2 + share * (turn @ swept)])


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
    omega, v = skew(twist[:3]), skew(twist[3:])
    top = jnp.concatenate([omega, jnp.zeros_like(omega)], axis=1)
    adjoint = jnp.concatenate([top, jnp.concatenate([v, omega], axis=1)])
    second, fourth = _even_terms(twist[:3] @ twist[:3])
    square = adjoint @ adjoint
    eye = jnp.eye(6, dtype=twist.dtype)
    return eye - adjoint / 2 + square @ (second * eye + fourth * square)


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


def _even_terms(square: Array) -> tuple[Array, Array]:
    """Factors of the second and fourth power of the adjoint map at |omega|^2."""
    small = square < 0.02
    safe = jnp.where(small, jnp.ones_like(square), square)
    angle = jnp.sqrt(safe)
    sine, versine = jnp.sin(angle), 1 - jnp.cos(angle)
    second = 2 / safe - (angle + 3 * sine) / (4 * angle * versine)
    fourth = 1 / safe**2 - (angle + sine) / (4 * angle**3 * versine)
    near_second = 1 / 12 - square**2 / 30240 - square**3 / 604800
    near_fourth = -1 / 720 - square / 15120 - square**2 / 403200
    return jnp.where(small, near_second, second), jnp.where(small, near_fourth, fourth)


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
