"""Shortening Newton steps that run past the place where a contact or friction gives way.

Only the energy of those loads is searched along a step. That of a nearly incompressible
body misleads: in thin walls it rises steeply in iterations that are good all the same.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

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


@eqx.filter_jit
def _share(problem: Problem, known, residual, u, du):
    fall = -jnp.sum(jnp.where(known, jnp.zeros_like(residual), residual) * du.ravel())
    loads = [load for load in problem.loads if load.overshoots]

    def slope(share):
        def potential(u):
            terms = (load.potential(problem, u) for load in loads)
            return sum(terms, start=jnp.zeros((), u.dtype))

        return jnp.sum(jax.grad(potential)(u + share * du) * du)

    one = jnp.min(jnp.stack([load.longest_share(du) for load in loads]))
    looks = one * jnp.asarray(_LOOKS, u.dtype)
    slopes = jax.lax.map(slope, jnp.concatenate([0 * looks[:1], looks]))
    first, changes = slopes[0], (slopes[1:] - slopes[:1]) / fall
    met = jnp.argmax(changes > _MOST)
    # where the residual does not fall along the step there is nothing to go by
    unfit = (fall > 0) & jnp.any(changes > _MOST)

    def trial(search):
        low, high, below, above, share, change, count = search
        far = change > _MOST
        low, high = jnp.where(far, low, share), jnp.where(far, share, high)
        below, above = jnp.where(far, below, change), jnp.where(far, change, above)
        # between a chord, which a steep end makes useless, and the middle
        chord = low + (1 - below) / (above - below) * (high - low)
        middle = jnp.where(low > 0, jnp.sqrt(low * high), high / 8)
        share = jnp.where(count % 2 == 0, chord, middle)
        return low, high, below, above, share, (slope(share) - first) / fall, count + 1

    def running(search):
        low, high, *_, change, count = search
        fits = (change >= _LEAST) & (change <= _MOST)
        return unfit & ~fits & (count < _TRIALS) & (high - low > 1e-12 * high)

    zero, count = jnp.zeros_like(fall), jnp.zeros((), jnp.int32)
    start = (zero, looks[met], zero, changes[met], looks[met], changes[met], count)
    found = jax.lax.while_loop(running, trial, start)
    return jnp.where(unfit, found[4], one)
