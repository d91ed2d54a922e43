"""Broad phase by balls: bodies that cannot touch, found by one number each."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.sdf.base import AbstractSdf


def ball(points: Float[Array, "points dim"]) -> tuple[Array, Array]:
    """Centre and radius [m] of a ball that holds all `points` [m]."""
    centre = (jnp.min(points, axis=0) + jnp.max(points, axis=0)) / 2
    square = jnp.sum((points - centre[None]) ** 2, axis=1)
    return centre, jnp.sqrt(jnp.max(square))


def near(
    obstacle: AbstractSdf, centre: Float[Array, " dim"], radius: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether a ball may reach into `obstacle`; `False` is certain, `True` is not.

    A field changes by at most its Lipschitz constant per length.
    """
    return obstacle(centre) <= obstacle.lipschitz * radius
