"""What depends on the topology of a mesh only: blocks of cells and the sparse pattern.

Built on the host, outside any trace, once per mesh.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax._types import is_traced
from sorojax.math import sparse
from sorojax.mesh.elements import AbstractElement
from sorojax.mesh.mesh import Mesh

_BLOCK = 64  # cells per block: the working set of a block stays in the cache


class Space(eqx.Module):
    """Displacements on the nodes of a mesh.

    Arrays over cells are kept in blocks with the cell axis last, padded by repeats of
    cell 0 that `real` switches off. Unknown `dim * node + component` is a displacement.
    """

    system: sparse.SparseSymmetric
    cells: Int[Array, "blocks cell_nodes lanes"]
    ids: Int[Array, "blocks lanes"]
    real: Bool[Array, "blocks lanes"]
    slots: Int[Array, "blocks entries lanes"]
    element: AbstractElement
    num_nodes: int = eqx.field(static=True)

    @property
    def dim(self) -> int:
        return self.element.dim

    @property
    def num_dofs(self) -> int:
        return self.num_nodes * self.element.dim


def space(mesh: Mesh) -> Space:
    """The displacement space of `mesh`.

    Raises:
        ValueError: If the cells are traced: topology is fixed before any trace.
    """
    if is_traced(mesh.cells):
        raise ValueError(
            "fem.space: `mesh.cells` is traced, need concrete cells. Build the space "
            "outside jit and grad, and replace only `mesh.points` inside."
        )
    cells = np.asarray(mesh.cells)
    system = sparse.from_cells(mesh.num_nodes, cells, mesh.element.dim)
    num_blocks = -(-len(cells) // _BLOCK)
    ids = np.zeros(num_blocks * _BLOCK, np.int32)
    ids[: len(cells)] = np.arange(len(cells))
    real = np.arange(len(ids)) < len(cells)
    slots = np.where(real[:, None], np.asarray(system.slots)[ids], system.num_values)
    return Space(
        system=system,
        cells=_blocked(cells[ids].astype(np.int32)),
        ids=jnp.asarray(ids.reshape(num_blocks, _BLOCK)),
        real=jnp.asarray(real.reshape(num_blocks, _BLOCK)),
        slots=_blocked(slots.astype(np.int32)),
        element=mesh.element,
        num_nodes=mesh.num_nodes,
    )


def _blocked(rows: np.ndarray) -> jax.Array:
    """(cells, n) as (blocks, n, lanes)."""
    blocks = rows.reshape(-1, _BLOCK, rows.shape[1])
    return jnp.asarray(np.ascontiguousarray(np.moveaxis(blocks, 1, -1)))


def per_block(space: Space, tree: Any) -> tuple[Any, Any]:
    """Split a pytree into leaves per cell, as (blocks, 1, lanes), and the others."""
    varying = jax.tree.map(
        lambda leaf: leaf[space.ids][:, None] if jnp.ndim(leaf) == 1 else None, tree
    )
    constant = jax.tree.map(lambda leaf: None if jnp.ndim(leaf) == 1 else leaf, tree)
    return varying, constant


def lanes(
    nodal: Float[Array, "nodes dim"], cells: Int[Array, "cell_nodes lanes"]
) -> Float[Array, "dim cell_nodes lanes"]:
    """Nodal values of the cells of a block."""
    return jnp.moveaxis(nodal[cells], -1, 0)
