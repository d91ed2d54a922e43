"""Stiffness of single cells at rest, for bodies whose cells differ by a factor."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._jax.trace_state import is_traced
from sorojax.fem.assemble import cell_matrices
from sorojax.fem.linear import linearise, prepare
from sorojax.fem.space import Space
from sorojax.fem.traced import prepare_traced


def stiffness_at_rest(
    problem: Any,
) -> tuple[Float[Array, "blocks entries lanes"], Float[Array, " nnz"]]:
    """Matrices of all cells in the blocks of the space [N/m], and what the loads add to the
    tangent, in the order of its values."""
    prepared = prepare_traced(problem) if is_traced(problem) else prepare(problem)
    rest = jnp.zeros_like(problem.mesh.points)
    cells = cell_matrices(
        problem.space, prepared.geometry, problem.material, problem.kinematics, rest
    )
    one = jnp.ones(problem.space.num_cells)
    whole = linearise(problem, prepared, rest, rest).values
    return cells, whole - assembled(problem.space, cells, one)


@eqx.filter_jit
def assembled(
    space: Space,
    cells: Float[Array, "blocks entries lanes"],
    factor: Float[Array, " cells"],
) -> Float[Array, " nnz"]:
    """Tangent of the body in which each cell counts `factor` times [N/m]."""
    scaled = cells * factor[space.ids][:, None]
    values = jnp.zeros(space.system.num_values + 1, cells.dtype).at[space.slots].add(scaled)
    return jax.lax.slice_in_dim(values, 0, space.system.num_values)
