"""Time simulation of networks."""

import functools
from collections.abc import Mapping
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from sorojax import _check
from sorojax._display import displayed, number, outcome
from sorojax._jax.jit import once
from sorojax._jax.small_kernels import LARGEST_GIVEN
from sorojax._jax.trace_state import is_traced
from sorojax._types import real
from sorojax.math.ode.explicit import AbstractMethod, RungeKutta4, Tsit5, finite
from sorojax.math.ode.step_control import Control
from sorojax.math.status import Status
from sorojax.math.two_programs import two_programs
from sorojax.systems.integrate.coupled import Coupled, bodies_of, check_places
from sorojax.systems.integrate.free_run import Record
from sorojax.systems.integrate.integrate import (
    Event,
    EventLog,
    Integration,
    Resume,
    adaptive,
    run_with_events,
)
from sorojax.systems.integrate.march import fixed
from sorojax.systems.integrate.staggered import Staggered, touching_bodies
from sorojax.systems.network import Network, at_time, outputs


@displayed
class Trajectory(eqx.Module):
    """A simulated motion.

    Attributes:
        time: Saved instants [s].
        state: State of every block, with a leading time axis.
        outputs: Every output, `{"block.output": values}`, with a leading time axis.
        status: How the run ended.
        stats: Numbers of the run: `steps`, `rejected`, and `reached` [s], beyond which the
            last good state is held.
        memory: What controllers remember and hold and the method keeps, to go on from.
        happened: The events, if there were any to watch.
        dense: The continuous solution for `state_at`, if asked for.
    """

    time: Float[Array, " time"]
    state: PyTree
    outputs: dict[str, Array]
    status: Status
    stats: dict[str, Array]
    memory: Any = None
    happened: EventLog | None = None
    dense: dfx.DenseInterpolation | None = None

    def __getitem__(self, name: str) -> Array:
        return self.outputs[name]

    def _text(self) -> str:
        steps = number(self.stats["steps"])
        rows = [
            f"Trajectory: {self.time.shape[-1]} saved instants, {outcome(self.status)}, "
            f"{steps} steps",
            f"  time {number(self.time, 's')}",
        ]
        rows += [f"  {name} {number(values)}" for name, values in self.outputs.items()]
        return "\n".join(rows)


def last_state(film: Trajectory) -> PyTree:
    """The state at the end of a motion.

    Args:
        film: From `simulate`.

    Returns:
        The state, to go on from.
    """
    return jax.tree.map(lambda x: x[-1], film.state)


def state_at(film: Trajectory, t: Float[Array, ""]) -> PyTree:
    """The state at any time [s] of a run made with `dense=True`.

    Args:
        film: From `simulate`.
        t: Time [s].

    Returns:
        The state of the network.
    """
    if film.dense is None:
        raise ValueError(
            "state_at: this motion holds saved instants only. Run simulate(..., dense=True)."
        )
    return ravel_pytree(last_state(film))[1](film.dense.evaluate(t))


def simulate(
    network: Network,
    duration: float | Float[Array, ""],
    *,
    state: PyTree = None,
    inputs: Mapping[str, Any] | None = None,
    save: int = 201,
    step: float | Float[Array, ""] | None = None,
    rtol: Any = 1e-6,
    atol: Any = 1e-8,
    max_step: float | Float[Array, ""] | None = None,
    solver: dfx.AbstractSolver | None = None,
    max_steps: int = 200_000,
    events: tuple[Event, ...] = (),
    max_events: int = 100,
    adjoint: dfx.AbstractAdjoint | None = None,
    dense: bool = False,
    progress: bool = False,
    resume: Trajectory | None = None,
    throw: bool = True,
) -> Trajectory:
    """Time simulation of a network, x' = f(t, x, u(t)) from t = 0.

    Adaptive explicit Runge-Kutta (Tsitouras 5(4)) by default, through diffrax. Differentiable
    in every number of the network, its inputs and its start. A run that fails holds its last
    good state, which has finite derivatives.

    Args:
        network: The network.
        duration: How long [s].
        state: Where to start; `network.initial_state()` by default.
        inputs: Values or references (functions of time) for the exposed inputs, in the units of
            their ports.
        save: Number of saved instants, both ends included.
        step: A fixed step [s]; adaptive by default.
        rtol: Relative tolerance of the adaptive run [-]: a number, or a tree like the state.
        atol: Absolute tolerance, in the unit of each state: a number, or such a tree.
        max_step: Longest adaptive step [s]; no limit by default. It keeps an event that comes
            and goes from being stepped over, and two events from falling into one step, where
            the first listed would win.
        solver: By default `Tsit5()`, `RungeKutta4()` with a fixed step, `Coupled()` where
            there is a `FemBody`, `Staggered()` where a reduced body touches something.
            `Rodas4()` where a regulator, a valve or a filter is far faster than the body.
        max_steps: Limit of adaptive steps.
        events: Ends of the run, and resets of its state; none by default.
        max_events: Most resets.
        adjoint: How diffrax differentiates; by default in reverse, by the accepted steps
            once more. `diffrax.ForwardMode()` for derivatives in a few parameters.
        dense: Keep the continuous solution, for `state_at`; takes memory by `max_steps`.
        progress: Report progress while running, which costs a little.
        resume: A run to go on from, with the state and the time of its end. Two halves
            give the bits of the whole, with fixed steps and, without events, adaptively: the
            size of the step goes on too.
        throw: Raise when a run outside a transformation fails; False returns the status.

    Returns:
        Times [s], states and outputs at the saved instants, and how the run ended.

    Raises:
        RuntimeError: If the run failed and `throw` is set.
        ValueError: If `duration` is not positive, `save` is below 2, a fixed `step` comes with
            events or `dense`, or `state` with `resume`; if nodes of a body do not begin where
            its driven supports are.

    Example:
        >>> network = systems.Network({"valve": systems.Lag(0.1)}, {}, exposed=("valve.a",))
        >>> run = systems.simulate(network, 0.1, inputs={"valve.a": 1.0}, save=2)
        >>> print(f"{float(run['valve.value'][-1]):.4f}")  # 1 - 1/e
        0.6321

    Reference:
        Tsitouras, Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying
        assumption, Comput. Math. Appl. 62, 2011; Kidger, On Neural Differential Equations,
        2021, for diffrax.
    """
    _check.positive("simulate", "duration", duration, "s", "Give the end time.")
    if save < 2:
        raise ValueError(f"simulate: `save` must be 2 or more, got {save}.")
    if step is not None and (events or dense):
        raise ValueError(
            "simulate: events and dense output need an adaptive run, got a fixed `step`. "
            "Leave `step` out, or bound it by max_step=."
        )
    if dense and events:
        raise ValueError(
            "simulate: got `dense` and `events`; a continuous solution has no resets. Save "
            "more instants instead."
        )
    state, first = _start(state, resume)
    supplied = {k: v if callable(v) else real(v) for k, v in (inputs or {}).items()}
    interval = real(duration) / (save - 1)
    memory = None if resume is None else resume.memory
    if step is None:
        control = Control(rtol, atol, max_step=max_step)
        options = {"max_steps": max_steps, "adjoint": adjoint, "progress": progress}
        if not events:
            options["seam"] = memory if isinstance(memory, Resume) else None
        watch = (events, max_events, dense)
        solver = Tsit5() if solver is None else solver
        time, motion, happened, _ = _adaptive(
            network, state, supplied, first, interval, save, solver, control, watch, options
        )
        film = film_of(network, time, supplied, motion, happened)
    else:
        method = _fixed_method(network, solver)
        substeps = _substeps(duration, save, step)
        plan = (save, method, substeps, progress)
        memory = None if isinstance(memory, Resume) else memory
        check_places(network, first.astype(interval.dtype) * interval, state, supplied)
        run = _fixed_with_solids if bodies_of(network) else _fixed
        film = run(network, state, supplied, first, interval, plan, memory)
    failed = throw and not is_traced(film)
    if failed and not bool(film.status == Status.successful):
        raise RuntimeError(
            f"simulate: stopped after {float(film.stats['reached']):g} s of "
            f"{float(film.time[-1]):g} s and {int(film.stats['steps'])} steps. "
            f"{Status[film.status]}"
        )
    return film


def _run_adaptive(
    network,
    state,
    inputs,
    first,
    interval,
    save,
    solver,
    control,
    watch,
    options,
    record=None,
    recorded=True,
) -> tuple[Array, Integration, EventLog | None, Record | None]:
    time = instants(first, interval, save)
    state = network.initial_state() if state is None else state
    events, most, dense = watch
    happened = None
    run = (network, inputs, state, time, solver, control)
    if events:
        motion, happened = run_with_events(*run, events, most, **options)
    else:
        motion = adaptive(*run, dense=dense, recorded=recorded, record=record, **options)
    return time, motion._replace(record=None), happened, motion.record


def _run_within(*args: Any) -> tuple[Array, Integration, EventLog | None, None]:
    """The same within `jit` and `vmap`."""
    return *_run_adaptive(*args, recorded=False)[:3], None


_FEW = 4096  # steps of which every state is kept for the derivative


def _run_again(found: tuple[Any, Integration, Any, Record | None], *args: Any) -> tuple:
    """The arguments of the run that is differentiated: silent, with the steps that it took, or
    with as many steps as it takes, so that few of its states are computed twice."""
    _, motion, _, record = found
    *others, watch, options = args
    options = options | {"progress": False}
    if record is not None and int(record.steps.count) < record.steps.time.shape[0]:
        return *others, watch, options, record
    _, _, dense = watch
    most, taken = options["max_steps"], int(motion.steps)
    if not dense:
        most = min(most, max(_FEW, 2 ** (taken + taken // 8).bit_length()))
    return *others, watch, options | {"max_steps": most}


_adaptive = two_programs(
    _run_adaptive, _run_again, _run_within, kernels=True, largest=LARGEST_GIVEN
)


def _run_fixed(network, state, inputs, first, interval, plan, memory) -> Trajectory:
    save, method, substeps, progress = plan
    time = instants(first, interval, save)
    state = network.initial_state() if state is None else state
    motion = fixed(network, inputs, state, time, interval, method, substeps, memory, progress)
    return film_of(network, time, inputs, motion)


_fixed = once(_run_fixed)
# The products of many cells run faster by the compiler's own loops.
_fixed_with_solids = eqx.filter_jit(_run_fixed)


def instants(first: Array, interval: Array, save: int) -> Float[Array, " time"]:
    """`save` instants, from number `first` of a grid that starts at zero."""
    return interval * (first + jnp.arange(save, dtype=jnp.int32)).astype(interval.dtype)


def film_of(network, time, inputs, motion: Integration, happened=None) -> Trajectory:
    """The motion with every output."""
    values, status = _seen(network, time, inputs, motion.path, motion.status)
    stats = {"steps": motion.steps, "rejected": motion.rejected, "reached": motion.reached}
    return Trajectory(
        time,
        motion.path,
        values,
        status,
        stats,
        memory=motion.memory,
        happened=happened,
        dense=motion.dense,
    )


@functools.partial(two_programs, kernels=True, largest=LARGEST_GIVEN, optimised=False)
def _seen(network, time, inputs, path, status) -> tuple[dict[str, Array], Status]:
    """Every output along a path, and the status of a run that ended with `status`."""

    def one(moment):
        t, state = moment
        return outputs(network, t, state, at_time(inputs, t))

    large = bool(bodies_of(network))  # all instants at once would fill the memory
    values = jax.lax.map(one, (time, path)) if large else jax.vmap(one)((time, path))
    failed = (status == Status.successful) & ~finite(values)
    status = Status.where(failed, Status.not_finite, status)
    return values, within_model(network, status, path)


def within_model(network: Network, status: Status, path: PyTree) -> Status:
    """`status`, or what the blocks find wrong with the path of a successful run."""
    found = network.path_status(path)
    if found is None:
        return status
    return Status.where(status == Status.successful, found, status)


def _start(state: PyTree, resume: Trajectory | None) -> tuple:
    """First state, None for that of the network, and its number on the grid of instants."""
    zero = jnp.zeros((), jnp.int32)
    if resume is None:
        return state, zero
    if state is not None:
        raise ValueError("simulate: got both `state` and `resume`. Give one of them.")
    interval = resume.time[1] - resume.time[0]
    number = jnp.round(resume.time[-1] / interval).astype(jnp.int32)
    return last_state(resume), number


def _fixed_method(network: Network, solver) -> AbstractMethod:
    method = default_method(network) if solver is None else solver
    if not isinstance(method, AbstractMethod):
        raise ValueError(
            f"simulate: {type(method).__name__} takes no fixed `step` here, need a method of "
            "sorojax: RungeKutta4(), Tsit5(), Rodas4() or SemiImplicitEuler()."
        )
    return method


def default_method(network: Network) -> AbstractMethod:
    """The method of fixed steps of a network."""
    if bodies_of(network):
        return Coupled()
    return Staggered() if touching_bodies(network) else RungeKutta4()


def _substeps(duration, save: int, step) -> int:
    if is_traced((duration, step)):
        raise ValueError(
            "simulate: `duration` and `step` fix the number of steps and cannot be traced. "
            "Pass Python numbers, or leave `step` out for an adaptive run."
        )
    interval = float(duration) / (save - 1)
    return max(1, round(interval / float(step) + 0.499))
