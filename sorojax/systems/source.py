"""Signals of time, and the block that puts one on a wire."""

import abc
import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.systems.block import AbstractBlock, Output


class AbstractReference(eqx.Module):
    """A signal of time [s]."""

    @abc.abstractmethod
    def __call__(self, t: Float[Array, ""]) -> Float[Array, "..."]:
        """Value at `t`."""


class Constant(AbstractReference):
    """The same value at all times."""

    value: Float[Array, "..."] = eqx.field(converter=real)

    def __call__(self, t):
        return self.value


class Step(AbstractReference):
    """From `before` to `after` at `time` [s]."""

    after: Float[Array, "..."] = eqx.field(converter=real)
    time: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    before: Float[Array, "..."] = eqx.field(converter=real, default=0.0)

    def __call__(self, t):
        return jnp.where(t < self.time, self.before, self.after)


class Sine(AbstractReference):
    """offset + amplitude sin(2 pi frequency t + phase); frequency in Hz, phase in rad."""

    amplitude: Float[Array, "..."] = eqx.field(converter=real)
    frequency: Float[Array, ""] = eqx.field(converter=real)
    offset: Float[Array, "..."] = eqx.field(converter=real, default=0.0)
    phase: Float[Array, ""] = eqx.field(converter=real, default=0.0)

    def __call__(self, t):
        angle = 2 * math.pi * self.frequency * t + self.phase
        return self.offset + self.amplitude * jnp.sin(angle)


class SmoothRamp(AbstractReference):
    """Through waypoints with zero rate and zero acceleration at each.

    Attributes:
        times: Rising times of the waypoints [s].
        values: One value per waypoint, held before the first and after the last.
    """

    times: Float[Array, " points"] = eqx.field(converter=real)
    values: Float[Array, " points"] = eqx.field(converter=real)

    def __check_init__(self):
        do = "Give one value per waypoint, and two waypoints or more."
        _check.shape("SmoothRamp", "values", self.values, self.times.shape, do)
        if self.times.shape[0] < 2:
            raise ValueError(f"SmoothRamp: got {self.times.shape[0]} waypoint. {do}")
        rises = jnp.diff(self.times)
        _check.positive("SmoothRamp", "diff(times)", rises, "s", "Sort the waypoints.")

    def __call__(self, t):
        last = self.times.shape[0] - 1
        right = jnp.clip(jnp.searchsorted(self.times, t), 1, last)
        start, end = self.times[right - 1], self.times[right]
        x = jnp.clip((t - start) / (end - start), 0, 1)
        share = x**3 * (10 + x * (6 * x - 15))
        return self.values[right - 1] + share * (self.values[right] - self.values[right - 1])


class Source(AbstractBlock):
    """Puts a reference on a wire, as output `value` in `unit`."""

    reference: AbstractReference
    unit: str | None = eqx.field(static=True, default=None)

    @property
    def inputs(self):
        return {}

    @property
    def outputs(self):
        shape = eqx.filter_eval_shape(self.reference, jnp.zeros(())).shape
        return {"value": Output(self.unit, shape)}

    def initial_state(self):
        return {}

    def output(self, name, t, state, inputs):
        return self.reference(t)

    def vector_field(self, t, state, inputs):
        return {}
