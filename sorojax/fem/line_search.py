"""Shortening Newton steps that run past the place where a contact or friction gives way.

Only the energy of those loads is searched along a step. That of a nearly incompressible
body misleads: in thin walls it rises steeply in iterations that are good all the same.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax._jax.jit import once
from sorojax.fem.problem import Problem, unsupported

_MOST = 1.1  # change of the slope, over what the whole energy needs, that a step may bring
_LEAST = 0.4  # and that a shortened one brings
_TRIALS = 40
_LOOKS = (0.125, 0.25, 0.5, 1.0)  # a whole step may end behind what it should have met


def overshoots(problem: Problem) -> bool:
    return any(load.overshoots for load in problem.loads)


def share_of_step(
    problem: Problem,
    known: Bool[Array, " dofs"],
    residual: Float[Array, " dofs"],
    u: Float[Array, "nodes dim"],
    du: Float[Array, "nodes dim"],
) -> Float[Array, ""]:
    """How much of the Newton step `du` [m] from `u` to take.

    Along a good step the slope of the energy goes from `residual` times `du` to zero. If
    that of the loads with kinks changes by more than that, the step ends where it changes by
    about as much: where contacts carry what made the body move.
    """
    return _share(unsupported(problem), known, residual, u, du)


@once
def _share(problem: Problem, known, residual, u, du):
    fall = -jnp.sum(jnp.where(known, jnp.zeros_like(residual), residual) * du.ravel())
    loads = [load for load in problem.loads if load.overshoots]

    def slope(share):
        def potential(u):
            terms = (load.potential(problem, u) for load in loads)
            return sum(terms, start=jnp.zeros((), u.dtype))

        return jax.jvp(potential, (u + share * du,), (du,))[1]

    one = jnp.min(jnp.stack([load.longest_share(du) for load in loads]))
    looks = one * jnp.asarray((0.0, *_LOOKS), u.dtype)
    return _searched(slope, looks, fall)


class _Search(NamedTuple):
    """How often the slope was asked for, its value at each look, and after those: the ends of
    the interval, the change of the slope at them, the last trial and the change there."""

    count: Array
    slopes: Float[Array, " looks"]
    low: Array
    high: Array
    below: Array
    above: Array
    share: Array
    change: Array


def _searched(slope: Callable[[Array], Array], looks: Array, fall: Array) -> Float[Array, ""]:
    """The share where the change of the slope fits, the last of `looks` if it does there; one
    loop, so that the program holds the slope once."""
    num = looks.shape[0]

    def changes(search: _Search):
        return (search.slopes[1:] - search.slopes[:1]) / fall

    def ask(search: _Search) -> _Search:
        next_ = _next(search, search.count - num)
        at = jnp.clip(search.count, 0, num - 1)
        looking = search.count < num
        here = slope(jnp.where(looking, looks[at], next_.share))
        slopes = jnp.where(looking, search.slopes.at[at].set(here), search.slopes)
        found = next_._replace(change=(here - slopes[0]) / fall)
        looked = search._replace(slopes=slopes)
        met = jnp.argmax(changes(looked) > _MOST)
        share, change = looks[1:][met], changes(looked)[met]
        looked = looked._replace(high=share, above=change, share=share, change=change)
        found = jax.tree.map(lambda a, b: jnp.where(looking, a, b), looked, found)
        return found._replace(count=search.count + 1)

    def unfit(search: _Search):
        # where the residual does not fall along the step there is nothing to go by
        return (fall > 0) & jnp.any(changes(search) > _MOST)

    def running(search: _Search):
        fits = (search.change >= _LEAST) & (search.change <= _MOST)
        wide = search.high - search.low > 1e-12 * search.high
        trying = unfit(search) & ~fits & (search.count < num + _TRIALS) & wide
        return (search.count < num) | trying

    zero, count = jnp.zeros_like(fall), jnp.zeros((), jnp.int32)
    start = _Search(count, jnp.zeros_like(looks), zero, *(jnp.ones_like(fall),) * 5)
    end = jax.lax.while_loop(running, ask, start._replace(below=zero))
    return jnp.where(unfit(end), end.share, looks[-1])


def _next(search: _Search, trials: Array) -> _Search:
    """The interval with the last trial as one of its ends, and where to try next."""
    far = search.change > _MOST
    low = jnp.where(far, search.low, search.share)
    high = jnp.where(far, search.share, search.high)
    below = jnp.where(far, search.below, search.change)
    above = jnp.where(far, search.change, search.above)
    # between a chord, which a steep end makes useless, and the middle
    chord = low + (1 - below) / (above - below) * (high - low)
    middle = jnp.where(low > 0, jnp.sqrt(low * high), high / 8)
    share = jnp.where(trials % 2 == 0, chord, middle)
    return search._replace(low=low, high=high, below=below, above=above, share=share)
