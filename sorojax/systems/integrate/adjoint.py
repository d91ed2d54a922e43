"""The derivative in reverse of adaptive runs: the accepted steps once more, from the last one.

The discrete adjoint with the lengths of the steps held, as they are chosen and have no
derivative. Every so many steps the state is kept; those between are computed again.

Reference:
    Griewank and Walther, Evaluating Derivatives, 2008, section 12.2, for checkpoints.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from sorojax.math.ode.explicit import Again
from sorojax.systems.integrate.free_run import Moving, Plan, Record, Run, Steps, marched

CHECKPOINTS = 4096  # at most


@eqx.filter_custom_vjp
def replayed(moving: Moving, plan: Plan, room: int, record: Record | None) -> tuple[Run, Any]:
    """A free run by one of our methods, with a derivative in reverse alone, and its steps as
    `marched` gives them for so much `room`. With the `record` of a run its derivative needs
    no other."""
    return marched(moving, plan, room)


@replayed.def_fwd
def _forward(perturbed, moving, plan, room, record):
    if record is not None:
        return (record.run, None), record
    # with the steps that compile fast
    quick: Any = Again(plan.solver)  # type: ignore[arg-type]
    plan = eqx.tree_at(lambda p: p.solver, plan, quick)
    every = math.ceil(plan.max_steps / CHECKPOINTS)
    run, steps = marched(moving, plan, plan.max_steps + 1, every)
    return (run, _blank(steps, room) if room else None), Record(run, steps)


@replayed.def_bwd
def _backward(record, changes, perturbed, moving: Moving, plan: Plan, room, _):
    (run, (times, kept, count)), (changes, _) = record, changes
    every = 1
    if kept.shape[0] < times.shape[0]:
        every = math.ceil(plan.max_steps / CHECKPOINTS)
    wanted, held = eqx.partition(moving.constants, perturbed.constants)
    changes = jax.tree.map(
        lambda x, ct: jnp.zeros_like(x) if ct is None and eqx.is_inexact_array(x) else ct,
        run,
        changes,
        is_leaf=_is_none,
    )
    replay = _Replay(moving, plan, wanted, held, times, changes, count)
    begin = _Pulled(
        changes.last,
        jax.tree.map(jnp.zeros_like, wanted),
        jnp.zeros_like(moving.time),
        jnp.full((), moving.time.shape[0] - 1, jnp.int32),
    )

    def part(k, pulled):
        return replay.part(number - 1 - k, every, kept, pulled)

    number = -(-count // every)
    pulled = jax.lax.fori_loop(0, number, part, begin)
    return Moving(pulled.constants, pulled.state, pulled.time)


def _blank(steps: Steps, room: int) -> Steps:
    """Steps of which no one asks."""
    rows = [jnp.zeros((room, *x.shape[1:]), x.dtype) for x in (steps.time, steps.state)]
    return Steps(*rows, steps.count)


def _is_none(leaf: Any) -> bool:
    return leaf is None


class _Pulled(NamedTuple):
    """Cotangents on the way back, and the number of the next instant."""

    state: Float[Array, " states"]
    constants: PyTree
    time: Float[Array, " time"]
    instant: Int[Array, ""]


class _Replay(NamedTuple):
    """The run and the cotangents of its results."""

    moving: Moving
    plan: Plan
    wanted: PyTree
    held: PyTree
    times: Float[Array, " steps"]
    changes: Run
    count: Int[Array, ""]

    def part(self, number, every: int, kept, pulled: _Pulled) -> _Pulled:
        """Back through the steps from one kept state to the next."""
        first = number * every
        if every == 1:
            return self._pull(first, kept[first], pulled)
        steps = jnp.minimum(every, self.count - first)

        def forward(k, states):
            again = self._step(self.wanted, first + k, states[k])[0]
            return jax.lax.dynamic_update_index_in_dim(states, again, k + 1, 0)

        def back(k, pulled):
            k = steps - 1 - k
            return self._pull(first + k, states[k], pulled)

        states = jnp.zeros((every, *kept.shape[1:]), kept.dtype).at[0].set(kept[number])
        states = jax.lax.fori_loop(0, steps - 1, forward, states)
        return jax.lax.fori_loop(0, steps, back, pulled)

    def _step(self, wanted, k, y):
        """State after step `k` from `y`, what its interpolation needs, and what it started
        from."""
        args = (eqx.combine(wanted, self.held), *self.plan.watched)
        t, h = self.times[k], self.times[k + 1] - self.times[k]
        method: Any = self.plan.solver
        step, memory = method.again(lambda t, y: self.plan.field(t, y, args), t, y, h)
        return step.y, step.dense, memory

    def _pull(self, k, y, pulled: _Pulled) -> _Pulled:
        (new, dense, memory), pull = jax.vjp(lambda c, y: self._step(c, k, y), self.wanted, y)
        ends = (y, new, dense)
        zeros = jax.tree.map(jnp.zeros_like, ends)
        (early, late, within), time, instant = self._instants(k, ends, zeros, pulled)
        final = k == self.count - 1

        def at_end(change, like):
            return jnp.where(final, jnp.zeros_like(like) if change is None else change, 0.0)

        remembered = jax.tree.map(at_end, self.changes.memory, memory)
        constants, before = pull((pulled.state + late, within, remembered))
        state = before + early + at_end(self.changes.seam.state, y)
        constants = jax.tree.map(jnp.add, pulled.constants, constants)
        return _Pulled(state, constants, time, instant)

    def _instants(self, k, ends, zeros, pulled: _Pulled):
        """Cotangents of the ends of step `k`, and of the instants within it."""
        t0, t1 = self.times[k], self.times[k + 1]

        def at(t, ends):
            y0, y1, dense = ends
            make: Any = self.plan.solver.interpolation_cls
            return make(t0=t0, t1=t1, y0=y0, y1=y1, **dense).evaluate(t)

        def inside(carry):
            instant = carry[2]
            t = self.moving.time[instant]
            return (instant >= 0) & (jnp.where(k == 0, t >= t0, t > t0))

        def one(carry):
            sums, time, instant = carry
            t, change = self.moving.time[instant], self.changes.path[instant]
            reached = t <= t1
            _, pull = jax.vjp(at, t, ends)
            slope, found = pull(jnp.where(reached, change, 0.0))
            sums = jax.tree.map(jnp.add, sums, found)
            time = jax.lax.dynamic_update_index_in_dim(time, slope, instant, 0)
            return sums, time, instant - 1

        return jax.lax.while_loop(inside, one, (zeros, pulled.time, pulled.instant))
