"""The displacement space of a mesh (blocks of cells, sparse pattern), and the formulations
that keep cells from volumetric locking.

The space depends on the topology only and is built on the host once per mesh. In a mixed
formulation the volume ratio J is projected onto constants or linear functions of each cell
(weighted by reference volume), theta = pi J, and the energy is W(F) + U(theta). Its derivative
is the pressure p = pi U'(theta), so the unknowns stay displacements, and the tangent stays
symmetric, positive definite at stable states.

Reference: Simo, Taylor, Pister, "Variational and projection methods for the volume
constraint in finite deformation elasto-plasticity", CMAME 51, 1985.
"""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax._jax.trace_state import is_traced
from sorojax._types import from_host, platform
from sorojax.fem.kinematics import AbstractKinematics
from sorojax.material.kinematics import Entry
from sorojax.math.linalg import sparse
from sorojax.mesh.elements.base import AbstractElement
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.mesh import Mesh, valences


class Space(eqx.Module):
    """Displacements on the nodes of a mesh.

    `system` is the pattern of the tangent, `cells` are the nodes of the cells of type
    `element`, `ids` their numbers; of the mesh there are `num_nodes` and `num_cells`.

    Arrays over cells are kept in blocks with the cell axis last, padded by repeats of
    cell 0 that `real` switches off. Unknown `dim * node + component` is a displacement.
    `slots` follows the order of `block_entries`; `kinds` numbers the shape tables of the
    cells where they differ.
    """

    system: sparse.SparseSymmetric
    cells: Int[Array, "blocks cell_nodes lanes"]
    ids: Int[Array, "blocks lanes"]
    real: Bool[Array, "blocks lanes"]
    slots: Int[Array, "blocks entries lanes"]
    kinds: Int[Array, "blocks lanes"] | None
    element: AbstractElement
    num_nodes: int = eqx.field(static=True)
    num_cells: int = eqx.field(static=True)

    @property
    def dim(self) -> int:
        return self.element.dim

    @property
    def num_dofs(self) -> int:
        return self.num_nodes * self.element.dim


_WIDEST = 1 << 15  # cells of a block that an accelerator holds without trouble


def lanes_per_block(element: AbstractElement, num_cells: int) -> int:
    """Cells per block: on a CPU so many that the working set of a block stays in the cache
    (measured), on an accelerator as many as there are threads to take them."""
    if platform() != "cpu":
        return -(-num_cells // -(-num_cells // _WIDEST))
    if element.order == 1 and (element.dim == 2 or element.num_corners == 4):
        return 256
    return 128 if element.dim == 2 else 32


def space(
    mesh: Mesh,
    loads: tuple[Any, ...] = (),
    solver: str | sparse.ConjugateGradient = "direct",
) -> Space:
    """The displacement space of `mesh`, with room for the stiffness of `loads` that couple
    nodes of different cells (springs, tendons, rigid parts).

    Args:
        mesh: The mesh.
        loads: Those of the problem.
        solver: Of the linear systems: "direct" factors them on the host, the fast way on a
            CPU; "conjugate_gradient", or `ConjugateGradient(...)` with settings of its own,
            iterates in the compiled program, on an accelerator too.

    Returns:
        The space, for problems on meshes of the same cells.

    Raises:
        ValueError: If the cells are traced: topology is fixed before any trace; or if the
            solver is not known.
    """
    if is_traced(mesh.cells):
        raise ValueError(
            "fem.space: `mesh.cells` is traced, need concrete cells. Build the space "
            "outside jit and grad, and replace only `mesh.points` inside."
        )
    cells, width = np.asarray(mesh.cells), lanes_per_block(mesh.element, mesh.num_cells)
    more = tuple(group for load in loads if (group := load.couples()) is not None)
    system = sparse.from_cells(
        mesh.num_nodes, cells, mesh.element.dim, more, _settings(solver), mesh.points
    )
    num_blocks = -(-len(cells) // width)
    ids = np.zeros(num_blocks * width, np.int32)
    ids[: len(cells)] = np.arange(len(cells))
    real = np.arange(len(ids)) < len(cells)
    slots = np.asarray(system.slots)[:, block_entries(mesh.element)]
    slots = np.where(real[:, None], slots[ids], system.num_values)
    polygons = isinstance(mesh.element, PolyN)
    return Space(
        system=system,
        cells=_blocked(cells[ids].astype(np.int32), width),
        ids=from_host(ids.reshape(num_blocks, width)),
        real=from_host(real.reshape(num_blocks, width)),
        slots=_blocked(slots.astype(np.int32), width),
        kinds=jnp.asarray(valences(mesh)[ids].reshape(num_blocks, width)) if polygons else None,
        element=mesh.element,
        num_nodes=mesh.num_nodes,
        num_cells=len(cells),
    )


def _settings(solver: str | sparse.ConjugateGradient) -> sparse.ConjugateGradient | None:
    if isinstance(solver, sparse.ConjugateGradient):
        return solver
    if solver not in ("direct", "conjugate_gradient"):
        raise ValueError(
            f"fem.space: got solver {solver!r}, need 'direct', 'conjugate_gradient' or a "
            "ConjugateGradient. Leave it out for the direct one."
        )
    return sparse.ConjugateGradient() if solver == "conjugate_gradient" else None


def block_entries(element: AbstractElement) -> Int[np.ndarray, " entries"]:
    """Where the entries of component blocks lie in the upper triangle of a cell's matrix.

    Blocks come for pairs of components i <= k; a block of i < k holds all pairs of nodes row
    by row, one of i = k those with first <= second.
    """
    n, dim = element.num_nodes, element.dim
    size = n * dim
    number = np.zeros((size, size), int)
    number[np.triu_indices(size)] = np.arange(size * (size + 1) // 2)
    number = np.maximum(number, number.T)
    rows = []
    for i in range(dim):
        for k in range(i, dim):
            block = number[i::dim, k::dim]
            rows.append(block[np.triu_indices(n)] if i == k else block.ravel())
    return np.concatenate(rows)


def _blocked(rows: np.ndarray, width: int) -> jax.Array:
    """(cells, n) as (blocks, n, lanes)."""
    blocks = rows.reshape(-1, width, rows.shape[1])
    return from_host(np.ascontiguousarray(np.moveaxis(blocks, 1, -1)))


def per_block(space: Space, tree: Any) -> tuple[Any, Any]:
    """Split a pytree into leaves per cell, as (blocks, 1, lanes), or per point, (..., quad,
    cells) as (blocks, ..., quad, lanes), and the others."""

    def blocks(leaf):
        if jnp.ndim(leaf) > 1:  # a copy: cells are in their order
            shape = leaf.shape[:-1]
            more = space.ids.size - space.num_cells
            padding = jnp.broadcast_to(leaf[..., :1], (*shape, more))
            whole = jnp.concatenate([leaf, padding], axis=-1)
            return jnp.moveaxis(whole.reshape(*shape, *space.ids.shape), -2, 0)
        return leaf[space.ids][:, None] if jnp.ndim(leaf) else None

    varying = jax.tree.map(blocks, tree)
    constant = jax.tree.map(lambda leaf: None if jnp.ndim(leaf) else leaf, tree)
    return varying, constant


def lanes(
    nodal: Float[Array, "nodes dim"], cells: Int[Array, "cell_nodes lanes"]
) -> Float[Array, "dim cell_nodes lanes"]:
    """Nodal values of the cells of a block."""
    return jnp.moveaxis(nodal[cells], -1, 0)


# Which pressures a cell can carry: the remedy against volumetric locking


Modes = Float[Array, "modes quad lanes"]


class AbstractFormulation(eqx.Module):
    """How the pressure varies within a cell."""

    @abc.abstractmethod
    def pressures(self, position: Float[Array, "dim quad lanes"]) -> list[Entry]:
        """Functions of position that pressures are made of; none for pointwise."""


class Displacement(AbstractFormulation):
    """Pressure from J at every quadrature point: for compressible materials."""

    def pressures(self, position):
        return []


class ConstantPressure(AbstractFormulation):
    """One pressure per cell, from its mean volume ratio (mean dilatation)."""

    def pressures(self, position):
        return [jnp.ones_like(position[0])]


class LinearPressure(AbstractFormulation):
    """Pressures linear in each cell, discontinuous between cells."""

    def pressures(self, position):
        return [jnp.ones_like(position[0]), *position]


def default_formulation(
    element: AbstractElement, kinematics: AbstractKinematics
) -> AbstractFormulation:
    """The formulation of `element` that does not lock, or else `Displacement()`."""
    if not kinematics.has_volume or element.pressure_order is None:
        return Displacement()
    return LinearPressure() if element.pressure_order else ConstantPressure()


def modes(
    formulation: AbstractFormulation,
    position: Float[Array, "dim quad lanes"],
    volumes: Float[Array, "quad lanes"],
) -> Modes | None:
    """Pressure functions of each cell, orthonormal over its reference volume."""
    found: list[Entry] = []
    for function in formulation.pressures(position):
        for other in found:
            function = function - other * _sum(volumes * other * function)
        found.append(function / jnp.sqrt(_sum(volumes * function**2)))
    return jnp.stack(found) if found else None


def _sum(field: Entry) -> Entry:
    return jnp.sum(field, axis=0, keepdims=True)


def coefficients(modes: Modes, volumes: Float[Array, "quad lanes"], field: Entry) -> Entry:
    """Integrals of `field` times each mode, (modes, lanes)."""
    return jnp.sum(modes * (volumes * field)[None], axis=1)


def project(modes: Modes | None, volumes: Float[Array, "quad lanes"], field: Entry) -> Entry:
    """Best approximation of `field` by the pressure functions; itself when pointwise."""
    if modes is None:
        return field
    return jnp.sum(modes * coefficients(modes, volumes, field)[:, None], axis=0)
