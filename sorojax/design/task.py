"""The functions of an optimisation over a flat vector, with their derivatives.

Functions that are compiled themselves run in one program with everything around them: a step
of a small layout takes about as long as to start a program.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from sorojax.design.mma import Values


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
