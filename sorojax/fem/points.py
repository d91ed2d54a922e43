"""Fields at the quadrature points of all cells at once, made for differentiation.

One product takes nodal values to reference gradients; the rest is elementwise.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.fem.kinematics import Planar, determinant
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.shape import quadrature, shape_functions, shape_gradients


def _reference_gradients(mesh: Mesh, nodal: Float[Array, "nodes dim"], at=None) -> Planar:
    """d(nodal)_i / d(xi)_d at reference points, entries (points, cells)."""
    at = quadrature(mesh.element).points if at is None else at
    slopes = jnp.asarray(shape_gradients(mesh.element, at))
    by_cell = jnp.moveaxis(nodal.T[:, mesh.cells], -1, 1)  # dim, nodes, cells
    all_ = jnp.einsum("qad,iac->idqc", slopes, by_cell)
    return ((all_[0, 0], all_[0, 1]), (all_[1, 0], all_[1, 1]))


def point_areas(mesh: Mesh) -> Float[Array, "quad cells"]:
    """Reference area of every quadrature point [m^2]."""
    weights = jnp.asarray(quadrature(mesh.element).weights)[:, None]
    return weights * determinant(_reference_gradients(mesh, mesh.points))


def deformation_gradients(
    mesh: Mesh,
    u: Float[Array, "nodes dim"],
    at: Float[np.ndarray, "quad dim"] | None = None,
) -> Planar:
    """F, entries (points, cells), at the quadrature points or at reference points `at`."""
    (a, b), (c, d) = _reference_gradients(mesh, mesh.points, at)
    J = a * d - b * c
    inverse = ((d / J, -b / J), (-c / J, a / J))
    h = _reference_gradients(mesh, u, at)
    grad = [
        [h[i][0] * inverse[0][j] + h[i][1] * inverse[1][j] for j in range(2)] for i in range(2)
    ]
    return ((grad[0][0] + 1, grad[0][1]), (grad[1][0], grad[1][1] + 1))


def integral(mesh: Mesh, nodal: Float[Array, "nodes dim"]) -> Float[Array, "cells dim"]:
    """Integral of a nodal field over every cell, per depth."""
    N = jnp.asarray(shape_functions(mesh.element, quadrature(mesh.element).points))
    return jnp.einsum("qc,qa,cai->ci", point_areas(mesh), N, nodal[mesh.cells])
