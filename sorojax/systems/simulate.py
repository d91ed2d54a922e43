"""Time simulation of networks."""

from collections.abc import Mapping
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from sorojax import _check
from sorojax._types import is_traced, real
from sorojax.math.status import Status
from sorojax.math.steppers import rk4_step
from sorojax.systems.network import Network, as_term, at_time, outputs


class Trajectory(eqx.Module):
    """A simulated motion.

    Attributes:
        time: Saved instants [s].
        state: State of every block, with a leading time axis.
        outputs: Every output, `{"block.output": values}`, with a leading time axis.
        status: How the run ended; after a failure the later instants are not finite.
        stats: Numbers of the run, e.g. `steps`.
    """

    time: Float[Array, " time"]
    state: PyTree
    outputs: dict[str, Array]
    status: Status
    stats: dict[str, Array]

    def __getitem__(self, name: str) -> Array:
        return self.outputs[name]


def simulate(
    network: Network,
    duration,
    *,
    state: PyTree = None,
    inputs: Mapping[str, Any] | None = None,
    save: int = 201,
    step=None,
    rtol=1e-6,
    atol=1e-8,
    solver: dfx.AbstractSolver | None = None,
    max_steps: int = 200_000,
    adjoint: dfx.AbstractAdjoint | None = None,
    throw: bool = True,
) -> Trajectory:
    """Run a network for `duration` [s] from t = 0; differentiable in all its leaves.

    Args:
        network: The network.
        duration: [s].
        state: Where to start; `network.initial_state()` if omitted.
        inputs: Values or references (functions of time) for the exposed inputs.
        save: Number of saved instants, both ends included.
        step: A fixed step [s] for classical Runge-Kutta; adaptive if omitted.
        rtol: Relative tolerance of the adaptive run.
        atol: Absolute tolerance, in the unit of each state.
        solver: Adaptive method; `diffrax.Tsit5()` if omitted. A very fast regulator
            makes the network stiff: raise `max_steps` or slow it down.
        max_steps: Limit of adaptive steps.
        adjoint: How diffrax differentiates; by default reverse mode with checkpoints.
            `diffrax.ForwardMode()` for derivatives in a few parameters.
        throw: Raise when a run outside a transformation fails; False returns the status.

    Raises:
        RuntimeError: If the run failed and `throw` is set.
    """
    _check.positive("simulate", "duration", duration, "s", "Give the end time.")
    if save < 2:
        raise ValueError(f"simulate: `save` must be 2 or more, got {save}.")
    state = network.initial_state() if state is None else state
    supplied = {k: v if callable(v) else real(v) for k, v in (inputs or {}).items()}
    time = jnp.linspace(jnp.zeros_like(real(duration)), real(duration), save)
    if step is None:
        solver = dfx.Tsit5() if solver is None else solver
        adjoint = dfx.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
        control = dfx.PIDController(rtol=real(rtol), atol=real(atol))
        film = _adaptive(network, state, supplied, time, solver, control, max_steps, adjoint)
    else:
        substeps = _substeps(duration, save, step)
        film = _fixed(network, state, supplied, time, substeps)
    failed = throw and not is_traced(film)
    if failed and not bool(film.status == Status.successful):
        reached = _reached(film)
        raise RuntimeError(
            f"simulate: stopped after {reached:g} s of {float(real(duration)):g} s and "
            f"{int(film.stats['steps'])} steps. {Status[film.status]}"
        )
    return film


@eqx.filter_jit
def _adaptive(network, state, inputs, time, solver, control, max_steps, adjoint):
    solution = dfx.diffeqsolve(
        as_term(network, inputs),
        solver,
        time[0],
        time[-1],
        None,
        state,
        args=network,
        saveat=dfx.SaveAt(ts=time),
        stepsize_controller=control,
        max_steps=max_steps,
        adjoint=adjoint,
        throw=False,
    )
    ended = Status.where(
        solution.result == dfx.RESULTS.max_steps_reached,
        Status.max_steps,
        Status.where(
            solution.result == dfx.RESULTS.successful, Status.successful, Status.not_finite
        ),
    )
    stats = {
        "steps": jnp.asarray(solution.stats["num_steps"]),
        "rejected": jnp.asarray(solution.stats["num_rejected_steps"]),
    }
    return _film(network, time, solution.ys, inputs, ended, stats)


@eqx.filter_jit
def _fixed(network, state, inputs, time, substeps: int):
    h = (time[1] - time[0]) / substeps

    def field(t, state):
        return network.vector_field(t, state, at_time(inputs, t))

    def advance(state, t):
        def one(k, state):
            return rk4_step(field, t + k.astype(t.dtype) * h, state, h)

        state = jax.lax.fori_loop(0, substeps, one, state)
        return state, state

    _, path = jax.lax.scan(advance, state, time[:-1])
    path = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), state, path)
    stats = {"steps": jnp.asarray(substeps * (time.shape[0] - 1))}
    return _film(network, time, path, inputs, Status.successful, stats)


def _film(network, time, states, inputs, status, stats) -> Trajectory:
    values = jax.vmap(lambda t, x: outputs(network, t, x, at_time(inputs, t)))(time, states)
    broken = (status == Status.successful) & ~all_finite((states, values))
    status = Status.where(broken, Status.not_finite, status)
    return Trajectory(time, states, values, status, stats)


def all_finite(tree: PyTree) -> Array:
    """Whether every number in `tree` is finite."""
    leaves = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]
    return jnp.all(jnp.stack(leaves))


def _substeps(duration, save: int, step) -> int:
    if is_traced((duration, step)):
        raise ValueError(
            "simulate: `duration` and `step` fix the number of steps and cannot be traced. "
            "Pass Python numbers, or leave `step` out for an adaptive run."
        )
    interval = float(duration) / (save - 1)
    return max(1, round(interval / float(step) + 0.499))


def _reached(film: Trajectory) -> float:
    leaves = [leaf.reshape(leaf.shape[0], -1) for leaf in jax.tree.leaves(film.state)]
    fine = jnp.all(jnp.isfinite(jnp.concatenate(leaves, axis=1)), axis=1)
    return float(jnp.max(jnp.where(fine, film.time, film.time[0])))
