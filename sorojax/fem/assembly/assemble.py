"""Compiled assembly: internal force and tangent values in one pass over blocks of cells.

Arrays have the cell axis last. Displacement gradients, stresses and tangents are
elementwise code. Points are accumulated one at a time for forces, so that a block stays in
the cache, and in one expression for cell matrices, whose partial sums would cost more in
memory traffic than in arithmetic.
"""

import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._jax.jit import once
from sorojax.fem.assembly.energy import (
    Body,
    Entries,
    Response,
    Tangent,
    checked_volume_ratio,
    response,
    tangent_entries,
)
from sorojax.fem.assembly.geometry import Geometry, deformation_gradient, gradient_entries
from sorojax.fem.assembly.space import Modes, Space, lanes, per_block
from sorojax.fem.kinematics import AbstractKinematics, component_pairs, entries_of
from sorojax.material.hyperelastic import AbstractHyperelastic, finite_share
from sorojax.math.compiled import Alone, apart

Force = Float[Array, "cell_nodes dim lanes"]
Gradients = Float[Array, "quad cell_nodes columns lanes"]


def block_matrix(
    kinematics: AbstractKinematics,
    answer: Response,
    body: Body,
    gradients: Gradients,
    alone: Alone,
) -> tuple[Force, Float[Array, "entries lanes"]]:
    """Sums over points of P G and of G' A G, the latter in the order of `block_entries`."""
    weighted, bent, pull = alone(
        lambda: (
            gradients * body.volumes[:, None, None],
            _stiff_gradients(kinematics, answer.tangent, gradients),
            answer.stress * body.volumes[None],
        )
    )
    shares = alone(lambda: _shares(kinematics, answer, body, weighted))

    def contract():
        blocks = [
            _matrix(kinematics, i, stiff, weighted)
            for (i, _), stiff in zip(component_pairs(kinematics.dim), bent, strict=True)
        ]
        if shares is not None:
            blocks = [b + more for b, more in zip(blocks, _bulk(*shares), strict=True)]
        return _force(kinematics, pull, gradients), _upper(blocks)

    return alone(contract)


def _shares(kinematics: AbstractKinematics, answer: Response, body: Body, weighted: Gradients):
    """d(coefficient)/du of the pressure modes, and the same times their stiffness."""
    if answer.slopes is None or answer.stiffness is None or body.modes is None:
        return None
    each = [_force(kinematics, mode[None] * answer.slopes, weighted) for mode in body.modes]
    slopes = jnp.stack(each)
    return slopes, jnp.sum(answer.stiffness[:, :, None, None] * slopes[None], axis=1)


def _force(kinematics: AbstractKinematics, P: Entries, gradients: Gradients) -> Force:
    """P : Grad N of every node, one of both times the volumes of the points."""
    rows = [
        _total(
            P[e, q][None] * gradients[q, :, j]
            for q in range(gradients.shape[0])
            for e, j in entries_of(kinematics, i)
        )
        for i in range(kinematics.dim)
    ]
    return jnp.stack(rows, axis=1)


def _stiff_gradients(
    kinematics: AbstractKinematics, tangent: Tangent, G: Gradients
) -> list[list[Float[Array, "quad cell_nodes lanes"]]]:
    """A G for each pair of components i <= k: one array per kept entry of row i."""
    ends = [entries_of(kinematics, k) for _, k in component_pairs(kinematics.dim)]
    return [
        [
            _total(A[:, None] * G[:, :, j] for A, (_, j) in zip(row, end, strict=True))
            for row in rows
        ]
        for end, rows in zip(ends, tangent_entries(kinematics, tangent), strict=True)
    ]


def _matrix(kinematics: AbstractKinematics, i: int, bent, weighted: Gradients):
    """G' A G of one pair of components, (nodes, nodes, lanes)."""
    return _total(
        weighted[q, :, j][:, None] * stiff[q][None]
        for q in range(weighted.shape[0])
        for (_, j), stiff in zip(entries_of(kinematics, i), bent, strict=True)
    )


def _total(terms: Iterable[jax.Array]) -> jax.Array:
    return functools.reduce(jnp.add, terms)


def _bulk(
    slopes: Float[Array, "modes cell_nodes dim lanes"],
    through: Float[Array, "modes cell_nodes dim lanes"],
) -> list[Float[Array, "cell_nodes cell_nodes lanes"]]:
    """Stiffness of the pressure modes."""
    return [
        _total(a[:, i][:, None] * b[:, k][None] for a, b in zip(slopes, through, strict=True))
        for i, k in component_pairs(slopes.shape[2])
    ]


def _upper(blocks: list[Float[Array, "cell_nodes cell_nodes lanes"]]):
    """Blocks of the pairs i <= k of components, as rows of entries."""
    pairs = component_pairs(2 if len(blocks) == 3 else 3)
    rows = []
    for (i, k), block in zip(pairs, blocks, strict=True):
        if i == k:
            rows += [block[a, a:] for a in range(block.shape[0])]
        else:
            rows.append(block.reshape(-1, block.shape[-1]))
    return jnp.concatenate(rows)


# Compiled assembly: internal force and tangent values in one pass over blocks


class Assembly(NamedTuple):
    """Internal force [N], tangent values [N/m] and the smallest J / J_before."""

    force: Float[Array, " dofs"]
    values: Float[Array, " nnz"]
    volume_ratio: Float[Array, ""]


class _Block(NamedTuple):
    """Arrays of the cells that are worked on together."""

    cells: Any
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
        F, F_before = alone(
            lambda: tuple(
                deformation_gradient(kinematics, lanes(x, block.cells), block.gradients)
                for x in (u, u_before)
            )
        )
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


@once
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
        answer = response(body, F, None, alone)
        return block_matrix(kinematics, answer, body, block.gradients, alone)[1]

    return jax.lax.map(work, blocks)


@jax.jit
def largest_step(
    space: Space,
    geometry: Geometry,
    kinematics: AbstractKinematics,
    u: Float[Array, "nodes dim"],
    du: Float[Array, "nodes dim"],
    keep: float,
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


def _blocks(space: Space, geometry: Geometry, material) -> tuple[_Block, Any]:
    varying, constant = per_block(space, material)
    return _Block(space.cells, *geometry, varying), constant


def _body(block: _Block, constant, kinematics: AbstractKinematics) -> Body:
    material = eqx.combine(block.varying, constant)
    return Body(material, kinematics, block.modes, block.volumes)
