"""The void that a source can reach: the chamber of a design while it changes.

Reference: Caasenbrood, Pogromsky, Nijmeijer, "A computational design framework for
pressure-driven soft robots through nonlinear topology optimization", RoboSoft, 2020.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.mesh.mesh import Mesh, facet_table


class Flood(eqx.Module):
    """Where a pressure enters and how it spreads, by `flood`.

    Called with densities it returns the share of the pressure in each cell: 1 in empty
    cells that are connected to a source through cells less dense than `threshold`, falling
    smoothly to 0 at that density, and 0 elsewhere. Differentiable in the densities as long
    as the same cells are reached.
    """

    first: Int[Array, " pairs"]
    second: Int[Array, " pairs"]
    source: Bool[Array, " cells"]
    threshold: Float[Array, ""] = eqx.field(converter=real)

    def __call__(self, density: Float[Array, " cells"]) -> Float[Array, " cells"]:
        filled = jnp.clip(density / self.threshold, 0.0, 1.0)
        empty = 1 - filled**2 * (3 - 2 * filled)
        wet = jnp.where(self.source, jnp.ones_like(empty), empty)
        return jnp.where(flooded(self, density), wet, jnp.zeros_like(wet))


def flood(mesh: Mesh, sources: Numbers, *, threshold: float = 0.1) -> Flood:
    """What is needed to flood the void of designs on `mesh`.

    Args:
        mesh: The cells.
        sources: Cells where the pressure enters; they count as empty.
        threshold: Density up to which a cell lets the pressure through.

    Raises:
        ValueError: If there are no sources, or they are no cells of the mesh.
    """
    _check.positive("flood", "threshold", threshold, "", "0.1 is usual.")
    sources = np.atleast_1d(np.asarray(sources, int))
    if not sources.size or sources.min() < 0 or sources.max() >= mesh.num_cells:
        raise ValueError(
            f"flood: got sources {sources}, need cells from 0 to {mesh.num_cells - 1}. Find "
            "them with mesh.cells_where."
        )
    number = facet_table(mesh)[3]
    order = np.argsort(number, kind="stable")
    same = number[order][1:] == number[order][:-1]
    first, second = order[:-1][same] % mesh.num_cells, order[1:][same] % mesh.num_cells
    return Flood(
        jnp.asarray(np.concatenate([first, second]), jnp.int32),
        jnp.asarray(np.concatenate([second, first]), jnp.int32),
        jnp.asarray(np.isin(np.arange(mesh.num_cells), sources)),
        threshold,
    )


def flooded(flood: Flood, density: Float[Array, " cells"]) -> Bool[Array, " cells"]:
    """Cells that a source of `flood` reaches through void."""
    open_cells = flood.source | (density <= flood.threshold)

    def spread(state):
        reached, _ = state
        more = reached.at[flood.first].max(reached[flood.second]) & open_cells
        return more, jnp.any(more != reached)

    start = (flood.source, jnp.asarray(True))
    return jax.lax.while_loop(lambda state: state[1], spread, start)[0]
