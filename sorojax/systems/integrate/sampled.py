"""Simulation with controllers that are called at instants, their commands held between."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from sorojax import _check
from sorojax._jax.trace_state import is_traced
from sorojax._types import real
from sorojax.math.host import tell
from sorojax.math.ode.explicit import AbstractMethod, finite
from sorojax.math.ode.step_control import (
    Doubled,
    judged_status,
    passes,
    positions,
    rows_too_long,
    whole_rows,
)
from sorojax.systems.integrate.integrate import explicit_inputs
from sorojax.systems.integrate.march import Walk, as_tree, as_trees, interval_of, rate_of
from sorojax.systems.integrate.simulate import (
    Trajectory,
    default_method,
    last_state,
    within_model,
)
from sorojax.systems.network import Network, at_time, outputs

Ports = str | tuple[str, ...]


class Sampled(eqx.Module):
    """A controller on a network, called every so many ticks.

    Attributes:
        controller: `controller(t, measurement, memory) -> (command, memory)`, with
            `controller.start(t, measurement)` for the memory before the first call.
        measurement: The output that it reads; of several names it gets a tuple.
        command: The exposed input that it drives; for several names it returns a tuple.
        every: Ticks between its calls.
    """

    controller: Callable[[Any, Any, Any], tuple[Any, Any]]
    measurement: Ports = eqx.field(static=True)
    command: Ports = eqx.field(static=True)
    every: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if self.every < 1:
            raise ValueError(f"Sampled: `every` must be 1 or more, got {self.every}.")


def simulate_sampled(
    network: Network,
    controller: Any,
    duration: float | Float[Array, ""],
    *,
    period: float | Float[Array, ""],
    measurement: Ports | None = None,
    command: Ports | None = None,
    substeps: int = 10,
    method: AbstractMethod | None = None,
    state: PyTree = None,
    memory: Any = None,
    inputs: Mapping[str, Any] | None = None,
    progress: bool = False,
    resume: Trajectory | None = None,
) -> Trajectory:
    """Time simulation of a network under sampled controllers; commands are held between calls.

    The controllers are the objects that also run on the bench. Time is counted in whole ticks
    of `period`, so that no call is lost or doubled however long the run. Differentiable; a run
    that fails holds its last good state.

    Args:
        network: The network; the inputs that are commanded are exposed.
        controller: A controller, or a tuple of `Sampled` of several rates.
        duration: How long [s], rounded to whole periods.
        period: Length of a tick [s]; time between calls of a single controller.
        measurement: Output that a single controller reads, `"body.tip_angle"`.
        command: Exposed input that it drives, `"valve.setpoint"`.
        substeps: Steps of the method in a tick.
        method: `RungeKutta4()` by default, `Coupled()` where there is a `FemBody`; `Rodas4()`
            for stiff networks.
        state: Where the network starts; `network.initial_state()` by default.
        memory: What a single controller remembers; `controller.start` by default.
        inputs: Values or references for the other exposed inputs, in the units of their ports.
        progress: Report progress while running.
        resume: A run to go on from; two halves give the bits of the whole.

    Returns:
        States and outputs at the ticks [s], outputs with the commands just given.

    Raises:
        ValueError: If a port does not exist, a commanded one is not exposed, `period` is not
            positive, it or `duration` is traced, or a controller has no `start` and `memory` is
            not given.
        TypeError: If the controller is no function.

    Example:
        >>> network = systems.Network({"valve": systems.Lag(0.1)}, {}, exposed=("valve.a",))
        >>> pid = systems.PID(4.0, reference=systems.Constant(1.0))
        >>> run = systems.simulate_sampled(network, pid, 0.5, period=0.01, substeps=2,
        ...                                measurement="valve.value", command="valve.a")
        >>> print(f"{float(run['valve.value'][-1]):.3f}")  # 4 / (1 + 4)
        0.800

    Reference:
        Astrom and Wittenmark, Computer-Controlled Systems, 1997, chapter 2.
    """
    loops = _loops(controller, measurement, command)
    for loop in loops:
        _check_ports(network, loop)
    _check.positive("simulate_sampled", "period", period, "s", "100 Hz is period=0.01.")
    if is_traced((duration, period)):
        raise ValueError(
            "simulate_sampled: `duration` and `period` fix the number of calls and cannot "
            "be traced. Pass Python numbers."
        )
    ticks = max(1, round(float(duration) / float(period)))
    first = jnp.zeros((), jnp.int32)
    if memory is None and resume is None:
        _check_starts(loops)
    memories = None if memory is None else (memory,)
    held = kept = None
    if resume is not None:
        state, (memories, held, kept) = last_state(resume), resume.memory
        first = jnp.round(resume.time[-1] / real(period)).astype(jnp.int32)
    supplied = {k: v if callable(v) else real(v) for k, v in (inputs or {}).items()}
    plan = (ticks, substeps, default_method(network) if method is None else method, progress)
    before = (memories, held, kept)
    return _run(network, loops, state, before, supplied, real(period), first, plan)


@eqx.filter_jit
def _run(network, loops, state, before, inputs, period, first, settings) -> Trajectory:
    (ticks, substeps, method, progress), (memories, held, kept) = settings, before
    state = network.initial_state() if state is None else state
    inputs = explicit_inputs(inputs, period)
    held = _nothing(network, loops, period.dtype) if held is None else held
    state, unravel, rate = rate_of(method, network, inputs, state, held)
    move = interval_of(substeps)
    time = period * (first + jnp.arange(ticks + 1, dtype=jnp.int32)).astype(period.dtype)

    def signals(t, state, held):
        return outputs(network, t, as_tree(unravel, state), {**at_time(inputs, t), **held})

    def call(tick, t, state, memories, held):
        seen = signals(t, state, held)
        kept = []
        for loop, memory in zip(loops, memories, strict=True):
            held, memory = _call(loop, tick, t, seen, memory, held)
            kept.append(memory)
        return tuple(kept), held

    def advance(carry, one_pass):
        run, memories, held, kept = carry
        row, opens, part, start, length = one_pass
        tick, walk, h = first + row, run.begin(part), length * period
        t = period * (first.astype(period.dtype) + start)
        # The call at the seam was made before; further passes of a tick keep its commands.
        called = ((tick == first) & (first > 0)) | ~opens
        memories, held = jax.lax.cond(
            called, lambda: (memories, held), lambda: call(tick, t, walk.state, memories, held)
        )
        given = (method, rate.under(held), t, walk.state, walk.memory)
        new = walk.after(move.taken(given, h), t + h)
        run = run.end(part, new)
        kept = jax.tree.map(lambda a, b: jnp.where(part == 0, a, b), walk.memory, kept)
        if progress:
            tell("simulate", row / ticks)
        seen = (walk.state, {**signals(t, walk.state, held), **held}, memories, held)
        return (run, memories, held, kept), (seen, new.state)

    if memories is None:
        seen = signals(time[0], state, held)
        memories = tuple(
            loop.controller.start(time[0], _pick(seen, loop.measurement)) for loop in loops
        )
    if kept is None:
        _, commands = call(first, time[0], state, memories, held)
        kept = move.begin((method, rate.under(commands), time[0], state), period)
    if method.carries:  # a step is large beside what it starts from
        advance = jax.checkpoint(advance, prevent_cse=False)  # pyright: ignore[reportPrivateImportUsage]
    walk = Walk(state, kept, finite(state), jnp.array(True), time[0])
    plan = passes(ticks + 1, (ticks + 1) * substeps, not method.carries)
    dtype = period.dtype
    places = plan.start.astype(dtype), plan.length.astype(dtype)
    made = (plan.row, plan.opens, plan.part, *places)
    carry, (seen, ends) = jax.lax.scan(advance, (Doubled.at(walk), memories, held, kept), made)
    states, values, memories, held = whole_rows(plan, seen)
    run, *_, kept = carry
    ended = run.now
    good, reached = finite((states, values)) & ended.good, jnp.minimum(ended.reached, time[-1])
    path = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), states, ended.state)
    states, path, ends = (as_trees(unravel, of) for of in (states, path, ends))
    too_long = rows_too_long(plan, positions(path), positions(ends))
    status = judged_status(ended._replace(good=good).status, too_long)
    status = within_model(network, status, states)
    stats = {
        "steps": jnp.asarray(ticks * substeps),
        "calls": jnp.asarray(sum(ticks // loop.every + 1 for loop in loops)),
        "reached": reached,
    }
    memory = (*jax.tree.map(lambda x: x[-1], (memories, held)), kept)
    return Trajectory(time, states, values, status, stats, memory=memory)


def _call(loop: Sampled, tick, t, seen, memory, held):
    """Commands and memory after the tick, at which the controller may be due."""

    def fresh():
        command, new = loop.controller(t, _pick(seen, loop.measurement), memory)
        names = _names(loop.command)
        values = (command,) if isinstance(loop.command, str) else tuple(command)
        return {**held, **dict(zip(names, values, strict=True))}, new

    if loop.every == 1:
        return fresh()
    return jax.lax.cond(tick % loop.every == 0, fresh, lambda: (held, memory))


def _loops(controller, measurement, command) -> tuple[Sampled, ...]:
    if isinstance(controller, Sampled):
        return (controller,)
    if isinstance(controller, tuple):
        return controller
    if measurement is None or command is None:
        raise ValueError(
            "simulate_sampled: a controller alone needs `measurement` and `command`: "
            'measurement="body.tip_angle", command="valve.setpoint".'
        )
    if not callable(controller):
        raise TypeError(
            f"simulate_sampled: got {controller!r} for `controller`, need a function or a "
            "Sampled. Write controller(t, measurement, memory) -> (command, memory)."
        )
    law: Any = controller
    return (Sampled(law, measurement, command),)


def _check_starts(loops: tuple[Sampled, ...]) -> None:
    for loop in loops:
        if not hasattr(loop.controller, "start"):
            raise ValueError(
                f"simulate_sampled: got {loop.controller!r} without `start` as a controller, "
                "need what it remembers before the first call. Pass `memory=`, `memory={}` if "
                "it remembers nothing."
            )


def _check_ports(network: Network, loop: Sampled) -> None:
    for name in _names(loop.command):
        if name not in network.inputs:
            raise ValueError(
                f"simulate_sampled: `{name}` is not an exposed input of the network "
                f'({", ".join(network.inputs) or "none"}). Write exposed=("{name}",).'
            )
    for name in _names(loop.measurement):
        if name not in network.outputs:
            raise ValueError(
                f"simulate_sampled: there is no output `{name}`; the outputs are "
                f"{', '.join(network.outputs)}."
            )


def _nothing(network: Network, loops, dtype) -> dict[str, Array]:
    names = [name for loop in loops for name in _names(loop.command)]
    return {name: jnp.zeros(network.inputs[name].shape, dtype) for name in names}


def _names(ports: Ports) -> tuple[str, ...]:
    return (ports,) if isinstance(ports, str) else tuple(ports)


def _pick(signals: Mapping[str, Array], ports: Ports) -> Any:
    if isinstance(ports, str):
        return signals[ports]
    return tuple(signals[name] for name in ports)
