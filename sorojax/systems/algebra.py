"""Blocks without physics: sums, gains, functions, lags and sensors."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.systems.block import AbstractBlock, Input, Output


class Function(AbstractBlock):
    """value = function(a, b, ...) of its inputs, in the order of their names.

    Attributes:
        function: Any function of arrays; one that is a module may be differentiated.
        ports: Names of the inputs.
        shape, unit: Of the output.
        input_shape, input_unit: Of every input.
    """

    function: Callable[..., Any]
    ports: tuple[str, ...] = eqx.field(static=True, converter=tuple, default=("a",))
    shape: tuple[int, ...] = eqx.field(static=True, converter=tuple, default=())
    unit: str | None = eqx.field(static=True, default=None)
    input_shape: tuple[int, ...] = eqx.field(static=True, converter=tuple, default=())
    input_unit: str | None = eqx.field(static=True, default=None)

    @property
    def inputs(self):
        return {name: Input(self.input_unit, self.input_shape) for name in self.ports}

    @property
    def outputs(self):
        return {"value": Output(self.unit, self.shape, frozenset(self.ports))}

    def initial_state(self):
        return {}

    def output(self, name, t, state, inputs):
        return self.function(*(inputs[port] for port in self.ports))

    def vector_field(self, t, state, inputs):
        return {}


class Weighted(eqx.Module):
    """Sum of its arguments with weights."""

    weights: Float[Array, " terms"] = eqx.field(converter=real)

    def __call__(self, *terms):
        return sum(self.weights[k] * term for k, term in enumerate(terms))


def sum_of(weights: Numbers, *, shape=(), unit: str | None = None) -> Function:
    """A block that adds inputs `a`, `b`, ... with one weight each; -1 subtracts."""
    law = Weighted(weights)
    ports = tuple("abcdefghijklmnop"[: law.weights.shape[0]])
    return Function(law, ports, shape, unit, shape, unit)


def gain(factor: Numbers, *, shape=(), unit: str | None = None, input_unit: str | None = None):
    """A block that multiplies its input `a`; the units say what the factor turns into what."""
    return Function(Weighted([factor]), ("a",), shape, unit, shape, input_unit)


class Lag(AbstractBlock):
    """First-order lag: time y' = input - y; its output breaks algebraic loops.

    Attributes:
        time: Time constant [s].
        start: Output at the start, which gives the shape.
        unit: Of input and output.
    """

    time: Float[Array, ""] = eqx.field(converter=real)
    start: Float[Array, "..."] = eqx.field(converter=real, default=0.0)
    unit: str | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        _check.positive("Lag", "time", self.time, "s", "Wire straight through instead.")

    @property
    def inputs(self):
        return {"a": Input(self.unit, self.start.shape)}

    @property
    def outputs(self):
        return {"value": Output(self.unit, self.start.shape)}

    def initial_state(self):
        return self.start

    def output(self, name, t, state, inputs):
        return state

    def vector_field(self, t, state, inputs):
        return (inputs["a"] - state) / self.time


class Sensor(AbstractBlock):
    """A measurement with offset and white noise, sampled and held.

    The noise of a sample depends on `key` and on its number alone, so a run can be repeated,
    and gone on with, to the bit. Read at the rate of the sensor or slower.

    Attributes:
        noise: Standard deviation, in the unit of the signal.
        period: Time between samples of the noise [s].
        key: Typed random key.
        offset: Added to every value.
        shape, unit: Of the signal.
    """

    noise: Float[Array, "..."] = eqx.field(converter=real)
    period: Float[Array, ""] = eqx.field(converter=real)
    key: Key[Array, ""] = eqx.field(kw_only=True)
    offset: Float[Array, "..."] = eqx.field(converter=real, default=0.0)
    shape: tuple[int, ...] = eqx.field(static=True, converter=tuple, default=())
    unit: str | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        _check.positive("Sensor", "period", self.period, "s", "1 ms is period=1e-3.")

    @property
    def inputs(self):
        return {"a": Input(self.unit, self.shape)}

    @property
    def outputs(self):
        return {"value": Output(self.unit, self.shape, frozenset({"a"}))}

    def initial_state(self):
        return {}

    def output(self, name, t: Any, state, inputs):
        # half a millionth, so that a sample taken on time counts as its own
        number = jnp.floor(t / self.period + 5e-7).astype(jnp.uint32)
        draw = jax.random.normal(jax.random.fold_in(self.key, number), self.shape, t.dtype)
        return inputs["a"] + self.offset + self.noise * draw

    def vector_field(self, t, state, inputs):
        return {}
