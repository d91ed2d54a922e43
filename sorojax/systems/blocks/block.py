"""Blocks: state-space systems with named, typed ports; those without physics: sums, gains,
functions, lags and sensors."""

import abc
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import Numbers, real
from sorojax.math.status import Status


class Input(NamedTuple):
    """An input port.

    Attributes:
        unit: SI unit, compared at wiring; None accepts any.
        shape: Shape of the signal.
        default: Value when nothing is wired to it; None means that it must be wired.
    """

    unit: str | None
    shape: tuple[int, ...] = ()
    default: float | None = None


class Output(NamedTuple):
    """An output port.

    Attributes:
        unit: SI unit, compared at wiring; None fits any.
        shape: Shape of the signal.
        needs: Inputs that the output depends on at the same instant. Declared per
            output, not per block: a state output breaks a loop.
    """

    unit: str | None
    shape: tuple[int, ...] = ()
    needs: frozenset[str] = frozenset()


Signals = Mapping[str, Array]


@displayed
class AbstractBlock(eqx.Module):
    """x' = f(t, x, u), y = g(t, x, u), with ports that may depend on what is listed."""

    @property
    @abc.abstractmethod
    def inputs(self) -> dict[str, Input]:
        """Input ports by name."""

    @property
    @abc.abstractmethod
    def outputs(self) -> dict[str, Output]:
        """Output ports by name."""

    @abc.abstractmethod
    def initial_state(self) -> PyTree:
        """State at the start; any pytree of arrays, {} without memory."""

    @abc.abstractmethod
    def output(self, name: str, t: Float[Array, ""], state: PyTree, inputs: Signals) -> Any:
        """Value of one output; `inputs` holds at least what the output needs."""

    @abc.abstractmethod
    def vector_field(self, t: Float[Array, ""], state: PyTree, inputs: Signals) -> PyTree:
        """Rate of the state, of its structure; `inputs` holds every input."""

    def path_status(self, path: PyTree) -> Status | None:
        """The defect of a run through the states `path`, with a leading time axis, e.g.
        `Status.outside_model`; None where there is nothing to look at."""
        return None


def first_defect(found: Iterable[Status | None]) -> Status | None:
    """The first status that is not successful; None where none was looked at."""
    seen = [one for one in found if one is not None]
    if not seen:
        return None
    status, *others = seen
    for one in others:
        status = Status.where(status == Status.successful, one, status)
    return status


class AbstractStateless(AbstractBlock):
    """A block without memory."""

    def initial_state(self):
        return {}

    def vector_field(self, t, state, inputs):
        return {}


# Identical blocks as one: stacked and evaluated side by side, not written out


class Stack(AbstractBlock):
    """Blocks of one kind whose numbers may differ; every port has a leading axis of blocks.

    Compiles once for all, and runs their arithmetic together. A network may be stacked as
    well: five fingers with their air and valves are one block.

    Attributes:
        block: The blocks in one, its arrays with a leading axis; `stack` makes it.
        count: How many there are.
    """

    block: AbstractBlock
    count: int = eqx.field(static=True)

    @property
    def inputs(self):
        return {
            name: Input(port.unit, (self.count, *port.shape), port.default)
            for name, port in self._one().inputs.items()
        }

    @property
    def outputs(self):
        return {
            name: Output(port.unit, (self.count, *port.shape), port.needs)
            for name, port in self._one().outputs.items()
        }

    def initial_state(self):
        return jax.vmap(lambda block: block.initial_state())(self.block)

    def output(self, name, t, state, inputs):
        each = jax.vmap(lambda block, x, u: block.output(name, t, x, u))
        return each(self.block, state, dict(inputs))

    def vector_field(self, t, state, inputs):
        each = jax.vmap(lambda block, x, u: block.vector_field(t, x, u))
        return each(self.block, state, dict(inputs))

    def _one(self) -> AbstractBlock:
        """One of the blocks, for its ports: shapes in place of arrays."""
        return jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(jnp.shape(x)[1:], jnp.result_type(x)), self.block
        )


def stack(blocks: Sequence[AbstractBlock]) -> Stack:
    """Stack blocks of one class, one structure and one shape.

    Args:
        blocks: Two or more.

    Returns:
        One block with an axis in front.

    Raises:
        ValueError: If they differ in more than their numbers.
    """
    kinds = {_kind(block) for block in blocks}
    if len(kinds) != 1:
        raise ValueError(
            f"stack: got {len(blocks)} blocks of {len(kinds)} structures, need blocks that "
            "differ in numbers only. Stack each kind by itself."
        )
    return Stack(jax.tree.map(lambda *leaves: jnp.stack(leaves), *blocks), len(blocks))


def _kind(block: AbstractBlock):
    leaves, structure = jax.tree.flatten(block)
    return structure, tuple((jnp.shape(x), jnp.result_type(x)) for x in leaves)


class Function(AbstractStateless):
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

    def output(self, name, t, state, inputs):
        return self.function(*(inputs[port] for port in self.ports))


class Weighted(eqx.Module):
    """Sum of its arguments with weights."""

    weights: Float[Array, " terms"] = eqx.field(converter=real)

    def __call__(self, *terms):
        return sum(self.weights[k] * term for k, term in enumerate(terms))


def sum_of(weights: Numbers, *, shape=(), unit: str | None = None) -> Function:
    """A block that adds inputs `a`, `b`, ... with one weight each; -1 subtracts.

    Args:
        weights: One per input.
        shape: Of inputs and output.
        unit: Of all.

    Returns:
        The block.
    """
    law = Weighted(weights)
    ports = tuple("abcdefghijklmnop"[: law.weights.shape[0]])
    return Function(law, ports, shape, unit, shape, unit)


def gain(factor: Numbers, *, shape=(), unit: str | None = None, input_unit: str | None = None):
    """A block that multiplies its input `a`; the units say what the factor turns into what.

    Args:
        factor: Output over input.
        shape: Of input and output.
        unit: Of the output.
        input_unit: Of the input.

    Returns:
        The block.
    """
    return Function(Weighted(real(factor)[None]), ("a",), shape, unit, shape, input_unit)


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


class Sensor(AbstractStateless):
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

    def output(self, name, t: Any, state, inputs):
        # half a millionth, so that a sample taken on time counts as its own
        number = jnp.floor(t / self.period + 5e-7).astype(jnp.uint32)
        draw = jax.random.normal(jax.random.fold_in(self.key, number), self.shape, t.dtype)
        return inputs["a"] + self.offset + self.noise * draw


# Signals of time, and the block that puts one on a wire


class AbstractReference(eqx.Module):
    """A signal of time [s]. For one of your own write a subclass with `__call__(self, t)`."""

    @abc.abstractmethod
    def __call__(self, t: Float[Array, ""]) -> Float[Array, "..."]:
        """Value at `t`."""


class Constant(AbstractReference):
    """The same `value` at all times."""

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
    """`offset` + `amplitude` sin(2 pi `frequency` t + `phase`); the frequency is in Hz, the
    phase in rad."""

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
        return _between(self.times, self.values, t, smooth=True)


class Source(AbstractStateless):
    """Puts a `reference`, a signal of time, on a wire, as output `value` in `unit`."""

    reference: AbstractReference
    unit: str | None = eqx.field(static=True, default=None)

    @property
    def inputs(self):
        return {}

    @property
    def outputs(self):
        shape = eqx.filter_eval_shape(self.reference, jnp.zeros(())).shape
        return {"value": Output(self.unit, shape)}

    def output(self, name, t, state, inputs):
        return self.reference(t)


# Paths through waypoints, of a point or of several signals at once


class Waypoints(AbstractReference):
    """Straight from waypoint to waypoint; two at the same time make a jump.

    Attributes:
        times: Of the waypoints [s], none before the one in front of it.
        values: One row each, held before the first and after the last.
        smooth: Stop at every waypoint, without a jump of rate or acceleration.
    """

    times: Float[Array, " points"] = eqx.field(converter=real)
    values: Float[Array, "points ..."] = eqx.field(converter=real)
    smooth: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        do = "Give one row of values per time."
        _check.shape("Waypoints", "times", self.times, self.values.shape[:1], do)
        if _check.is_concrete(self.times) and bool(jnp.any(jnp.diff(self.times) < 0)):
            raise ValueError(
                f"Waypoints: `times` are {self.times} s, need each at or after the one before. "
                "Sort the waypoints."
            )

    def __call__(self, t):
        return _between(self.times, self.values, t, self.smooth)


def _between(times: Array, values: Array, t: Float[Array, ""], smooth: bool) -> Array:
    """Values at `t` on the way from waypoint to waypoint."""
    passed = jnp.searchsorted(times, t, side="right", method="compare_all")
    after = jnp.clip(passed, 1, times.shape[0] - 1)
    start, length = times[after - 1], times[after] - times[after - 1]
    share = (t - start) / jnp.where(length > 0, length, jnp.ones_like(length))
    share = jnp.where(length > 0, jnp.clip(share, 0, 1), jnp.ones_like(share))
    share = share**3 * (10 + share * (6 * share - 15)) if smooth else share
    return values[after - 1] + share * (values[after] - values[after - 1])
