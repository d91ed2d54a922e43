"""Compiled assembly: internal force and tangent values in one pass over blocks.

Arrays have the cell axis last. Displacement gradients, stresses and tangents are
elementwise code; the contraction with the shape gradients accumulates one quadrature
point at a time, so that a block stays in the cache.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.fem.contract import block_matrix
from sorojax.fem.energy import Body, energy_density, response
from sorojax.fem.formulation import Modes
from sorojax.fem.geometry import Geometry, deformation_gradient, gradient_entries
from sorojax.fem.kinematics import AbstractKinematics
from sorojax.fem.space import Space, lanes, per_block
from sorojax.fem.tensor import checked_volume_ratio
from sorojax.material.hyperelastic import AbstractHyperelastic, finite_share
from sorojax.math.apart import apart


class Assembly(NamedTuple):
    """Internal force [N], tangent values [N/m] and the smallest J / J_before."""

    force: Float[Array, " dofs"]
    values: Float[Array, " nnz"]
    volume_ratio: Float[Array, ""]


class _Block(NamedTuple):
    """Arrays of the cells that are worked on together."""

    cells: Any
    real: Bool[Array, " lanes"]
    gradients: Any
    volumes: Any
    modes: Modes | None
    varying: Any


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
    blocks, constant = _blocks(space, geometry, material)

    def work(total: Assembly, part: tuple[_Block, Any, Any]):
        block, nodes, slots = part
        alone = apart(block.cells[0, 0] >= 0)
        body = _body(block, constant, kinematics)
        F, F_before = alone(lambda: tuple(
            deformation_gradient(kinematics, lanes(x, block.cells), block.gradients)
            for x in (u, u_before)
        ))  # fmt: skip
        share = finite_share(body.material)
        J, J_before = (checked_volume_ratio(kinematics, x, share) for x in (F, F_before))
        answer = response(body, F, F_before, alone)
        force, upper = block_matrix(kinematics, answer, body, block.gradients, alone)
        return Assembly(
            total.force.at[nodes].add(jnp.moveaxis(force, 1, -1)),
            total.values.at[slots].add(upper),
            jnp.minimum(total.volume_ratio, jnp.min(J / J_before)),
        ), None

    # padding writes to one node and one slot more than there are
    nodes = jnp.where(space.real[:, None], space.cells, space.num_nodes)
    nothing = Assembly(
        jnp.zeros((space.num_nodes + 1, space.dim), u.dtype),
        jnp.zeros(space.system.num_values + 1, u.dtype),
        jnp.asarray(jnp.inf, u.dtype),
    )
    total, _ = jax.lax.scan(work, nothing, (blocks, nodes, space.slots))
    return Assembly(total.force[:-1].ravel(), total.values[:-1], total.volume_ratio)


@jax.jit
def cell_matrices(
    space: Space,
    geometry: Geometry,
    material: AbstractHyperelastic,
    kinematics: AbstractKinematics,
    u: Float[Array, "nodes dim"],
) -> Float[Array, "blocks entries lanes"]:
    """Tangents of all cells at `u` before they are added up; see `Space.slots`."""
    blocks, constant = _blocks(space, geometry, material)

    def work(block: _Block):
        alone = apart(block.cells[0, 0] >= 0)
        body = _body(block, constant, kinematics)
        F = alone(
            lambda: deformation_gradient(kinematics, lanes(u, block.cells), block.gradients)
        )
        answer = response(body, F, F, alone)
        return block_matrix(kinematics, answer, body, block.gradients, alone)[1]

    return jax.lax.map(work, blocks)


@jax.jit
def largest_step(
    space: Space,
    geometry: Geometry,
    kinematics: AbstractKinematics,
    u: Float[Array, "nodes dim"],
    du: Float[Array, "nodes dim"],
    keep: float = 0.1,
    share: Float[Array, "..."] | None = None,
) -> Float[Array, ""]:
    """Largest sampled fraction of `du`, at most 1, up to which J >= keep * J(u) everywhere.

    `share` is the `finite_share` of the material.
    """

    def ratio(fraction):
        return kept_volume(space, geometry, kinematics, u, fraction * du, share)

    fractions = _SHRINK ** jnp.arange(_SAMPLES - 1, -1, -1, dtype=u.dtype)
    ok = jax.lax.map(ratio, fractions) >= keep
    count = jnp.sum(jnp.cumprod(ok.astype(u.dtype)))
    return _SHRINK ** (_SAMPLES - count)


_SHRINK, _SAMPLES = 0.75, 32


@jax.jit
def kept_volume(
    space: Space,
    geometry: Geometry,
    kinematics: AbstractKinematics,
    u: Float[Array, "nodes dim"],
    du: Float[Array, "nodes dim"],
    share: Float[Array, "..."] | None = None,
) -> Float[Array, ""]:
    """Smallest J(u + du) / J(u)."""
    varying, constant = per_block(space, share)

    def work(arrays):
        cells, G, varying = arrays
        own = eqx.combine(varying, constant)
        F = deformation_gradient(kinematics, lanes(u, cells), G)
        D = gradient_entries(kinematics, lanes(du, cells), G)
        J, J_before = (checked_volume_ratio(kinematics, x, own) for x in (F + D, F))
        return jnp.min(J / J_before)

    return jnp.min(jax.lax.map(work, (space.cells, geometry.gradients, varying)))


@jax.jit
def strain_energy(
    space: Space,
    geometry: Geometry,
    material: AbstractHyperelastic,
    kinematics: AbstractKinematics,
    u: Float[Array, "nodes dim"],
) -> Float[Array, ""]:
    """Stored energy of the body [J]."""
    blocks, constant = _blocks(space, geometry, material)

    def work(block: _Block):
        body = _body(block, constant, kinematics)
        F = deformation_gradient(kinematics, lanes(u, block.cells), block.gradients)
        energy = jnp.sum(block.volumes * energy_density(body, F), axis=0)
        return jnp.sum(jnp.where(block.real, energy, jnp.zeros_like(energy)))

    return jnp.sum(jax.lax.map(work, blocks))


def _blocks(space: Space, geometry: Geometry, material) -> tuple[_Block, Any]:
    varying, constant = per_block(space, material)
    return _Block(space.cells, space.real, *geometry, varying), constant


def _body(block: _Block, constant, kinematics: AbstractKinematics) -> Body:
    material = eqx.combine(block.varying, constant)
    return Body(material, kinematics, block.modes, block.volumes)
