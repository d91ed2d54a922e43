"""Identical blocks as one: stacked and evaluated side by side, not written out."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from sorojax.systems.block import AbstractBlock, Input, Output


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
