"""The method of moving asymptotes and its globally convergent version.

A step replaces objective and constraints by separable convex functions with asymptotes on
both sides of each variable, and solves that problem by a primal-dual interior-point method
whose systems have the size of the number of constraints.

References:
    Svanberg, "The method of moving asymptotes - a new method for structural
    optimization", Int. J. Numer. Meth. Engng 24, 1987.
    Svanberg, "A class of globally convergent optimization methods based on conservative
    convex separable approximations", SIAM J. Optim. 12, 2002.
"""

import abc
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax._types import real
from sorojax.design.subproblem import Approximation, solve_subproblem


class Values(NamedTuple):
    """Objective and constraints (each <= 0) at one design, with their derivatives."""

    objective: Float[Array, ""]
    gradient: Float[Array, " n"]
    constraints: Float[Array, " m"]
    slopes: Float[Array, "m n"]


class MMAState(eqx.Module):
    """What the method remembers: asymptotes, the last two designs, how often it was called,
    and how curved its functions must be (GCMMA)."""

    low: Float[Array, " n"]
    high: Float[Array, " n"]
    last: Float[Array, " n"]
    before: Float[Array, " n"]
    count: Int[Array, ""]
    curvature: Float[Array, " functions"]


class AbstractMMA(eqx.Module):
    """What both versions share: bounds, asymptotes and the convex functions."""

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        lower: ClassVar[Float[Array, "..."]]
        upper: ClassVar[Float[Array, "..."]]
        move: ClassVar[Float[Array, ""]]

    @abc.abstractmethod
    def _curvature(self, state: MMAState, values: Values, span: Array) -> Array:
        """Least curvature of each function."""

    def init(self, x: Float[Array, " n"], constraints: int) -> MMAState:
        """State before the first step from `x` with so many constraints."""
        x = real(x)
        return MMAState(
            x, x, x, x, jnp.zeros((), jnp.int32), jnp.ones(constraints + 1, x.dtype)
        )

    def update(
        self, x: Float[Array, " n"], values: Values, state: MMAState
    ) -> tuple[Float[Array, " n"], MMAState]:
        """The next design, and the state to pass on."""
        return _update(self, real(x), Values(*map(real, values)), state)


class MMA(AbstractMMA):
    """Moving asymptotes.

    Attributes:
        lower, upper: Bounds of the variables, numbers or one per variable.
        move: Largest change of a variable in a step, relative to its range.
        spread: Distance of the first asymptotes, relative to the range.
        approach, retreat: How asymptotes move in on variables that oscillate, and away.
    """

    lower: Float[Array, "..."] = eqx.field(converter=real, default=0.0)
    upper: Float[Array, "..."] = eqx.field(converter=real, default=1.0)
    move: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    spread: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    approach: Float[Array, ""] = eqx.field(converter=real, default=0.7)
    retreat: Float[Array, ""] = eqx.field(converter=real, default=1.2)

    def _curvature(self, state, values, span):
        return jnp.full_like(state.curvature, 1e-5)


class GCMMA(AbstractMMA):
    """Moving asymptotes whose functions are made to lie above the true ones.

    `minimise` evaluates each proposal and asks again with more curvature (`stiffen`) until
    they do, so the objective of feasible designs never rises.
    """

    lower: Float[Array, "..."] = eqx.field(converter=real, default=0.0)
    upper: Float[Array, "..."] = eqx.field(converter=real, default=1.0)
    move: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    spread: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    approach: Float[Array, ""] = eqx.field(converter=real, default=0.7)
    retreat: Float[Array, ""] = eqx.field(converter=real, default=1.2)

    def _curvature(self, state, values, span):
        return state.curvature

    def begin(self, x: Float[Array, " n"], values: Values, state: MMAState) -> MMAState:
        """The state at the start of an outer step: curvature by the gradients there."""
        span = self.upper - self.lower + jnp.zeros_like(x)
        slopes = jnp.concatenate([values.gradient[None], values.slopes])
        first = 0.1 / x.shape[0] * jnp.sum(jnp.abs(slopes) * span[None], axis=1)
        return eqx.tree_at(lambda s: s.curvature, state, jnp.maximum(first, 1e-6))

    def stiffen(
        self,
        x: Float[Array, " n"],
        proposal: Float[Array, " n"],
        values: Values,
        found: tuple[Float[Array, ""], Float[Array, " m"]],
        state: MMAState,
    ) -> tuple[MMAState, Array]:
        """More curvature where a function lies above its approximation at `proposal`, where
        objective and constraints were found; and whether none does."""
        return _stiffen(self, x, proposal, values, found, state)


@jax.jit
def _update(method, x, values: Values, state: MMAState):
    low, high = _asymptotes(method, x, state)
    answer = solve_subproblem(_approximation(method, x, values, state, low, high))
    new = MMAState(low, high, x, state.last, state.count + 1, state.curvature)
    return answer, new


@jax.jit
def _stiffen(method, x, proposal, values, found, state):
    low, high = _asymptotes(method, x, state)
    told = _approximation(method, x, values, state, low, high)
    true = jnp.concatenate([found[0][None], found[1]])
    above = true - (told.at(proposal) - jnp.concatenate([told.shift_objective, told.right]))
    span = method.upper - method.lower + jnp.zeros_like(x)
    away = (high - low) * (proposal - x) ** 2
    away = jnp.sum(away / ((high - proposal) * (proposal - low) * span))
    short = above > 1e-7 * jnp.maximum(jnp.abs(true), 1e-7)
    more = state.curvature + above / jnp.maximum(away, 1e-30)
    more = jnp.minimum(1.1 * more, 10 * state.curvature)
    curvature = jnp.where(short, more, state.curvature)
    return eqx.tree_at(lambda s: s.curvature, state, curvature), ~jnp.any(short)


def _asymptotes(method, x, state: MMAState) -> tuple[Array, Array]:
    span = method.upper - method.lower + jnp.zeros_like(x)
    turn = (x - state.last) * (state.last - state.before)
    gain = jnp.where(turn > 0, method.retreat, jnp.where(turn < 0, method.approach, 1.0))
    low = jnp.clip(x - gain * (state.last - state.low), x - 10 * span, x - 0.01 * span)
    high = jnp.clip(x + gain * (state.high - state.last), x + 0.01 * span, x + 10 * span)
    early = state.count < 2
    return (
        jnp.where(early, x - method.spread * span, low),
        jnp.where(early, x + method.spread * span, high),
    )


def _approximation(method, x, values: Values, state, low, high) -> Approximation:
    span = method.upper - method.lower + jnp.zeros_like(x)
    least = jnp.maximum(low + 0.1 * (x - low), x - method.move * span)
    most = jnp.minimum(high - 0.1 * (high - x), x + method.move * span)
    slopes = jnp.concatenate([values.gradient[None], values.slopes])
    up, down = jnp.maximum(slopes, 0), jnp.maximum(-slopes, 0)
    curve = method._curvature(state, values, span)[:, None] / span[None]
    p = (high - x)[None] ** 2 * (1.001 * up + 0.001 * down + curve)
    q = (x - low)[None] ** 2 * (0.001 * up + 1.001 * down + curve)
    here = p @ (1 / (high - x)) + q @ (1 / (x - low))
    return Approximation(
        p, q, low, high,
        jnp.maximum(least, method.lower), jnp.minimum(most, method.upper),
        here[1:] - values.constraints, here[:1] - values.objective,
    )  # fmt: skip
