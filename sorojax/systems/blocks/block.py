"""Blocks: state-space systems with named, typed ports."""

import abc
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
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
        def one(block, state, inputs):
            return block.output(name, t, state, inputs)

        return jax.vmap(one)(self.block, state, dict(inputs))

    def vector_field(self, t, state, inputs):
        def one(block, state, inputs):
            return block.vector_field(t, state, inputs)

        return jax.vmap(one)(self.block, state, dict(inputs))

    def _one(self) -> AbstractBlock:
        """One of the blocks, for its ports: shapes in place of arrays."""
        return jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(jnp.shape(x)[1:], jnp.result_type(x)), self.block
        )


def stack(blocks: Sequence[AbstractBlock]) -> Stack:
    """Stack blocks of one class, one structure and one shape.

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
