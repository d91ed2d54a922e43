"""Points that go through an obstacle in a step."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.sdf.base import AbstractSdf

_MARCHES = 24
_BETWEEN = (0.25, 0.5, 0.75)  # of the way behind the entry


def passes(
    obstacle: AbstractSdf,
    before: Float[Array, "points dim"],
    after: Float[Array, "points dim"],
) -> Bool[Array, " points"]:
    """Whether points on straight ways from `before` to `after` [m] entered `obstacle` and
    are now, inside or behind it, nearer to another side than that which they came from.

    The entry is found by steps of the length of the field, which cannot jump over it.

    Reference: Hart, "Sphere tracing", The Visual Computer 12, 1996.
    """
    move = after - before
    way = jnp.sqrt(jnp.sum(move**2, axis=1))
    sloped = jax.vmap(jax.value_and_grad(obstacle))
    (first, from_side), (last, to_side) = sloped(before), sloped(after)
    one = jnp.ones_like(way)
    rate = 1 / jnp.where(way > 0, obstacle.lipschitz * way, one)  # shares of the way per field

    def field(share):
        return obstacle(before + share[:, None] * move)

    def march(_, share):
        outside = jnp.maximum(field(share), jnp.zeros_like(share))
        return jnp.minimum(share + rate * outside, one)

    def looked():
        entry = jax.lax.fori_loop(0, _MARCHES, march, jnp.zeros_like(way))
        _, came = sloped(before + entry[:, None] * move)
        enters = (entry < 1) & (jnp.sum(came * move, axis=1) < 0)
        stays = jnp.ones(way.shape, bool)
        for part in _BETWEEN:
            stays &= field(entry + part * (one - entry)) < 0
        return enters & (jnp.sum(came * to_side, axis=1) < 0) & (stays | (last >= 0))

    # few points go so far that they may, and fewer end on another side
    near = obstacle.lipschitz * way >= jnp.maximum(first, jnp.zeros_like(first))
    turned = jnp.sum(from_side * to_side, axis=1) < 0.5 * obstacle.lipschitz**2
    could = jnp.any(near & turned)
    return jax.lax.cond(could, looked, lambda: jnp.zeros(way.shape, bool))
