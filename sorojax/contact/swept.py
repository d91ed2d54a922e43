"""Whether points pass through an obstacle, or through another body, in a step."""

from typing import NamedTuple

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
    before: Float[Array, "ends dim"],
    after: Float[Array, "ends dim"],
    others_before: Float[Array, "others dim"],
    others_after: Float[Array, "others dim"],
    reach: Float[Array, ""],
    allowed: Bool[Array, "ends others"] | None = None,
) -> Bool[Array, ""]:
    """Whether two lines of straight pieces went through each other: a ball on one came within
    `reach` of one on the other on their straight ways, and ends on the other side of it, or
    the lines themselves cross now.

    Args:
        before, after: Ends of the pieces of one line, in order [m].
        others_before, others_after: Those of the other.
        reach: Sum of the radii [m].
        allowed: Which pairs can meet; all if omitted.
    """
    square = products(before, others_before, before, others_before)
    move, others = after - before, others_after - others_before

    def looked():
        along = products(before, others_before, move, others)
        length = products(move, others, move, others)
        root = along**2 - length * (square - reach**2)
        meets = (along < 0) & (root >= 0)
        entry = (-along - jnp.sqrt(jnp.where(meets, root, 0.0))) / jnp.where(
            length > 0, length, 1.0
        )
        entry = jnp.maximum(entry, 0.0)
        # place at the entry times place at the end
        turned = square + (1 + entry) * along + entry * length < 0
        jumped = jnp.any(_only(meets & (entry < 1) & turned, allowed, False))
        return jumped | _interlocked(before, after, others_before, others_after, allowed)

    fastest = [jnp.max(jnp.sum(x**2, axis=1)) for x in (move, others)]
    way = jnp.sqrt(fastest[0]) + jnp.sqrt(fastest[1])
    nearest = jnp.min(_only(square, allowed, jnp.inf))
    # between two ends the other line may be as near as half of a piece of each
    pieces = [
        jnp.max(jnp.sum(jnp.diff(x, axis=0) ** 2, axis=1)) for x in (before, others_before)
    ]
    least = jnp.minimum(jnp.minimum(nearest, reach**2), nearest - (pieces[0] + pieces[1]) / 4)
    return jax.lax.cond(way**2 >= least, looked, lambda: jnp.zeros((), bool))


_AROUND = 0.5  # of a piece, how far beyond its ends lines may have been seen to cross before


def _interlocked(before, after, others_before, others_after, allowed) -> Bool[Array, ""]:
    """Whether any piece of a line now lies on the other side of a piece of the other, and met
    it; in a plane, whether any two cross that did not."""
    first, last = _seen(before, others_before), _seen(after, others_after)
    both = None
    if allowed is not None:
        both = allowed[:-1, :-1] & allowed[1:, :-1] & allowed[:-1, 1:] & allowed[1:, 1:]
    now = _only(last.within(0.0), both, False)
    if before.shape[1] == 2:
        return jnp.any(now) & ~jnp.any(_only(first.within(0.0), both, False))
    same = jnp.sum(first.normal * last.normal, axis=2) > 0
    return jnp.any(now & first.within(_AROUND) & same & (first.height * last.height < 0))


class _Seen(NamedTuple):
    """Pieces of two lines as seen along the normal of both: where they cross, in shares of
    each, and how high one is over the other, times the length of the normal."""

    shares: tuple[Float[Array, "pieces others"], Float[Array, "pieces others"]]
    height: Float[Array, "pieces others"]
    normal: Float[Array, "pieces others rot"]

    def within(self, beyond: float) -> Bool[Array, "pieces others"]:
        one, two = (jnp.abs(share - 0.5) < 0.5 + beyond for share in self.shares)
        return one & two


def _seen(line: Float[Array, "ends dim"], other: Float[Array, "others dim"]) -> _Seen:
    u, w = jnp.diff(line, axis=0)[:, None], jnp.diff(other, axis=0)[None]
    apart = other[None, :-1] - line[:-1, None]
    normal = _cross(u, w)
    square = jnp.sum(normal**2, axis=2)
    size = jnp.where(square > 0, square, jnp.inf)  # parallel ones are nowhere seen to cross
    shares = [jnp.sum(_cross(apart, x) * normal, axis=2) / size for x in (w, u)]
    nowhere = jnp.full_like(square, jnp.inf)
    shares = [jnp.where(square > 0, share, nowhere) for share in shares]
    height = jnp.sum(apart * normal, axis=2) if line.shape[1] == 3 else nowhere
    return _Seen((shares[0], shares[1]), height, normal)


def _cross(a: Array, b: Array) -> Float[Array, "pieces others rot"]:
    if a.shape[2] == 3:
        return jnp.cross(a, b)
    return (a[..., :1] * b[..., 1:]) - (a[..., 1:] * b[..., :1])


def _only(values, allowed, other):
    return values if allowed is None else jnp.where(allowed, values, other)


def products(a, b, c, d) -> Float[Array, "points others"]:
    """(a_i - b_j) . (c_i - d_j)."""
    total = jnp.zeros((a.shape[0], b.shape[0]), a.dtype)
    for axis in range(a.shape[1]):
        first = a[:, None, axis] - b[None, :, axis]
        total = total + first * (c[:, None, axis] - d[None, :, axis])
    return total
