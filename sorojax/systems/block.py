"""Blocks: state-space systems with named, typed ports."""

import abc
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float, PyTree

from sorojax._display import displayed
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
        """What is wrong with a run through the states `path`, with a leading time axis, e.g.
        `Status.outside_model`; None where there is nothing to look at."""
        del path
        return None
