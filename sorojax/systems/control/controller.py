"""Controllers: one contract for simulation and bench.

A sampled controller is `controller(t, measurement, state) -> (command, state)`, pure,
with `controller.start(t, measurement)` for the state before the first call.
"""

import abc
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.systems.blocks.block import AbstractBlock, AbstractReference, Input, Output

Scalar = Float[Array, ""]


class AbstractController(AbstractBlock):
    """A controller that is called at instants, and may be wired as a continuous block."""

    @abc.abstractmethod
    def start(self, t: Any, measurement: Any) -> Any:
        """State before the first call, at a bumpless rest."""

    @abc.abstractmethod
    def __call__(self, t: Any, measurement: Any, state: Any) -> tuple[Any, Any]:
        """Command, and the state to pass to the next call."""


class PIDMemory(NamedTuple):
    """Memory of a sampled PID between calls."""

    integral: Scalar
    filtered: Scalar
    time: Scalar


class PID(AbstractController):
    """PID with filtered derivative of the measurement, limits and anti-windup.

    command = limit(feed_forward r + proportional e + I - derivative y_f'),
    I' = integral_gain e + (limited - wanted) / tracking_time,
    y_f' = (y - y_f) / filter_time, e = r - y.

    Wired in a network it runs in continuous time; called as a function it takes a step
    of the same equations, of several signals at once if measurement and reference are
    vectors. In a network it has one signal, and `stack([pid, pid])` two. Gains are in
    command units per measurement unit.

    Attributes:
        proportional, integral_gain, derivative: Gains [-], [1/s], [s] times those units.
        feed_forward: Command per reference.
        low, high: Limits of the command.
        filter_time: Of the derivative [s].
        tracking_time: In which the integral yields to a limit [s].
        start_measurement: What a continuous PID takes for the measurement before t = 0.
        reference: Signal to follow, an `AbstractReference`; without one the block has an
            input `reference`, which a `Source` may drive.
        measurement_unit, command_unit: Compared at wiring.
    """

    proportional: Scalar = eqx.field(converter=real)
    integral_gain: Scalar = eqx.field(converter=real, default=0.0)
    derivative: Scalar = eqx.field(converter=real, default=0.0)
    feed_forward: Scalar = eqx.field(converter=real, default=0.0)
    low: Float[Array, "..."] = eqx.field(converter=real, default=-math.inf)
    high: Float[Array, "..."] = eqx.field(converter=real, default=math.inf)
    filter_time: Scalar = eqx.field(converter=real, default=0.01)
    tracking_time: Scalar = eqx.field(converter=real, default=0.1)
    start_measurement: Scalar = eqx.field(converter=real, default=0.0)
    reference: AbstractReference | None = None
    measurement_unit: str = eqx.field(static=True, default="rad")
    command_unit: str = eqx.field(static=True, default="Pa")

    def __check_init__(self):
        do = "Take about a tenth of the time in which the plant answers."
        _check.positive("PID", "filter_time", self.filter_time, "s", do)
        _check.positive("PID", "tracking_time", self.tracking_time, "s", do)
        if _check.is_concrete(self.high - self.low) and not jnp.all(self.low < self.high):
            raise ValueError(
                f"PID: `low` must be below `high`, got {self.low} and {self.high} "
                f"{self.command_unit}. Swap them, or leave one out."
            )

    @property
    def inputs(self):
        ports = {"measurement": Input(self.measurement_unit)}
        if self.reference is None:
            ports["reference"] = Input(self.measurement_unit)
        return ports

    @property
    def outputs(self):
        return {"command": Output(self.command_unit, (), frozenset(self.inputs))}

    def initial_state(self):
        zero = jnp.zeros_like(self.start_measurement)
        return {"integral": zero, "filtered": self.start_measurement}

    def output(self, name, t, state, inputs):
        rate = (inputs["measurement"] - state["filtered"]) / self.filter_time
        target = self._target(t, inputs)
        return self._command(target, inputs["measurement"], rate, state["integral"])[0]

    def vector_field(self, t, state, inputs):
        measured, target = inputs["measurement"], self._target(t, inputs)
        rate = (measured - state["filtered"]) / self.filter_time
        limited, wanted = self._command(target, measured, rate, state["integral"])
        growth = self._growth(target - measured, limited, wanted)
        return {"integral": growth, "filtered": rate}

    def start(self, t, measurement) -> PIDMemory:
        zero = jnp.zeros_like(self.start_measurement)
        return PIDMemory(jnp.zeros_like(zero + measurement), zero + measurement, zero + t)

    def __call__(self, t, measurement, state: PIDMemory):
        elapsed = t - state.time
        lag = measurement - state.filtered
        decay = jnp.exp(-elapsed / self.filter_time)
        rate = lag * decay / self.filter_time
        target = self._target(t, {})
        limited, wanted = self._command(target, measurement, rate, state.integral)
        growth = self._growth(target - measurement, limited, wanted)
        memory = PIDMemory(
            state.integral + elapsed * growth, measurement - lag * decay, state.time + elapsed
        )
        return limited, memory

    def _target(self, t, inputs):
        if self.reference is not None:
            return self.reference(t)
        if "reference" not in inputs:
            raise ValueError(
                "PID: called as a sampled controller without a `reference`. Give it one: "
                "PID(..., reference=Step(0.3))."
            )
        return inputs["reference"]

    def _command(self, target, measured, rate, integral) -> tuple[Array, Array]:
        """Command within and without the limits."""
        wanted = self.feed_forward * target + self.proportional * (target - measured)
        wanted = wanted + integral - self.derivative * rate
        return jnp.clip(wanted, self.low, self.high), wanted

    def _growth(self, error, limited, wanted):
        return self.integral_gain * error + (limited - wanted) / self.tracking_time
