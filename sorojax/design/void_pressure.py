"""A pressure inside the cells of a fixed mesh, whatever their density.

A cell that fills its volume with a gas of pressure p gains p times the volume that it grows
by. Between cells of one pressure the forces cancel, so what remains acts where the pressure
ends: on the walls of the cavity, along their deformed normals, wherever a design puts them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.fem.curved import CurvedPart
from sorojax.fem.formulation import Displacement
from sorojax.fem.geometry import geometry
from sorojax.fem.kinematics import AbstractKinematics, Axisymmetric
from sorojax.fem.loads import AbstractLoad
from sorojax.fem.points import Points, deformation, quadrature_points
from sorojax.fem.space import Space
from sorojax.fem.tensor import volume_ratio
from sorojax.material.kinematics import determinant
from sorojax.math import sparse
from sorojax.mesh.mesh import Mesh


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
        _check.shape("fem.problem", f"{where} share", self.share, want,
                     "Make it with design.void_pressure(mesh, share).")  # fmt: skip


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
        share: One number per cell, or per node with `per="node"`; may be traced.
        value: The pressure where the share is 1 [Pa, gauge].
        per: "cell" (of `flooded`) or "node" (of `darcy_pressure`).

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
