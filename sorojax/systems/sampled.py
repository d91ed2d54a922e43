"""Simulation with a controller that is called at instants, its command held between."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from sorojax import _check
from sorojax._types import is_traced, real
from sorojax.math.status import Status
from sorojax.math.steppers import rk4_step
from sorojax.systems.controller import AbstractController
from sorojax.systems.network import Network, at_time, outputs
from sorojax.systems.simulate import Trajectory, all_finite


def simulate_sampled(
    network: Network,
    controller: AbstractController,
    duration,
    *,
    measurement: str,
    command: str,
    period,
    substeps: int = 10,
    state: PyTree = None,
    memory: Any = None,
    inputs: Mapping[str, Any] | None = None,
) -> Trajectory:
    """Run a network under a sampled controller, the very object that drives the bench.

    Args:
        network: The network; the input `command` is exposed.
        controller: `controller(t, measurement, memory) -> (command, memory)`.
        duration: [s], rounded to whole periods.
        measurement: Output that the controller reads, `"body.tip_angle"`.
        command: Exposed input that it drives, `"valve.setpoint"`.
        period: Time between calls [s].
        substeps: Runge-Kutta steps in a period.
        state: Where the network starts.
        memory: What the controller remembers; `controller.start` if omitted.
        inputs: Values or references for the other exposed inputs.

    Returns:
        States and outputs at the calls, outputs with the `command` just given.
    """
    if command not in network.inputs:
        raise ValueError(
            f"simulate_sampled: `{command}` is not an exposed input of the network "
            f'({", ".join(network.inputs) or "none"}). Write exposed=("{command}",).'
        )
    if measurement not in network.outputs:
        raise ValueError(
            f"simulate_sampled: there is no output `{measurement}`; the outputs are "
            f"{', '.join(network.outputs)}."
        )
    _check.positive("simulate_sampled", "period", period, "s", "100 Hz is period=0.01.")
    if is_traced((duration, period)):
        raise ValueError(
            "simulate_sampled: `duration` and `period` fix the number of calls and cannot "
            "be traced. Pass Python numbers."
        )
    ticks = max(1, round(float(duration) / float(period)))
    state = network.initial_state() if state is None else state
    supplied = {k: v if callable(v) else real(v) for k, v in (inputs or {}).items()}
    ports = (measurement, command)
    return _run(
        network, controller, state, memory, supplied, real(period), ports, ticks, substeps
    )


@eqx.filter_jit
def _run(network, controller, state, memory, inputs, period, ports, ticks, substeps):
    measurement, command = ports
    h = period / substeps

    def signals(t, state, held):
        return outputs(network, t, state, {**at_time(inputs, t), command: held})

    def tick(carry, t):
        state, memory, held = carry
        measured = signals(t, state, held)[measurement]
        held, memory = controller(t, measured, memory)

        def field(t, state):
            return network.vector_field(t, state, {**at_time(inputs, t), command: held})

        def one(k, state):
            return rk4_step(field, t + k.astype(t.dtype) * h, state, h)

        seen = (state, {**signals(t, state, held), command: held})
        return (jax.lax.fori_loop(0, substeps, one, state), memory, held), seen

    time = period * jnp.arange(ticks + 1, dtype=period.dtype)
    held = jnp.zeros(network.inputs[command].shape, period.dtype)
    if memory is None:
        memory = controller.start(time[0], signals(time[0], state, held)[measurement])
    _, (states, values) = jax.lax.scan(tick, (state, memory, held), time)
    status = Status.where(all_finite((states, values)), Status.successful, Status.not_finite)
    stats = {"steps": jnp.asarray(ticks * substeps), "calls": jnp.asarray(ticks + 1)}
    return Trajectory(time, states, values, status, stats)
