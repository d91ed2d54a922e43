"""Adaptive runs by diffrax, and those of our own methods that may step past their end in a
loop of their own: without events, continuous solution or changes of direction it compiles in
a half of the time, and it notes the accepted steps for a derivative.
"""

from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from sorojax._jax import diffrax_checks
from sorojax.math.host import any_of_lanes, true_alone
from sorojax.math.ode.explicit import AbstractMethod


class Moving(NamedTuple):
    """What a run has derivatives by: the constants of its rate, its first state, and the
    instants [s] of which the states are kept."""

    constants: PyTree
    state: Float[Array, " states"]
    time: Float[Array, " time"]


class Plan(eqx.Module):
    """All else that a run needs, and what is asked for: `free` runs step past their end."""

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
    """The path at the instants (of no meaning where it was not reached), the last state, the
    last step that was taken, what it started from, and how the run ended."""

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


class Steps(NamedTuple):
    """The accepted steps: the instants [s] of their ends, the states where they begin, all or
    every so many, and their number, for which there may be too little room."""

    time: Float[Array, " ends"]
    state: Float[Array, "kept states"]
    count: Int[Array, ""]


class Record(NamedTuple):
    """A run and its steps."""

    run: Run
    steps: Steps


def solved(moving: Moving, plan: Plan) -> Run:
    """The run by diffrax, with the derivative that diffrax gives it."""
    further = dict(plan.further)
    adjoint = dfx.RecursiveCheckpointAdjoint() if plan.adjoint is None else plan.adjoint
    with diffrax_checks.left_out():
        solution = dfx.diffeqsolve(
            dfx.ODETerm(plan.field),
            plan.solver,
            plan.start,
            plan.end,
            further.pop("dt0", None),
            moving.state,
            args=(moving.constants, *plan.watched),
            saveat=dfx.SaveAt(
                subs=[dfx.SubSaveAt(ts=moving.time), dfx.SubSaveAt(t1=True)],
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


# Free runs of our own methods


class _Walk(NamedTuple):
    """A run on its way: the step under way from `time` to `next` [s] and what it starts from,
    attempts and rejections, the number of the next instant, and what is kept."""

    time: Float[Array, ""]
    next: Float[Array, ""]
    state: Float[Array, " states"]
    memory: PyTree
    pace: Any
    result: dfx.RESULTS
    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    going: Bool[Array, ""]


class _Kept(NamedTuple):
    instant: Int[Array, ""]
    path: Float[Array, "time states"]
    steps: Steps | None
    meter: Any


def marched(moving: Moving, plan: Plan, room: int = 0, every: int = 1) -> tuple[Run, Any]:
    """A free run by one of our methods without a seam, and its steps if there is `room` for
    their ends, with every so many states; the same steps that diffrax takes.

    Lanes march together: what is kept is written in place, in all of them.
    """
    method: Any = plan.solver
    control: Any = plan.control
    terms, args = dfx.ODETerm(plan.field), (moving.constants, *plan.watched)
    order, start, y = method.error_order(terms), plan.start, moving.state
    y = y.astype(np.promote_types(y.dtype, start.dtype))
    asked = start, plan.end, y
    late, pace = control.init(terms, *asked, None, args, method.func, order)
    memory = method.init(terms, start, late, y, args)
    none = jnp.zeros((), jnp.int32)
    result = jax.tree.map(jnp.asarray, dfx.RESULTS.successful)
    zero = jnp.zeros((), int)
    begin = _Walk(start, late, y, memory, pace, result, zero, zero, start < plan.end)
    steps = None
    if room:
        ends, rows = jnp.zeros(room, start.dtype), (room - 1) // every + 1
        steps = Steps(ends, jnp.zeros((rows, *y.shape), y.dtype), none)
    path = jnp.zeros((moving.time.shape[0], *y.shape), y.dtype)
    kept = _Kept(none, path, steps, plan.meter.init())

    def one(now: tuple[_Walk, _Kept]) -> tuple[_Walk, _Kept]:
        walk, kept = now
        mine = true_alone(walk.going)
        step = terms, walk.time, walk.next, walk.state, args, walk.memory, False
        new, error, dense, memory, found = method.step(*step)
        error = jax.tree.map(lambda x: jnp.where(jnp.isnan(x), jnp.inf, x), error)
        ends = walk.time, walk.next, walk.state, new
        keep, time, later, _, pace, ended = control.adapt_step_size(
            *ends, args, error, order, walk.pace
        )
        state, memory = _where(keep, (new, memory), (walk.state, walk.memory))
        found = dfx.RESULTS.where(keep, found, dfx.RESULTS.successful)
        result = dfx.RESULTS.where(found == dfx.RESULTS.successful, ended, found)
        tried, good = walk.steps + 1, result == dfx.RESULTS.successful
        going = mine & good & (time < plan.end) & (tried < plan.max_steps)
        rejected = walk.rejected + (~keep).astype(walk.rejected.dtype)
        after = _Walk(time, later, state, memory, pace, result, tried, rejected, going)
        after = _where(mine, after, walk)  # lanes that have ended wait for the others
        within = method.interpolation_cls(t0=walk.time, t1=walk.next, **dense)
        instant, path = _saved(moving.time, within, walk, keep & mine, kept)
        noted = kept.steps
        if noted is not None:
            noted = _noted(noted, walk, every)
        meter = plan.meter.step(kept.meter, (after.time - start) / (plan.end - start))
        return after, _Kept(instant, path, noted, meter)

    walk, kept = jax.lax.while_loop(lambda now: any_of_lanes(now[0].going), one, (begin, kept))
    plan.meter.close(kept.meter)
    steps = kept.steps
    if steps is not None:
        count = _accepted(walk)
        ends = _put(steps.time, walk.time, count)
        steps = Steps(ends, steps.state, count)
    numbers = jnp.arange(path.shape[0], dtype=jnp.int32)
    short = (walk.result == dfx.RESULTS.successful) & (walk.time < plan.end)
    run = Run(
        kept.path,
        walk.state,
        walk.pace.last,
        walk.memory[1],
        jnp.where(numbers < kept.instant, moving.time, jnp.inf),
        walk.time,
        dfx.RESULTS.where(short, dfx.RESULTS.max_steps_reached, walk.result),
        walk.steps,
        walk.rejected,
        None,
        None,
    )
    return run, steps


def _saved(time, within, walk: _Walk, keep, kept: _Kept) -> tuple[Array, Array]:
    """The number of the next instant, and the path up to the end of a step."""
    last = time.shape[0] - 1

    def here(instant):
        return keep & (instant <= last) & (_row(time, instant) <= walk.next)

    def one(at):
        instant, path = at
        mine, value = true_alone(here(instant)), within.evaluate(_row(time, instant))
        path = _put(path, jnp.where(mine, value, _row(path, instant)), instant)
        return instant + mine.astype(instant.dtype), path

    begin = kept.instant, kept.path
    return jax.lax.while_loop(lambda at: any_of_lanes(here(at[0])), one, begin)


def _noted(steps: Steps, walk: _Walk, every: int) -> Steps:
    """With the step under way in its place, where it stays if it is accepted."""
    number = _accepted(walk)
    row, state = number // every, walk.state
    if every > 1:
        state = jnp.where(number % every == 0, state, _row(steps.state, row))
    return steps._replace(
        time=_put(steps.time, walk.time, number), state=_put(steps.state, state, row)
    )


def _accepted(walk: _Walk) -> Int[Array, ""]:
    return (walk.steps - walk.rejected).astype(jnp.int32)


def _row(rows: Array, number: Array) -> Array:
    return jax.lax.dynamic_index_in_dim(rows, number, 0, keepdims=False)


def _put(rows: Array, row: Array, number: Array) -> Array:
    """With `row` at its number, or as the last one where there is no such number."""
    return jax.lax.dynamic_update_index_in_dim(rows, row, number, 0)


def _where(condition: Array, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
