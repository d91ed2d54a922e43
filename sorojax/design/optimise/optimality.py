"""The optimality-criteria method, the baseline for compliance under one volume constraint, and
the functions of an optimisation over a flat vector with their derivatives.

Functions that are compiled themselves run in one program with everything around them: a step
of a small layout takes about as long as to start a program.

Reference: Sigmund, "A 99 line topology optimization code written in Matlab", Struct.
Multidisc. Optim. 21, 2001.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from sorojax._types import real
from sorojax.design.optimise.base import AbstractOptimiser, Values

_FAR = 60.0  # beyond every gain: how far the logarithm of the price may go
_EXACT, _MOST = 1e-14, 100  # change of the logarithm of the price at which to stop, and steps


class OptimalityCriteria(AbstractOptimiser):
    """Scales each variable by how much it gains against what it costs.

    One constraint, taken as linear; the objective should fall with every variable.

    Attributes:
        lower, upper: Bounds of the variables.
        move: Largest change of a variable in a step.
        damping: Exponent of the scaling; 0.3 for mechanisms.
    """

    scaled: ClassVar[bool] = False
    lower: Float[Array, "..."] = eqx.field(converter=real, default=0.0)
    upper: Float[Array, "..."] = eqx.field(converter=real, default=1.0)
    move: Float[Array, ""] = eqx.field(converter=real, default=0.2)
    damping: Float[Array, ""] = eqx.field(converter=real, default=0.5)

    def init(self, x: Float[Array, " n"], constraints: int) -> None:
        """No state.

        Raises:
            ValueError: If there is not exactly one constraint.
        """
        if constraints != 1:
            raise ValueError(
                f"OptimalityCriteria: got {constraints} constraints, need one. Use MMA."
            )

    def update(self, x, values, memory=None, evaluate=None):
        return _update(self, x, values), None


@jax.jit
def _update(method: OptimalityCriteria, x, values: Values):
    cost = values.slopes[0]
    gain = jnp.maximum(-values.gradient, 1e-10 * jnp.max(jnp.abs(values.gradient))) / cost
    least = jnp.maximum(method.lower, x - method.move)
    most = jnp.minimum(method.upper, x + method.move)

    logs = jnp.log(gain)
    full = x * jnp.exp(method.damping * logs)

    def proposal(log_price):
        return jnp.clip(full * jnp.exp(-method.damping * log_price), least, most)

    def excess(log_price):
        """Of the constraint, and its slope: variables at a limit do not move."""
        new = proposal(log_price)
        free = (new > least) & (new < most)
        slope = -method.damping * jnp.sum(jnp.where(free, cost * new, jnp.zeros_like(new)))
        return values.constraints[0] + cost @ (new - x), slope

    def improve(state):
        price, low, high, _, count = state
        value, slope = excess(price)
        low, high = jnp.where(value > 0, price, low), jnp.where(value > 0, high, price)
        step = price - value / slope
        new = jnp.where((step >= low) & (step <= high), step, (low + high) / 2)
        return new, low, high, jnp.abs(new - price) <= _EXACT * (1 + jnp.abs(new)), count + 1

    low, high = jnp.min(logs) - _FAR, jnp.max(logs) + _FAR
    start = ((jnp.min(logs) + jnp.max(logs)) / 2, low, high, jnp.asarray(False), 0)
    end = jax.lax.while_loop(lambda state: ~state[3] & (state[4] < _MOST), improve, start)
    return proposal(end[0])


# The functions of an optimisation over a flat vector, with their derivatives


class Task:
    """Loss and constraints of a pytree, over the vector that `back` takes to it.

    Args:
        loss, constraints, schedule, change_gradient: Of `minimise`.
        back: From the vector to the pytree.
    """

    def __init__(
        self,
        loss: Callable[..., Any],
        constraints: Sequence[Callable[..., Any]],
        back: Callable[[Array], PyTree],
        schedule: Callable[[int], tuple] | None,
        change_gradient: Callable[[PyTree, PyTree], PyTree] | None,
    ):
        self.loss, self.constraints, self.back = loss, tuple(constraints), back
        self._schedule = schedule
        self._values_found = _joined(loss, self.constraints, back, change_gradient)

    def _more(self, k: int) -> tuple:
        return () if self._schedule is None else tuple(self._schedule(k))

    def plain(self, flat: Float[Array, " n"], k: int):
        """Objective and constraints alone, at step `k`."""
        more, x = self._more(k), self.back(flat)
        held = [jnp.ravel(jnp.asarray(g(x, *more))) for g in self.constraints]
        return self.loss(x, *more), jnp.concatenate(held) if held else jnp.zeros(0)

    def last(self, flat: Float[Array, " n"], k: int):
        """The same, by programs that were compiled for the steps."""
        if not _is_compiled(self.loss):
            return self.plain(flat, k)
        values, _ = self.found(flat, k)
        return values.objective, values.constraints

    def found(self, flat: Float[Array, " n"], k: int) -> tuple[Values, Bool[Array, ""]]:
        """Values and derivatives at step `k`, and whether all are finite."""
        return self._values_found(flat, *self._more(k))


def _joined(loss, constraints, back, change_gradient):
    """From the vector and further arguments to what `Task.found` returns."""
    compiled = all(map(_is_compiled, (loss, *constraints)))
    objective = jax.value_and_grad(lambda flat, *more: loss(back(flat), *more))
    held = _with_slopes(constraints, back)
    if not compiled:
        objective = jax.jit(objective) if _is_compiled(loss) else objective
        held = jax.jit(held) if all(map(_is_compiled, constraints)) else held

    def evaluated(flat, *more) -> Values:
        return Values(*objective(flat, *more), *held(flat, *more))

    def finished(flat, values: Values):
        if change_gradient is not None:
            changed = change_gradient(back(flat), back(values.gradient))
            values = values._replace(gradient=ravel_pytree(changed)[0])
        return values, _all_finite(values)

    if compiled and (change_gradient is None or _is_compiled(change_gradient)):
        return jax.jit(lambda flat, *more: finished(flat, evaluated(flat, *more)))
    evaluated = jax.jit(evaluated) if compiled else evaluated
    return lambda flat, *more: finished(flat, evaluated(flat, *more))


def _with_slopes(constraints, back):
    """All constraints as one vector, and its derivative."""

    def one(constraint, flat, more):
        value, pull = jax.vjp(lambda f: jnp.ravel(constraint(back(f), *more)), flat)
        rows = [pull(row)[0] for row in jnp.eye(value.shape[0], dtype=flat.dtype)]
        return value, jnp.stack(rows)

    def both(flat, *more):
        if not constraints:
            none = jnp.zeros((0, flat.shape[0]), flat.dtype)
            return none[:, 0], none
        values, slopes = zip(*(one(g, flat, more) for g in constraints), strict=True)
        return jnp.concatenate(values), jnp.concatenate(slopes)

    return both


def _is_compiled(function) -> bool:
    return hasattr(function, "lower")


@jax.jit
def _all_finite(values: Values) -> Bool[Array, ""]:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(part)) for part in values]))
