"""Cell forces and matrices of a block from stresses and tangents at its points.

All points are summed in one expression, so that an entry of a cell matrix is written once;
with sums kept in memory from point to point their traffic costs more than the arithmetic.
"""

import functools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.energy import Body, Response
from sorojax.fem.kinematics import AbstractKinematics, component_pairs, entries_of
from sorojax.fem.point_tangent import Tangent, tangent_entries
from sorojax.fem.tensor import Entries
from sorojax.math.apart import Alone

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
    weighted, bent, pull = alone(lambda: (
        gradients * body.volumes[:, None, None],
        _stiff_gradients(kinematics, answer.tangent, gradients),
        answer.stress * body.volumes[None],
    ))  # fmt: skip
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
