"""Integration of one block: flat states, runs that stop at their last good state or at an
event, where a signal crosses zero. Progress of an adaptive run goes to the listener."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from sorojax._edit import without_derivatives
from sorojax._jax.programs import split
from sorojax._jax.small_kernels import LARGEST
from sorojax.math import host
from sorojax.math.ode.explicit import AbstractMethod
from sorojax.math.ode.step_control import Control, Seam
from sorojax.math.status import Status
from sorojax.systems.blocks.block import AbstractBlock
from sorojax.systems.integrate.adjoint import CHECKPOINTS, replayed
from sorojax.systems.integrate.free_run import Moving, Plan, Record, solved
from sorojax.systems.network import Network, at_time


class Meter(dfx.AbstractProgressMeter):
    """Reports every hundredth of the time from `start` to `end`, of a run whose steps may
    lead further, at most to `far`; of lanes that run at once their mean."""

    start: Float[Array, ""]
    far: Float[Array, ""]
    end: Float[Array, ""]
    label: str = eqx.field(static=True, default="simulate")

    def init(self):
        return jnp.zeros_like(self.end)

    def step(self, state, progress):
        passed = jax.lax.stop_gradient(progress * (self.far - self.start))
        share = jnp.minimum(passed / (self.end - self.start), 1.0).astype(state.dtype)
        # one number for all lanes, so that the condition stays one under `vmap`
        share, last = host.mean_of_lanes(share), host.largest_of_lanes(state)
        due = (share >= last + 0.01) | ((share >= 1.0) & (last < 1.0))
        jax.lax.cond(due, lambda x: host.tell(self.label, x), lambda _: None, share)
        return jnp.where(due, share, last)

    def close(self, state):
        pass


# Integration of one block: flat states, runs that stop at their last good state


_FAR = 1e30  # s, beyond the end of every run


class Integration(NamedTuple):
    """States on a grid of times, held from `reached` [s] on if the run ended before.

    Attributes:
        path: States, with a leading time axis.
        last: The state at `reached`: the end, an event, or the last good state.
        triggered: Which of the events ended the run.
        dense: The continuous solution, if asked for.
        memory: Of a method that keeps one for the whole run.
        record: The run as its derivative needs it, if asked for.
    """

    path: PyTree
    last: PyTree
    reached: Float[Array, ""]
    status: Status
    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    triggered: Bool[Array, " events"]
    dense: Any
    memory: Any = None
    record: Record | None = None


class Resume(NamedTuple):
    """From where a run goes on: the last step, and the memory of the method before it."""

    seam: Seam
    memory: Any


class FlatField(eqx.Module):
    """The rate of the state as one vector: fewer and larger kernels than a tree of states.

    What does not change within a run is computed before it: `args[0]`.
    """

    remainder: Callable[..., Array] = eqx.field(static=True)

    def __call__(self, t: Any, x: Array, args: Any) -> Array:
        return self.remainder(args[0], jnp.asarray(t, x.dtype), x)


class Conditions(NamedTuple):
    """Signals (t, state, block, inputs) -> number that end a run as they cross zero, and
    which way they cross: True rising, False falling, None either; `last` is the number of
    that which has just happened, so that it does not happen again at once."""

    signals: tuple[Callable[..., Array], ...] = ()
    rising: tuple[bool | None, ...] = ()
    last: Int[Array, ""] | None = None


_NO_CONDITIONS = Conditions()


def adaptive(
    block: AbstractBlock,
    inputs: Mapping[str, Any],
    state: PyTree,
    time: Float[Array, " time"],
    solver: dfx.AbstractSolver,
    control: dfx.AbstractStepSizeController,
    *,
    max_steps: int,
    adjoint: dfx.AbstractAdjoint | None = None,
    start: Float[Array, ""] | None = None,
    conditions: Conditions = _NO_CONDITIONS,
    dense: bool = False,
    progress: bool | str = False,
    seam: Resume | None = None,
    recorded: bool = False,
    record: Record | None = None,
) -> Integration:
    """Run from `start`, by default time[0], to time[-1]; what the grid holds before `start`
    is the first state. With a `seam` go on from there.

    Steps are not shortened to end at time[-1], which is interpolated, unless there are
    conditions: so that a run that is cut in two takes the steps of the whole one. If `recorded`
    the steps are kept where there are few; the derivative of a run with the `record` of itself
    takes no steps but those.
    """
    start = time[0] if start is None else start
    flat, unravel = ravel_pytree(state)
    inputs = explicit_inputs(inputs, start)

    def rate(t, x):
        return ravel_pytree(block.vector_field(t, unravel(x), at_time(inputs, t)))[0]

    constants, remainder = split(rate, jnp.zeros((), flat.dtype), flat)
    control, end = flat_tolerances(control, state), time[-1]
    going: Any = control
    free = isinstance(control, Control) and not conditions.signals
    further, watched = {}, (None, None, None)
    if conditions.signals:
        watched = (block, inputs, _sides(conditions, block, inputs, state, start))
    if free:
        longest = jnp.min(jnp.diff(time))
        control = going = going.to_end(time[-1], longest)
        end = jnp.full_like(end, _FAR)
    if seam is not None:
        start, flat = seam.seam.time, seam.seam.state
        further = {"dt0": seam.seam.step, "controller_state": going.begun(seam.seam)}
        further["solver_state"] = None if seam.memory is None else (seam.memory, seam.memory)
    plan = Plan(
        FlatField(remainder),
        solver,
        control,
        start,
        end,
        watched,
        _event(conditions, unravel),
        _meter(progress, start, end, time[-1]),
        adjoint,
        further,
        max_steps,
        dense,
        free,
    )
    moving = Moving(constants, flat, jnp.maximum(time, start))
    plain = adjoint is None and free and not dense and seam is None
    if plain and isinstance(solver, AbstractMethod):
        room = _room(solver, flat.size) if recorded and record is None else 0
        run, steps = replayed(moving, without_derivatives(plan), room, record)
        if steps is not None:
            record = jax.lax.stop_gradient(Record(run, steps))
    else:
        run = solved(moving, plan)
    last = run.last
    saved = jnp.isfinite(run.instants)
    path = jnp.where(saved[:, None], run.path, last)
    reached, status = run.reached, _status(run.result)
    backwards = jnp.any(time[1:] < time[:-1])
    status = Status.where(backwards, Status.not_finite, status)
    if free:  # the last step may have gone further
        last = jnp.where(saved[-1], path[-1], last)
        reached = jnp.minimum(reached, time[-1])
    masks = jax.tree.leaves(run.events)
    triggered = jnp.stack(masks) if masks else jnp.zeros(0, bool)
    return Integration(
        jax.vmap(unravel)(path),
        unravel(last),
        reached,
        status,
        jnp.asarray(run.steps),
        jnp.asarray(run.rejected),
        triggered,
        run.dense,
        Resume(run.seam, run.memory) if free else None,
        record,
    )


_RECORDED = 2**22  # numbers of the states of a run that are kept for its derivative, at most


def _room(method: AbstractMethod, states: int) -> int:
    """For how many steps there is room. Of methods that solve nothing the loop over steps is
    one kernel, which holds small arrays only."""
    largest = _RECORDED if method.solves else LARGEST
    return min(CHECKPOINTS, largest // max(1, states))


def _meter(progress: bool | str, start, far, end) -> dfx.AbstractProgressMeter:
    if not progress:
        return dfx.NoProgressMeter()
    return Meter(start, far, end, progress if isinstance(progress, str) else "simulate")


def explicit_inputs(inputs: Mapping[str, Any], t) -> dict[str, Any]:
    """Functions of time with the arrays that they close over as leaves."""
    plain = {k for k, v in inputs.items() if callable(v) and not isinstance(v, eqx.Module)}
    return {k: eqx.filter_closure_convert(v, t) if k in plain else v for k, v in inputs.items()}


def flat_tolerances(control: dfx.AbstractStepSizeController, state: PyTree):
    """The control with tolerances that are trees of the state made flat like the state."""

    def spread(value):
        if jax.tree.structure(value) == jax.tree.structure(0.0):
            return value
        full = jax.tree.map(lambda a, x: jnp.broadcast_to(a, x.shape), value, state)
        return ravel_pytree(full)[0]

    if not isinstance(control, dfx.AbstractAdaptiveStepSizeController):
        return control
    tolerances = (spread(control.rtol), spread(control.atol))
    return eqx.tree_at(lambda c: (c.rtol, c.atol), control, tolerances)


def _sides(conditions: Conditions, block, inputs, state, start):
    """On which side of zero each signal is just after the start, by its rate: where an event
    has just happened, its value there is round-off."""
    if conditions.last is None:
        return None
    rate = block.vector_field(start, state, at_time(inputs, start))

    def side(signal):
        def value(t, state):
            return signal(t, state, block, at_time(inputs, t))

        return jax.jvp(value, (start, state), (jnp.ones_like(start), rate))[1]

    signs = [1e-12 * jnp.sign(side(signal)) for signal in conditions.signals]
    return jax.lax.stop_gradient((start, conditions.last, jnp.stack(signs)))


def _event(conditions: Conditions, unravel) -> dfx.Event | None:
    if not conditions.signals:
        return None

    def watch(number, signal):
        def value(t, y, args, **_):
            _, block, inputs, sides = args
            t = jnp.asarray(t, y.dtype)
            found = signal(t, unravel(y), block, at_time(inputs, t))
            if sides is None:
                return found
            start, last, side = sides
            return jnp.where((t == start) & (last == number), side[number], found)

        return value

    watched = [watch(k, signal) for k, signal in enumerate(conditions.signals)]
    if len(watched) == 1:  # bisection finds one root and cannot miss it
        bisect = optx.Bisection(rtol=1e-12, atol=1e-12, flip="detect")
        return dfx.Event(watched[0], bisect, conditions.rising[0])
    newton = optx.Newton(rtol=1e-10, atol=1e-10)
    return dfx.Event(watched, newton, list(conditions.rising))


def _status(result: dfx.RESULTS) -> Status:
    good = (result == dfx.RESULTS.successful) | (result == dfx.RESULTS.event_occurred)
    spent = result == dfx.RESULTS.max_steps_reached
    failed = Status.where(spent, Status.max_steps, Status.not_finite)
    return Status.where(good, Status.successful, failed)


Signal = Callable[[Float[Array, ""], PyTree, Any, Mapping[str, Any]], Float[Array, ""]]


class Event(eqx.Module):
    """A crossing of zero by a signal.

    Attributes:
        signal: (t, state, network, inputs) -> number, or the name of a scalar output.
        reset: (t, state) -> the state after the event; None ends the run there.
        rising: True: upwards only, False: downwards only, None: both.
    """

    signal: Signal | str
    reset: Callable[[Float[Array, ""], PyTree], PyTree] | None = None
    rising: bool | None = eqx.field(static=True, default=None)


class EventLog(eqx.Module):
    """The events of a run: their `count`, the `time` of each [s] (infinite beyond), and `which`
    of the events it was, by number."""

    count: Array
    time: Float[Array, " most"]
    which: Array


def run_with_events(
    block: Network,
    inputs: Mapping[str, Any],
    state: PyTree,
    time: Float[Array, " time"],
    solver,
    control,
    events: tuple[Event, ...],
    most: int,
    **options: Any,
) -> tuple[Integration, EventLog]:
    """A run in at most `most` + 1 pieces, joined on one grid."""
    conditions = Conditions(
        tuple(_signal(event.signal) for event in events),
        tuple(event.rising for event in events),
    )

    def piece(carry, _):
        path, state, start, done, status, last = carry
        part = adaptive(
            block,
            inputs,
            state,
            time,
            solver,
            control,
            start=start,
            conditions=conditions._replace(last=last),
            **options,
        )
        hit = jnp.any(part.triggered) & ~done
        which = jnp.argmax(part.triggered).astype(jnp.int32)
        new = _reset(events, which, part.reached, part.last)
        later = (time >= start) & ~done
        path = jax.tree.map(
            lambda a, b: jnp.where(later.reshape(-1, *[1] * (a.ndim - 1)), b, a),
            path,
            part.path,
        )
        ends = jnp.stack([jnp.asarray(event.reset is None) for event in events])[which]
        status = Status.where(done, status, part.status)
        finished = done | ~hit | ends
        held = done | ~hit
        state = jax.tree.map(
            lambda a, b, c: jnp.where(done, c, jnp.where(held, b, a)), new, part.last, state
        )
        reached = jnp.where(done, start, part.reached)
        steps = jnp.where(done, jnp.zeros_like(part.steps), part.steps)
        rejected = jnp.where(done, jnp.zeros_like(part.steps), part.rejected)
        when = jnp.where(hit, part.reached, jnp.inf)
        return (path, state, reached, finished, status, jnp.where(hit, which, last)), (
            hit,
            when,
            which,
            steps,
            rejected,
        )

    blank = jax.tree.map(lambda x: jnp.broadcast_to(x, (time.shape[0], *x.shape)), state)
    none = jnp.full((), -1, jnp.int32)
    begin = (blank, state, time[0], jnp.array(False), Status.successful, none)
    carry, logs = jax.lax.scan(piece, begin, length=most + 1)
    path, last, reached, finished, status, _ = carry
    hits, when, which, steps, rejected = logs
    status = Status.where(finished, status, Status.max_events)
    motion = Integration(
        path, last, reached, status, jnp.sum(steps), jnp.sum(rejected), hits[-1:], None
    )
    return motion, EventLog(jnp.sum(hits), when, which)


def _signal(signal: Signal | str) -> Signal:
    if not isinstance(signal, str):
        return signal

    def value(t, state, block, inputs):
        return block.output(signal, t, state, inputs)

    return value


def _reset(events, which, t, state):
    def branch(event):
        return lambda: state if event.reset is None else event.reset(t, state)

    return jax.lax.switch(which, [branch(event) for event in events])
