"""Which points can be left out because an obstacle is far away."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.sdf.base import AbstractSdf


def far(
    obstacle: AbstractSdf,
    points: Float[Array, "*points dim"],
    reach: Float[Array, ""] | None = None,
) -> Bool[Array, ""]:
    """Whether none of `points` [m] can lie inside `obstacle`, by one value of its field; or
    within `reach` [m] of it.

    A field changes by at most its Lipschitz constant per length, so a field at the centre
    of a ball above that constant times the radius is positive in the whole ball. `False`
    may also mean that it is not known.
    """
    return clearance(obstacle, points, reach) > 0


def clearance(
    obstacle: AbstractSdf,
    points: Float[Array, "*points dim"],
    reach: Float[Array, ""] | None = None,
) -> Float[Array, ""]:
    """How far all of `points` [m] may move at least before one lies inside `obstacle`, or
    within `reach` [m] of it, by one value of its field; what is not positive says nothing."""
    flat = points.reshape(-1, points.shape[-1])
    low, high = jnp.min(flat, axis=0), jnp.max(flat, axis=0)
    centre = (low + high) / 2
    radius = jnp.sqrt(jnp.max(jnp.sum((flat - centre[None]) ** 2, axis=1)))
    bound = obstacle.lipschitz
    room = obstacle(centre) / bound - radius
    return room if reach is None else room - reach / bound
