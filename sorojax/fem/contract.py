"""Cell forces and matrices of a block from stresses and tangents at its points."""

import functools
from collections.abc import Iterable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.energy import Body, Response
from sorojax.fem.kinematics import AbstractKinematics

Force = Float[Array, "cell_nodes dim lanes"]


def block_matrix(
    kinematics: AbstractKinematics,
    answer: Response,
    body: Body,
    gradients: Float[Array, "quad cell_nodes columns lanes"],
) -> tuple[Force, Float[Array, "entries lanes"]]:
    """Sums over points of P G and of G' A G, the latter in the order of `block_entries`."""
    points = (
        jnp.moveaxis(answer.stress, 1, 0),
        jnp.moveaxis(answer.tangent, 2, 0),
        None if answer.slopes is None else jnp.moveaxis(answer.slopes, 1, 0),
        gradients,
        body.volumes,
        None if body.modes is None else jnp.moveaxis(body.modes, 1, 0),
    )

    # Otherwise XLA repeats the material's work in every entry of the cell matrix.
    points = jax.lax.optimization_barrier(points)

    def at_point(point):
        P, A, C, G, w, modes = point
        Gw = G * w[None, None]
        if C is None or modes is None:
            return _force(kinematics, P, Gw), _matrix(kinematics, A, G, Gw), None
        # d(dilatation)/du of every node, times each pressure function
        slopes = _force(kinematics, C, Gw)[None] * modes[:, None, None]
        return _force(kinematics, P, Gw), _matrix(kinematics, A, G, Gw), slopes

    force, blocks, slopes = _sum_over_points(at_point, points)
    if slopes is not None:
        blocks = blocks + _bulk(slopes, answer.stiffness)
    return force, _upper(kinematics.dim, blocks)


def _sum_over_points(at_point, points):
    """One point after the other, so that the sums stay in the cache."""
    first = jax.tree.map(lambda x: x[0], points)
    if jax.tree.leaves(points)[0].shape[0] == 1:
        return at_point(first)

    def add(sums, point):
        return jax.tree.map(jnp.add, sums, at_point(point)), None

    start = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(at_point, first))
    return jax.lax.scan(add, start, points)[0]


def component_pairs(dim: int) -> list[tuple[int, int]]:
    return [(i, k) for i in range(dim) for k in range(i, dim)]


def _force(kinematics: AbstractKinematics, P, Gw) -> Force:
    """P : Grad N of every node."""
    rows = []
    for i in range(kinematics.dim):
        mine = [(e, s.column) for e, s in enumerate(kinematics.slots) if s.component == i]
        rows.append(_total(P[e][None] * Gw[:, j] for e, j in mine))
    return jnp.stack(rows, axis=1)


def _matrix(kinematics: AbstractKinematics, A, G, Gw) -> Float[Array, "pairs n n lanes"]:
    """G' A G for every pair of components i <= k."""
    blocks = []
    for i, k in component_pairs(kinematics.dim):
        terms = []
        for e, first in enumerate(kinematics.slots):
            if first.component != i:
                continue
            AG = _total(
                A[e, f][None] * G[:, second.column]
                for f, second in enumerate(kinematics.slots)
                if second.component == k
            )
            terms.append(Gw[:, first.column][:, None] * AG[None])
        blocks.append(_total(terms))
    return jnp.stack(blocks)


def _total(terms: Iterable[jax.Array]) -> jax.Array:
    return functools.reduce(jnp.add, terms)


def _bulk(slopes, H) -> Float[Array, "pairs n n lanes"]:
    """Stiffness of the pressure modes; `slopes` are d(coefficient)/du."""
    through = jnp.sum(H[:, :, None, None] * slopes[None], axis=1)
    return jnp.stack(
        [
            jnp.sum(slopes[:, :, i][:, :, None] * through[:, :, k][:, None], axis=0)
            for i, k in component_pairs(slopes.shape[2])
        ]
    )


def _upper(dim: int, blocks) -> Float[Array, "entries lanes"]:
    rows = []
    for (i, k), block in zip(component_pairs(dim), blocks, strict=True):
        if i == k:
            rows += [block[a, a:] for a in range(block.shape[0])]
        else:
            rows.append(block.reshape(-1, block.shape[-1]))
    return jnp.concatenate(rows)
