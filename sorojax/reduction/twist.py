"""Strain of a row of section poses: twists from pose to pose, safe at any turn."""

import jax.numpy as jnp
from jaxtyping import Array, Float

_ITERATIONS = 5


def pose_strain(
    rotation: Float[Array, "samples 3 3"],
    position: Float[Array, "samples 3"],
    step: Float[Array, ""],
) -> Float[Array, "samples 6"]:
    """Curvatures and stretch and shears of equally spaced sections, order 2 in `step` [m].

    A constant strain is found exactly at any step, as long as the sections turn by less
    than pi between neighbours but one.
    """
    inner = twist(rotation[:-2], position[:-2], rotation[2:], position[2:]) / (2 * step)
    ends = (slice(0, 2), slice(1, 3)), (slice(-2, None), slice(-3, -1))
    first, last = (
        3 / 2 * _between(rotation[near], position[near], step)
        - 1 / 2 * _between(rotation[far], position[far], step)
        for near, far in ends
    )
    return jnp.concatenate([first, inner, last])


def _between(rotation, position, step) -> Float[Array, "1 6"]:
    return twist(rotation[:1], position[:1], rotation[1:], position[1:]) / step


def twist(
    turn_a: Float[Array, "n 3 3"],
    place_a: Float[Array, "n 3"],
    turn_b: Float[Array, "n 3 3"],
    place_b: Float[Array, "n 3"],
) -> Float[Array, "n 6"]:
    """Logarithm of the motion from pose a to pose b in the axes of a, angular first."""
    turn = jnp.einsum("nki,nkj->nij", turn_a, turn_b)
    path = jnp.einsum("nki,nk->ni", turn_a, place_b - place_a)
    vector, angle2 = _rotation_vector(turn)
    once = jnp.cross(vector, path)
    # 1/t^2 - (1 + cos t) / (2 t sin t), the inverse of the left Jacobian.
    small = angle2 < 1e-4
    safe = jnp.where(small, jnp.ones_like(angle2), angle2)
    angle = jnp.sqrt(safe)
    exact = (1 - angle / 2 / jnp.tan(angle / 2)) / safe
    beta = jnp.where(small, 1 / 12 + angle2 / 720, exact)
    linear = path - once / 2 + beta[:, None] * jnp.cross(vector, once)
    return jnp.concatenate([vector, linear], axis=1)


def _rotation_vector(turn: Float[Array, "n 3 3"]):
    """Rotation vectors [rad] and their squared lengths, smooth at zero."""
    axis = jnp.stack(
        [
            turn[:, 2, 1] - turn[:, 1, 2],
            turn[:, 0, 2] - turn[:, 2, 0],
            turn[:, 1, 0] - turn[:, 0, 1],
        ],
        axis=1,
    )
    axis = axis / 2
    cosine = (jnp.trace(turn, axis1=1, axis2=2) - 1) / 2
    square = jnp.sum(axis**2, axis=1)
    small = (square < 1e-8) & (cosine > 0)
    sine = jnp.sqrt(jnp.where(small, jnp.ones_like(square), square))
    ratio = jnp.where(small, 1 + square / 6, jnp.arctan2(sine, cosine) / sine)
    vector = ratio[:, None] * axis
    return vector, jnp.sum(vector**2, axis=1)


def nearest_rotation(columns: Float[Array, "n 3 3"]) -> Float[Array, "n 3 3"]:
    """Polar factor of matrices near a rotation, with derivatives where stretches agree."""
    for _ in range(_ITERATIONS):
        a, b, c = (columns[:, :, k] for k in range(3))
        cofactor = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=2)
        volume = jnp.sum(a * cofactor[:, :, 0], axis=1)
        columns = (columns + cofactor / volume[:, None, None]) / 2
    return columns


def section_axes(
    along_y: Float[Array, "n 3"], along_z: Float[Array, "n 3"]
) -> Float[Array, "n 3 3"]:
    """Section frames nearest to two fibres that a deformation has moved."""
    normal = jnp.cross(along_y, along_z)
    sides = (normal, along_y, along_z)
    return nearest_rotation(jnp.stack([_unit(side) for side in sides], axis=2))


def _unit(vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return vectors / jnp.sqrt(jnp.sum(vectors**2, axis=1, keepdims=True))
