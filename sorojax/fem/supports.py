"""Supports: which displacements are known, and their values."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._types import integers, real


class AbstractSupport(eqx.Module):
    """Known displacement components of a set of nodes."""

    nodes: eqx.AbstractVar[Int[Array, " nodes"]]
    displacement: eqx.AbstractVar[Float[Array, "..."]]
    components: eqx.AbstractVar[tuple[int, ...]]


class Fixed(AbstractSupport):
    """Nodes that do not move; `components=(0,)` lets them slide along y."""

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    components: tuple[int, ...] = eqx.field(static=True, default=(0, 1))

    @property
    def displacement(self) -> Float[Array, ""]:
        return jnp.zeros((), jnp.result_type(float))


class Prescribed(AbstractSupport):
    """Nodes moved by `displacement` [m], one vector for all or one per node."""

    nodes: Int[Array, " nodes"] = eqx.field(converter=integers)
    displacement: Float[Array, "..."] = eqx.field(converter=real)
    components: tuple[int, ...] = eqx.field(static=True, default=(0, 1))


def known_dofs(supports: tuple[AbstractSupport, ...], num_nodes: int, dim: int) -> np.ndarray:
    """Mask of the unknowns that supports decide (host array)."""
    mask = np.zeros((num_nodes, dim), bool)
    for support in supports:
        for component in support.components:
            mask[np.asarray(support.nodes), component] = True
    return mask.ravel()


def known_values(
    supports: tuple[AbstractSupport, ...], num_nodes: int, dim: int
) -> Float[Array, " dofs"]:
    """Displacements that supports decide [m], zero elsewhere; differentiable."""
    values = jnp.zeros((num_nodes, dim), jnp.result_type(float))
    for support in supports:
        for column, component in enumerate(support.components):
            moved = support.displacement
            entry = moved if moved.ndim == 0 else moved[..., column]
            values = values.at[support.nodes, component].set(entry)
    return values.ravel()
