"""Adaptive runs by diffrax, and their derivative in reverse: the accepted steps once more, from
the last one.

The discrete adjoint with the lengths of the steps held, as they are chosen and have no
derivative. Every so many steps the state is kept; those between are computed again.

Reference:
    Griewank and Walther, Evaluating Derivatives, 2008, section 12.2, for checkpoints.
"""

import math
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from sorojax._jax import diffrax_checks
from sorojax.math.ode.explicit import AbstractMethod, Again

_CHECKPOINTS = 4096  # at most


class Moving(NamedTuple):
    """What a run has derivatives by: the constants of its rate, its first state, and the
    instants [s] of which the states are kept."""

    constants: PyTree
    state: Float[Array, " states"]
    time: Float[Array, " time"]


class Plan(eqx.Module):
    """All else that diffrax needs, and what is asked for: `free` runs step past their end."""

    field: Any
    solver: dfx.AbstractSolver
    control: dfx.AbstractStepSizeController
    start: Float[Array, ""]
    end: Float[Array, ""]
    watched: Any
    event: dfx.Event | None
    meter: dfx.AbstractProgressMeter
    adjoint: dfx.AbstractAdjoint | None
    further: dict[str, Any]
    max_steps: int = eqx.field(static=True)
    dense: bool = eqx.field(static=True)
    free: bool = eqx.field(static=True)


class Run(NamedTuple):
    """The path at the instants (infinite where it was not reached), the last state, the last
    step that was taken, what it started from, and how the run ended."""

    path: Float[Array, "time states"]
    last: Float[Array, " states"]
    seam: Any
    memory: PyTree
    instants: Float[Array, " time"]
    reached: Float[Array, ""]
    result: dfx.RESULTS
    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    events: Any
    dense: Any


def solved(moving: Moving, plan: Plan) -> Run:
    """The run, with the derivative that diffrax gives it."""
    return _run(_solution(moving, plan), plan)


def _solution(moving: Moving, plan: Plan, *more: dfx.SubSaveAt) -> dfx.Solution:
    """The solution, with what `more` saves behind the path and the last state."""
    further = dict(plan.further)
    adjoint = dfx.RecursiveCheckpointAdjoint() if plan.adjoint is None else plan.adjoint
    with diffrax_checks.left_out():
        return dfx.diffeqsolve(
            dfx.ODETerm(plan.field),
            plan.solver,
            plan.start,
            plan.end,
            further.pop("dt0", None),
            moving.state,
            args=(moving.constants, *plan.watched),
            saveat=dfx.SaveAt(
                subs=[dfx.SubSaveAt(ts=moving.time), dfx.SubSaveAt(t1=True), *more],
                dense=plan.dense,
                solver_state=plan.free,
                controller_state=plan.free,
            ),
            stepsize_controller=plan.control,
            max_steps=plan.max_steps,
            adjoint=adjoint,
            event=plan.event,
            throw=False,
            progress_meter=plan.meter,
            **further,
        )


def _run(solution: dfx.Solution, plan: Plan) -> Run:
    assert solution.ys is not None and solution.ts is not None
    pace: Any = solution.controller_state
    own: Any = (None, None)
    if isinstance(plan.solver, AbstractMethod):
        own = solution.solver_state
    return Run(
        solution.ys[0],
        solution.ys[1][0],
        pace.last if plan.free else None,
        own[1] if plan.free else None,
        solution.ts[0],
        solution.ts[1][0],
        solution.result,
        solution.stats["num_steps"],
        solution.stats["num_rejected_steps"],
        solution.event_mask,
        solution.interpolation,
    )


@eqx.filter_custom_vjp
def replayed(moving: Moving, plan: Plan) -> Run:
    """The same of a free run by one of our methods, with a derivative in reverse alone."""
    return solved(moving, plan)


@replayed.def_fwd
def _forward(perturbed, moving, plan):
    every = math.ceil(plan.max_steps / _CHECKPOINTS)
    ends = dfx.SubSaveAt(t0=True, steps=1, fn=lambda t, y, args: jnp.zeros(()))
    states = dfx.SubSaveAt(t0=True, steps=every)
    # plain loops, whose forward derivative makes second derivatives
    quick: Any = Again(plan.solver)  # type: ignore[arg-type]
    plain = eqx.tree_at(
        lambda p: (p.adjoint, p.solver), plan, (dfx.ForwardMode(), quick), is_leaf=_is_none
    )
    solution = _solution(moving, plain, ends, states)
    assert solution.ys is not None and solution.ts is not None
    run = _run(solution, plan)
    count = jnp.asarray(solution.stats["num_accepted_steps"], jnp.int32)
    return run, (solution.ts[2], solution.ys[3], count, run)


@replayed.def_bwd
def _backward(residuals, changes, perturbed, moving: Moving, plan: Plan):
    times, kept, count, run = residuals
    every = math.ceil(plan.max_steps / _CHECKPOINTS)
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
