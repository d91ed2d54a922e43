"""Events: moments at which a signal crosses zero, that end a run or reset its state."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from sorojax.math.status import Status
from sorojax.systems.integrate.integrate import Conditions, Integration, adaptive
from sorojax.systems.network import Network

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
    """The events of a run: how many, when [s] (infinite beyond), and which of the events."""

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
            block, inputs, state, time, solver, control, start=start,
            conditions=conditions._replace(last=last), **options,
        )  # fmt: skip
        hit = jnp.any(part.triggered) & ~done
        which = jnp.argmax(part.triggered).astype(jnp.int32)
        new = _reset(events, which, part.reached, part.last)
        later = (time >= start) & ~done
        path = jax.tree.map(
            lambda a, b: jnp.where(later.reshape(-1, *[1] * (a.ndim - 1)), b, a),
            path, part.path,
        )  # fmt: skip
        ends = jnp.stack([jnp.asarray(event.reset is None) for event in events])[which]
        status = Status.where(done, status, part.status)
        finished = done | ~hit | ends
        held = done | ~hit
        state = jax.tree.map(lambda a, b, c: jnp.where(done, c, jnp.where(held, b, a)),
                             new, part.last, state)  # fmt: skip
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
