"""Compiled assembly: internal force and tangent values in one pass over blocks.

Arrays have the cell axis last. Displacement gradients, stresses and tangents are
elementwise code; the contraction with the shape gradients accumulates one quadrature
point at a time, so that a block stays in the cache.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.energy import energy_density, stress_and_tangent
from sorojax.fem.kinematics import (
    AbstractKinematics,
    Planar,
    cofactor,
    determinant,
    stack,
    unstack,
)
from sorojax.fem.space import Space, lanes, per_block
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.mesh.shape import quadrature, shape_gradients


class Geometry(NamedTuple):
    """Gradients of the shape functions and volumes of the quadrature points."""

    gradients: Float[Array, "blocks quad cell_nodes dim lanes"]
    volumes: Float[Array, "blocks quad lanes"]


class Assembly(NamedTuple):
    """Internal force [N], tangent values [N/m] and the smallest J / J_before."""

    force: Float[Array, " dofs"]
    values: Float[Array, " nnz"]
    volume_ratio: Float[Array, ""]


@jax.jit
def geometry(
    space: Space, kinematics: AbstractKinematics, points: Float[Array, "nodes dim"]
) -> Geometry:
    """Shape gradients [1/m] and quadrature volumes [m^3] of the cells at `points`."""
    rule = quadrature(space.element)
    slopes = shape_gradients(space.element, rule.points)

    def block(arrays):
        cells, real = arrays
        x = lanes(points, cells)
        jac = [[_contract(x[i], slopes[:, :, d]) for d in range(2)] for i in range(2)]
        J = determinant(unstack(stack(jac)))  # type: ignore[arg-type]
        inverse = [[jac[1][1] / J, -jac[0][1] / J], [-jac[1][0] / J, jac[0][0] / J]]
        gradients = jnp.stack(
            [
                jnp.einsum("qa,qe->qae", slopes[:, :, 0], inverse[0][j])
                + jnp.einsum("qa,qe->qae", slopes[:, :, 1], inverse[1][j])
                for j in range(2)
            ],
            axis=2,
        )
        volumes = J * rule.weights[:, None] * kinematics.depth
        return gradients, jnp.where(real[None], volumes, jnp.zeros_like(volumes))

    return Geometry(*jax.lax.map(block, (space.cells, space.real)))


def _contract(nodal, slopes):
    return jnp.einsum("ae,qa->qe", nodal, slopes)


def displacement_gradient(
    u: Float[Array, "dim cell_nodes lanes"],
    gradients: Float[Array, "quad cell_nodes dim lanes"],
) -> Planar:
    """Grad u at the quadrature points of a block."""
    num = u.shape[1]
    return tuple(  # type: ignore[return-value]
        tuple(sum(u[i, a][None] * gradients[:, a, j] for a in range(num)) for j in range(2))
        for i in range(2)
    )


def deformation_gradient(u, gradients) -> Planar:
    """F = I + Grad u at the quadrature points of a block."""
    (a, b), (c, d) = displacement_gradient(u, gradients)
    return ((a + 1, b), (c, d + 1))


@jax.jit
def assemble(
    space: Space,
    geometry: Geometry,
    material: AbstractHyperelastic,
    kinematics: AbstractKinematics,
    u: Float[Array, "nodes dim"],
    u_before: Float[Array, "nodes dim"],
) -> Assembly:
    """Internal force and tangent at `u`; the geometric part of the tangent uses the
    stress extrapolated from `u_before` (pass `u` for the exact tangent)."""
    varying, constant = per_block(space, material)

    def block(arrays):
        cells, G, w, varies = arrays
        rubber = eqx.combine(varies, constant)
        F = deformation_gradient(lanes(u, cells), G)
        F_before = deformation_gradient(lanes(u_before, cells), G)
        ratio = jnp.min(determinant(F) / determinant(F_before))
        P, A = stress_and_tangent(rubber, kinematics, F, F_before)
        A = jnp.stack([jnp.stack([stack(A[i][j]) for j in range(2)]) for i in range(2)])
        force, matrix = _contract_block(stack(P), A, G, w)
        num = matrix.shape[0] * 2
        matrix = matrix.reshape(num, num, -1)
        upper = jnp.concatenate([matrix[i, i:] for i in range(num)])
        return force, upper, ratio

    blocks = (space.cells, geometry.gradients, geometry.volumes, varying)
    forces, uppers, ratios = jax.lax.map(block, blocks)
    force = jnp.zeros_like(u).at[space.cells].add(jnp.moveaxis(forces, 2, -1))
    # padding writes to one slot more than there are values
    values = jnp.zeros(space.system.num_values + 1, u.dtype).at[space.slots].add(uppers)
    return Assembly(force.ravel(), values[:-1], jnp.min(ratios))


def _contract_block(P, A, G, w):
    """Sum over points of P G, (nodes, dim, lanes), and of G' A G, one row per (node, dim)."""
    num, lanes_ = G.shape[1], G.shape[-1]

    def add_point(sums, point):
        P, A, G, w = point
        Gw = G * w[None, None]
        force = jnp.stack(
            [P[i, 0, None] * Gw[:, 0] + P[i, 1, None] * Gw[:, 1] for i in range(2)], axis=1
        )
        AG = [
            [
                jnp.stack(
                    [
                        A[i, j, k, 0, None] * G[:, 0] + A[i, j, k, 1, None] * G[:, 1]
                        for k in range(2)
                    ],
                    axis=1,
                )
                for j in range(2)
            ]
            for i in range(2)
        ]
        matrix = jnp.stack(
            [
                Gw[:, 0, None, None] * AG[i][0][None] + Gw[:, 1, None, None] * AG[i][1][None]
                for i in range(2)
            ],
            axis=1,
        )
        return (sums[0] + force, sums[1] + matrix), None

    start = (
        jnp.zeros((num, 2, lanes_), P.dtype),
        jnp.zeros((num, 2, num, 2, lanes_), P.dtype),
    )
    points = (jnp.moveaxis(P, 2, 0), jnp.moveaxis(A, 4, 0), G, w)
    return jax.lax.scan(add_point, start, points)[0]


@jax.jit
def largest_step(
    space: Space,
    geometry: Geometry,
    u: Float[Array, "nodes dim"],
    du: Float[Array, "nodes dim"],
    keep: float = 0.1,
) -> Float[Array, ""]:
    """Largest fraction of `du`, at most 1, that leaves J >= keep * J(u) at every point.

    J is quadratic in the step, so the answer is a closed form.
    """

    def block(arrays):
        cells, G = arrays
        F = deformation_gradient(lanes(u, cells), G)
        D = displacement_gradient(lanes(du, cells), G)
        C = cofactor(F)
        a = determinant(D)
        b = sum(C[i][j] * D[i][j] for i in range(2) for j in range(2))
        c = (1 - keep) * determinant(F)
        root = b * b - 4 * a * c
        safe = jnp.sqrt(jnp.where(root > 0, root, jnp.ones_like(root)))
        below = safe - b
        ok = (root > 0) & (below > 0)
        return jnp.min(jnp.where(ok, 2 * c / jnp.where(ok, below, jnp.ones_like(b)), jnp.inf))

    return jnp.minimum(1.0, jnp.min(jax.lax.map(block, (space.cells, geometry.gradients))))


@jax.jit
def strain_energy(
    space: Space,
    geometry: Geometry,
    material: AbstractHyperelastic,
    kinematics: AbstractKinematics,
    u: Float[Array, "nodes dim"],
) -> Float[Array, ""]:
    """Stored energy of the body [J]."""
    varying, constant = per_block(space, material)

    def block(arrays):
        cells, G, w, varies = arrays
        F = deformation_gradient(lanes(u, cells), G)
        rubber = eqx.combine(varies, constant)
        return jnp.sum(w * energy_density(rubber, kinematics, F))

    blocks = (space.cells, geometry.gradients, geometry.volumes, varying)
    return jnp.sum(jax.lax.map(block, blocks))
