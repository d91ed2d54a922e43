"""Equations that hold a second-order system to g(q, t) = 0: M a = f + G' lambda, G = dg/dq.

Explicit methods take accelerations that keep the second derivative of g at zero, implicit
ones rates that keep dg/dt at zero where they take the forces. At the end of each step a
projection brings coordinates and rates back to g = 0 and dg/dt = 0, along the motions that the
reactions of the step make, which keeps the order of the method. Of equations that depend on
each other as many combinations are kept as are independent at the start.

Reference:
    Hairer, Lubich, Wanner, Geometric Numerical Integration, 2006, sections IV.4 and VII.1, for
    the projection; Golub, Pereyra, SIAM J. Numer. Anal. 10, 1973, for the derivative of a
    pseudo-inverse.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.math.linalg.dense import solve_columns, solve_symmetric

_RANK = 1e-10  # of the largest eigenvalue of G M^-1 G', rows of equal size: dependent below
_NEAR_SINGULAR = 1e-4  # of one over the condition number at the start
_WELL = 1e-9  # [rad], [m]: of a smaller violation one pass leaves less than 1e-10
_PASSES = 4  # after the first, at most, in a step


class Held(NamedTuple):
    """Linear equations of accelerations or rates: rows x = wanted.

    Attributes:
        rows: G.
        wanted: What G x must be.
    """

    rows: Float[Array, "equations dof"]
    wanted: Float[Array, " equations"]


class Hold(NamedTuple):
    """As many combinations of equations as are independent of each other at the start; they
    do elsewhere too, as long as they stay so.

    Attributes:
        combine: What makes them of all; a reaction of all is its transpose times one of these.
        spare: Projector on the combinations that are none.
    """

    combine: Float[Array, "equations equations"]
    spare: Float[Array, "equations equations"]


class HeldTerms(NamedTuple):
    """What holds a second-order system.

    Attributes:
        accelerations: (t, q, v) -> (mass matrix, force, `Held` of accelerations).
        rates: (t, q, v) -> (mass matrix, force, `Held` of rates).
        place: (t, q) -> (g, `Held` of rates).
        gap: (t, q) -> g.
        by: The independent equations.
        near: Inverse of the inertia at the start, along which explicit steps go back.
    """

    accelerations: Callable[[Array, Array, Array], tuple[Array, Array, Held]]
    rates: Callable[[Array, Array, Array], tuple[Array, Array, Held]]
    place: Callable[[Array, Array], tuple[Array, Held]]
    gap: Callable[[Array, Array], Array]
    by: Hold
    near: Float[Array, "dof dof"]


@jax.custom_jvp
def pseudo_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Of a symmetric matrix without negative eigenvalues, of one rank all around."""
    values, vectors = jnp.linalg.eigh(matrix)
    kept = values > _RANK * values[-1:]
    inverse = jnp.where(kept, 1 / jnp.where(kept, values, jnp.ones_like(values)), 0.0)
    return (vectors * inverse[None]) @ vectors.T


@pseudo_inverse.defjvp
def _pseudo_inverse_jvp(primals, tangents):
    (matrix,), (change,) = primals, tangents
    inverse = pseudo_inverse(matrix)
    spare = jnp.eye(matrix.shape[0], dtype=matrix.dtype) - matrix @ inverse
    side = spare @ change @ inverse @ inverse
    return inverse, side + side.T - inverse @ change @ inverse


def hold(reach: Float[Array, "equations equations"]) -> Hold:
    """The independent equations, from G A^-1 G' with a metric A."""
    size = jnp.diagonal(reach)
    known = size > 0
    scale = jnp.where(known, 1 / jnp.sqrt(jnp.where(known, size, jnp.ones_like(size))), 0.0)
    scaled = reach * scale[:, None] * scale[None]
    kept = scaled @ pseudo_inverse(scaled)
    kept = (kept + kept.T) / 2
    return Hold(kept * scale[None], jnp.eye(reach.shape[0], dtype=reach.dtype) - kept)


class Reacted(NamedTuple):
    """A solution, its reactions, and the motion that each independent reaction makes."""

    x: Float[Array, " dof"]
    reactions: Float[Array, " equations"]
    pulled: Float[Array, "dof equations"]


def solve_held(
    matrix: Float[Array, "dof dof"], right: Float[Array, " dof"], held: Held, by: Hold
) -> Reacted:
    """x and lambda with `matrix` x = `right` + G' lambda and G x = wanted."""
    rows = by.combine @ held.rows
    found = solve_columns(matrix, jnp.concatenate([right[:, None], rows.T], axis=1))
    free, pulled = found[:, 0], found[:, 1:]
    missing = by.combine @ held.wanted - rows @ free
    reaction = solve_symmetric(rows @ pulled + by.spare, missing)
    return Reacted(free + pulled @ reaction, reaction @ by.combine, pulled)


def accelerate(mass: Array, force: Array, held: Held) -> Reacted:
    """Acceleration and reactions of a state that keeps its equations."""
    reach = held.rows @ solve_columns(mass, held.rows.T)
    return solve_held(mass, force, held, hold(reach))


def singular(shares: Float[Array, " time"]) -> Bool[Array, ""]:
    """Whether equations became all but dependent, from the shares that `projected` tells at
    the start and the least since."""
    return jnp.min(shares) < _NEAR_SINGULAR * shares[0]


def projected(
    terms: HeldTerms,
    move: Callable[[Array, Array], Array],
    t: Float[Array, ""],
    state: tuple[Array, Array],
    pulled: Float[Array, "dof equations"] | None = None,
) -> tuple[Array, Array, Array]:
    """Coordinates and rates that keep the equations, and how far these are from dependent:
    one over the condition number of the matrix of their reactions. Coordinates go back by
    simplified Newton passes, with the slopes of the first, at which rates are judged too.

    Args:
        terms: What holds.
        move: (q, increment) -> q after it.
        t: Time [s].
        state: Coordinates and rates.
        pulled: Motions by which they may change; those of reactions at the start if omitted.
    """
    by, (q, v) = terms.by, state
    value, held = terms.place(t, q)
    rows = by.combine @ held.rows
    along = terms.near @ rows.T if pulled is None else pulled
    reach = rows @ along + by.spare
    inverse = jnp.linalg.inv(reach)
    back = along @ inverse @ by.combine
    v = v - back @ (held.rows @ v - held.wanted)

    def nearer(q, value):
        return move(q, -back @ value), jnp.max(jnp.abs(jax.lax.stop_gradient(value)))

    def again(found, _):
        q, size = found
        closer = functools.partial(nearer, q)
        return jax.lax.cond(size > _WELL, lambda: closer(terms.gap(t, q)), lambda: found), None

    (q, _), _ = jax.lax.scan(again, nearer(q, value), length=_PASSES)
    return q, v, _share(reach, inverse)


def _share(reach: Array, inverse: Array) -> Float[Array, ""]:
    """One over the condition number in the norm of the largest row sum; no derivative."""
    first, second = (jnp.max(jnp.sum(jnp.abs(x), axis=1)) for x in (reach, inverse))
    return jax.lax.stop_gradient(1 / (first * second))
