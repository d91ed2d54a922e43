"""Planar and spatial rigid motions as leafless markers. Twists are angular first."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


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
