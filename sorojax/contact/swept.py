"""What goes through an obstacle, or through another body, in a step."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.sdf.base import AbstractSdf

_MARCHES = 24
_CREEP = 0.05  # of the radius, the least step on the way out
_BETWEEN = (0.25, 0.5, 0.75)  # of the way behind the entry


def passes(
    obstacle: AbstractSdf,
    before: Float[Array, "points dim"],
    after: Float[Array, "points dim"],
    radius: Float[Array, "*points"] | None = None,
) -> Bool[Array, " points"]:
    """Whether points on straight ways from `before` to `after` [m] entered `obstacle` and
    are now, inside or behind it, nearer to another side than that which they came from.

    The entry is found by steps of the length of the field, which cannot jump over it, and
    so is the exit of balls, behind which another obstacle may stand.

    Args:
        obstacle: Its signed distance.
        before, after: Ends of the ways [m].
        radius: Of balls about the points [m]; the points themselves if omitted.

    Reference: Hart, "Sphere tracing", The Visual Computer 12, 1996.
    """
    move = after - before
    way = jnp.sqrt(jnp.sum(move**2, axis=1))
    sloped = jax.vmap(jax.value_and_grad(obstacle))
    (first, from_side), (last, to_side) = sloped(before), sloped(after)
    one = jnp.ones_like(way)
    reach = 0 * one if radius is None else radius * one
    first, last = first - reach, last - reach
    rate = 1 / jnp.where(way > 0, obstacle.lipschitz * way, one)  # shares of the way per field

    def field(share):
        return obstacle(before + share[:, None] * move) - reach

    def facing(share):
        return jax.vmap(jax.grad(obstacle))(before + share[:, None] * move)

    def inwards(_, share):
        return jnp.minimum(share + rate * jnp.maximum(field(share), jnp.zeros_like(way)), one)

    def outwards(_, share):
        depth = -field(share)
        ahead = jnp.where(depth > 0, jnp.maximum(depth, _CREEP * reach), jnp.zeros_like(way))
        return jnp.minimum(share + rate * ahead, one)

    def looked():
        entry = jax.lax.fori_loop(0, _MARCHES, inwards, jnp.zeros_like(way))
        came = facing(entry)
        enters = (entry < 1) & (jnp.sum(came * move, axis=1) < 0)
        stays = jnp.ones(way.shape, bool)
        for part in _BETWEEN:
            stays &= field(entry + part * (one - entry)) < 0
        behind = (jnp.sum(came * to_side, axis=1) < 0) & (stays | (last >= 0))
        if radius is not None:
            inside = jnp.minimum(entry + rate * _CREEP * reach, one)
            leaves = jax.lax.fori_loop(0, _MARCHES, outwards, inside)
            behind |= (leaves < 1) & (jnp.sum(came * facing(leaves), axis=1) < 0)
        return enters & behind

    # few points go so far that they may, and fewer end on another side
    near = obstacle.lipschitz * way >= jnp.maximum(first, jnp.zeros_like(first))
    turned = jnp.sum(from_side * to_side, axis=1) < 0.5 * obstacle.lipschitz**2
    far = obstacle.lipschitz * way >= first + 2 * reach if radius is not None else False
    could = jnp.any(near & (turned | far))
    return jax.lax.cond(could, looked, lambda: jnp.zeros(way.shape, bool))


def crosses(
    before: Float[Array, "points dim"],
    after: Float[Array, "points dim"],
    others_before: Float[Array, "others dim"],
    others_after: Float[Array, "others dim"],
    reach: Float[Array, " points"],
    allowed: Bool[Array, "points others"] | None = None,
) -> Bool[Array, ""]:
    """Whether any ball comes within `reach` [m] of another on their straight ways, and ends
    on the other side of it.

    Args:
        before, after: Ends of the ways of centres [m].
        others_before, others_after: Those of the other balls [m].
        reach: Sum of the radii [m].
        allowed: Which pairs can meet; all if omitted.
    """
    square = _products(before, others_before, before, others_before)
    move, others = after - before, others_after - others_before
    reach = jnp.broadcast_to(reach[:, None], square.shape)

    def looked():
        along = _products(before, others_before, move, others)
        length = _products(move, others, move, others)
        root = along**2 - length * (square - reach**2)
        meets = (along < 0) & (root >= 0)
        entry = (-along - jnp.sqrt(jnp.where(meets, root, 0.0))) / jnp.where(
            length > 0, length, 1.0
        )
        entry = jnp.maximum(entry, 0.0)
        # place at the entry times place at the end
        turned = square + (1 + entry) * along + entry * length < 0
        return jnp.any(_only(meets & (entry < 1) & turned, allowed, False))

    fastest = [jnp.max(jnp.sum(x**2, axis=1)) for x in (move, others)]
    way = jnp.sqrt(fastest[0]) + jnp.sqrt(fastest[1])
    nearest = _only(jnp.minimum(square, reach**2), allowed, jnp.inf)
    return jax.lax.cond(way**2 >= jnp.min(nearest), looked, lambda: jnp.zeros((), bool))


def _only(values, allowed, other):
    return values if allowed is None else jnp.where(allowed, values, other)


def _products(a, b, c, d) -> Float[Array, "points others"]:
    """(a_i - b_j) . (c_i - d_j)."""
    total = jnp.zeros((a.shape[0], b.shape[0]), a.dtype)
    for axis in range(a.shape[1]):
        first = a[:, None, axis] - b[None, :, axis]
        total = total + first * (c[:, None, axis] - d[None, :, axis])
    return total
