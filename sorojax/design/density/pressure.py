"""Fluid pressure on a design whose walls move: in the void that a source can reach (`flood`),
or by the flow through a porous body (`darcy`).

A cell that fills its volume with a gas of pressure p gains p times the volume that it grows
by. Between cells of one pressure the forces cancel, so the rest acts where the pressure ends:
on the walls of the cavity, along their deformed normals. In the porous model permeability
and drainage of the solid are smooth functions of density d, so that field and walls are
differentiable in a design. With p the share of the pressure of the sources,

    div(K(d) grad p) = D(d) p,   K = 1 - (1 - tight) H(d),   D = (ln r / depth)^2 tight H(d),

and in a solid wall the share falls to r = `remainder` within `depth`.

References:
    Caasenbrood, Pogromsky, Nijmeijer, "A computational design framework for
    pressure-driven soft robots through nonlinear topology optimization", RoboSoft, 2020.
    Kumar, Frouws, Langelaar, "Topology optimization of fluidic pressure-loaded structures
    and compliant mechanisms using the Darcy method", Struct. Multidisc. Optim. 61, 2020.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.design.density.filters import heaviside_projection
from sorojax.fem.assembly.energy import volume_ratio
from sorojax.fem.assembly.geometry import Points, deformation, geometry, quadrature_points
from sorojax.fem.assembly.space import Displacement, Space
from sorojax.fem.kinematics import AbstractKinematics, Axisymmetric
from sorojax.fem.loads.facets import CurvedPart
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.material.kinematics import determinant
from sorojax.math.linalg import sparse
from sorojax.mesh.mesh import Mesh, facet_table


class VoidPressure(AbstractLoad):
    """Pressure `value` [Pa, gauge] times `share`, one number per node of every cell.

    Its potential is -sum p (J - 1) dV over the cells in the reference configuration. Where
    the share is not zero on the edge of the mesh, the pressure pushes outward there too.
    `void_pressure` makes it from one number per cell or per node.
    """

    share: Float[Array, "cells cell_nodes"] = eqx.field(converter=real)
    value: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    name: str = eqx.field(static=True, default="pressure")

    def potential(self, problem, u):
        points = quadrature_points(problem.mesh, problem.kinematics)
        F = deformation(problem.mesh, problem.kinematics, points, u)
        grown = volume_ratio(problem.kinematics, F) - 1
        return jnp.sum(self._weights(points) * grown)

    def _weights(self, points: Points) -> Float[Array, "quad cells"]:
        """Minus pressure times reference volume [J]."""
        if points.kinds is None:
            share = jnp.asarray(points.tables.values[0]) @ self.share.T
        else:
            values = jnp.asarray(points.tables.values)[points.kinds]
            share = jnp.einsum("cqa,ca->qc", values, self.share)
        return -self.value * share * points.volumes

    def tangent_values(self, problem):
        """In the plane the volume is quadratic in u, so the stiffness is constant."""
        if not _is_plane(problem):
            return None
        weights = self._weights(quadrature_points(problem.mesh, problem.kinematics))
        G = cell_gradients(problem.space, problem.kinematics, problem.mesh.points)
        turned = jnp.einsum("qc,cqa,cqb->cab", weights, G[..., 0], G[..., 1])
        turned = turned - jnp.swapaxes(turned, 1, 2)
        zero = jnp.zeros_like(turned)
        rows = [jnp.stack([zero, turned], axis=-1), jnp.stack([-turned, zero], axis=-1)]
        size = 2 * turned.shape[1]
        matrices = jnp.stack(rows, axis=2).reshape(-1, size, size)
        return sparse.assemble(problem.space.system, matrices)

    def curved_part(self, problem):
        if _is_plane(problem):
            return None
        weights = self._weights(quadrature_points(problem.mesh, problem.kinematics))
        G = cell_gradients(problem.space, problem.kinematics, problem.mesh.points)

        def energy(x, data):
            gradients, weights = data
            F = jnp.einsum("ai,qaj->ijq", x, gradients)
            if x.shape[1] == 3:
                return jnp.sum(weights * determinant(F))  # pyright: ignore[reportArgumentType]
            hoop = F[0, 2]
            return jnp.sum(weights * (F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]) * hoop)

        return CurvedPart(problem.mesh.cells, energy, (G, weights.T))

    def check(self, where, mesh, kinematics):
        want = (mesh.num_cells, mesh.cells.shape[1])
        _check.shape(
            "fem.problem",
            f"{where} share",
            self.share,
            want,
            "Make it with design.void_pressure(mesh, share).",
        )


def void_pressure(
    mesh: Mesh,
    share: Float[Array, " cells_or_nodes"],
    value: Float[Array, ""] | float = 0.0,
    *,
    per: str = "cell",
    name: str = "pressure",
) -> VoidPressure:
    """`VoidPressure` of `share` times `value` [Pa] on the cells of `mesh`.

    Args:
        mesh: The cells.
        share: One number per cell, or per node with `per="node"`; may be traced.
        value: The pressure where the share is 1 [Pa, gauge].
        per: "cell" (as `flood` gives them) or "node" (as `darcy` does).
        name: Of the load.

    Returns:
        One of the loads of a problem.

    Raises:
        ValueError: If `share` does not fit the mesh.
    """
    if per not in ("cell", "node"):
        raise ValueError(f"void_pressure: got per={per!r}, need 'cell' or 'node'.")
    share = real(share)
    count = mesh.num_cells if per == "cell" else mesh.num_nodes
    _check.shape("void_pressure", "share", share, (count,), f"Give one number per {per}.")
    share = (of_nodes if per == "node" else of_cells)(share, mesh.cells)
    return VoidPressure(share=share, value=real(value), name=name)


@jax.jit
def of_nodes(share, cells):
    """Numbers of nodes at the nodes of every cell."""
    return share[cells]


@jax.jit
def of_cells(share, cells):
    """Numbers of cells, at all nodes of each."""
    return jnp.broadcast_to(share[:, None], cells.shape)


def cell_gradients(
    space: Space, kinematics: AbstractKinematics, points: Float[Array, "nodes dim"]
) -> Float[Array, "cells quad cell_nodes columns"]:
    """Gradients of the shape functions [1/m] at the quadrature points of all cells; in a
    body of revolution the third column is the shape function over the radius."""
    G = geometry(space, kinematics, Displacement(), points).gradients
    cells = jnp.moveaxis(G, -1, 1)
    return cells.reshape(-1, *cells.shape[2:])[: space.num_cells]


def _is_plane(problem) -> bool:
    plane = problem.mesh.element.dim == 2
    return plane and not isinstance(problem.kinematics, Axisymmetric)


# The void that a source can reach: the chamber of a design while it changes


class Flood(eqx.Module):
    """Where a pressure enters and how it spreads, by `flood`.

    Called with densities it returns the share of the pressure in each cell: 1 in empty cells
    that are connected to a source through cells less dense than `threshold`, falling smoothly
    to 0 at that density, and 0 elsewhere. Differentiable in the densities as long as the same
    cells are reached. `first` and `second` are the numbers of cells that share a facet, both
    ways, and `source` is true for those where the pressure enters.
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
    """Data to flood the void of designs on `mesh`.

    Args:
        mesh: The cells.
        sources: Cells where the pressure enters; they count as empty.
        threshold: Density up to which a cell lets the pressure through.

    Returns:
        A function of the densities of the cells.

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


# A pressure that seeps through a design


class Darcy(eqx.Module):
    """Seepage through the cells of a mesh, by `darcy`.

    Called with densities it returns the share of the pressure at every node, for
    `void_pressure(mesh, share, value, per="node")`; one factorisation, and one
    back-substitution for a gradient.

    Attributes:
        threshold, sharpness: Of the step H from void to solid, in `heaviside_projection`.
        tight: Permeability of the solid over that of the void.
        depth: Of a wall behind which `remainder` of the pressure is left [m].
        system: Pattern of the matrix between the nodes.
        conduction, storage: Integrals of products of shape gradients and of shape functions.
        cells: Nodes of each cell.
        known, given: Nodes whose share is known, and what it is [-].
    """

    system: sparse.SparseSymmetric
    conduction: Float[Array, "cells nodes nodes"]
    storage: Float[Array, "cells nodes nodes"]
    cells: Int[Array, "cells nodes"]
    known: Bool[Array, " nodes"]
    given: Float[Array, " nodes"]
    depth: Float[Array, ""] = eqx.field(converter=real)
    threshold: Float[Array, ""] = eqx.field(converter=real, default=0.3)
    sharpness: Float[Array, ""] = eqx.field(converter=real, default=8.0)
    tight: Float[Array, ""] = eqx.field(converter=real, default=1e-7)
    remainder: Float[Array, ""] = eqx.field(converter=real, default=0.1)

    def __call__(self, density: Float[Array, " cells"]) -> Float[Array, " nodes"]:
        solid = heaviside_projection(density, self.sharpness, self.threshold)
        permeable = 1 - (1 - self.tight) * solid
        drained = (jnp.log(self.remainder) / self.depth) ** 2 * self.tight * solid
        flow = permeable[:, None, None] * self.conduction
        stored = drained[:, None, None] * self.storage
        matrix = sparse.assemble(self.system, flow + stored)
        right = -sparse.product(self.system, matrix, self.given)
        right = jnp.where(self.known, jnp.zeros_like(right), right)
        held = sparse.fix(self.system, matrix, self.known)
        return sparse.solve(self.system, held, right) + self.given


def darcy(
    mesh: Mesh,
    space: Space,
    kinematics: AbstractKinematics,
    *,
    sources: Int[Any, " nodes"],
    drains: Int[Any, " nodes"] = (),
    depth: float,
    **settings: float,
) -> Darcy:
    """The seepage problem of a mesh.

    Args:
        mesh: The cells.
        space: That of the body, `fem.space(mesh)` or `problem.space`.
        kinematics: That of the body.
        sources: Nodes that have the pressure.
        drains: Nodes without pressure: the parts of the edge that lie in the open.
        depth: See `Darcy`; two cells are usual [m].
        **settings: `threshold`, `sharpness`, `tight` and `remainder` of `Darcy`.

    Returns:
        The problem, a function of the densities of the cells.

    Raises:
        ValueError: If there are no sources or a node is a source and a drain.
    """
    _check.positive("darcy", "depth", depth, "m", "Two cells are usual.")
    sources, drains = np.asarray(sources, int).ravel(), np.asarray(drains, int).ravel()
    both = np.intersect1d(sources, drains).size
    if not sources.size or both:
        raise ValueError(
            f"darcy: got {sources.size} sources, {both} of them drains, need at least one "
            "source and none that is a drain. Select the nodes of the inlet."
        )
    given = np.zeros(mesh.num_nodes)
    given[sources] = 1.0
    points = quadrature_points(mesh, kinematics)
    G = cell_gradients(space, kinematics, mesh.points)[..., : mesh.element.dim]
    values = points.tables.values
    N = values[np.asarray(points.kinds)] if points.kinds is not None else values
    N = jnp.broadcast_to(jnp.asarray(N), (mesh.num_cells, *values.shape[1:]))
    V = points.volumes.T
    return Darcy(
        sparse.from_cells(mesh.num_nodes, np.asarray(mesh.cells)),
        jnp.einsum("cqai,cqbi,cq->cab", G, G, V),
        jnp.einsum("cqa,cqb,cq->cab", N, N, V),
        jnp.asarray(mesh.cells, jnp.int32),
        jnp.asarray(np.isin(np.arange(mesh.num_nodes), np.concatenate([sources, drains]))),
        jnp.asarray(given),
        depth,
        **settings,
    )
