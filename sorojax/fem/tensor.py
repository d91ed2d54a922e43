"""Three-by-three algebra on the entries of a tensor; what is absent costs nothing."""

from functools import cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.fem.kinematics import AbstractKinematics, identity
from sorojax.material.kinematics import Entry, Tensor, absent, determinant, minus, plus, times

Entries = Float[Array, "entries quad lanes"]
_NEXT = (1, 2, 0)


def cofactor(F: Tensor) -> Tensor:
    """dJ/dF."""

    def entry(i, j):
        k, l, m, n = _NEXT[i], _NEXT[_NEXT[i]], _NEXT[j], _NEXT[_NEXT[j]]
        return minus(times(F[k][m], F[l][n]), times(F[k][n], F[l][m]))

    return tuple(tuple(entry(i, j) for j in range(3)) for i in range(3))  # type: ignore


def inverse(F: Tensor) -> Tensor:
    """F^-1."""
    J, C = determinant(F), cofactor(F)
    return tuple(  # type: ignore[return-value]
        tuple(0.0 if absent(C[j][i]) else C[j][i] / J for j in range(3)) for i in range(3)
    )


def volume_ratio(kinematics: AbstractKinematics, F: Entries) -> Entry:
    """J of the kept entries."""
    return determinant(kinematics.embed(tuple(F)))


def checked_volume_ratio(
    kinematics: AbstractKinematics, F: Entries, share: Float[Array, "..."] | None
) -> Entry:
    """J of F = I + `share` Grad u: the volume that a solver keeps from inverting."""
    if share is None:
        return volume_ratio(kinematics, F)
    rest = jnp.asarray(identity(kinematics), F.dtype)[:, None, None]
    share = share if jnp.ndim(share) == 0 else share[None]
    return volume_ratio(kinematics, rest + share * (F - rest))


def volume_slopes(kinematics: AbstractKinematics, F: Entries) -> Entries:
    """dJ/dF by the kept entries."""
    C = cofactor(kinematics.embed(tuple(F)))
    return jnp.stack([C[s.row][s.col] for s in kinematics.slots])


@cache
def geometric_table(kind: type[AbstractKinematics]) -> np.ndarray:
    """(entries, entries, entries + 1 + pairs): what the geometric part of dP/dF is made of.

    The first columns hold d2J / dF dF as a multiple of the kept entries of F and of one, the
    last ones place S between entries in one row of F.
    """
    slots = kind.slots
    at = {(s.row, s.col): number for number, s in enumerate(slots)}
    pairs, m = stress_pairs(kind), len(slots)
    table = np.zeros((m, m, m + 1 + len(pairs)))
    for e, a in enumerate(slots):
        for f, b in enumerate(slots):
            if a.row == b.row:
                pair = (min(a.col, b.col), max(a.col, b.col))
                table[e, f, m + 1 + pairs.index(pair)] = 1.0
            elif a.col != b.col:
                third = (3 - a.row - b.row, 3 - a.col - b.col)
                even = (_NEXT[a.row] == b.row) == (_NEXT[a.col] == b.col)
                # entries that are not kept are those of the identity
                if third in at or third[0] == third[1]:
                    table[e, f, at.get(third, m)] = 1.0 if even else -1.0
    return table


def geometric_part(
    kinematics: AbstractKinematics, F: Entries, weight: Entry | None, S: Entries
) -> Float[Array, "entries entries quad lanes"]:
    """`weight` times d2J / dF dF, plus S between the entries of one row of F."""
    weight = jnp.zeros_like(F[0]) if weight is None else jnp.asarray(weight)
    # A product with a constant table: gathers of rows are several times slower.
    parts = jnp.concatenate([weight[None] * F, weight[None], S])
    table = jnp.asarray(geometric_table(type(kinematics)), parts.dtype)
    return jnp.einsum("efk,kql->efql", table, parts)


def second_piola(kinematics: AbstractKinematics, F: Entries, P: Entries) -> Entries:
    """S = F^-1 P, the entries that `stress_pairs` lists."""
    full = [[0.0] * 3 for _ in range(3)]
    for slot, value in zip(kinematics.slots, P, strict=True):
        full[slot.row][slot.col] = value
    back = inverse(kinematics.embed(tuple(F)))

    def entry(i, j):
        total: Entry = 0.0
        for k in range(3):
            total = plus(total, times(back[i][k], full[k][j]))
        return total

    return jnp.stack([entry(*pair) for pair in stress_pairs(type(kinematics))])


def stress_pairs(kind: type[AbstractKinematics]) -> list[tuple[int, int]]:
    """Columns (j, l), j <= l, of pairs of kept entries in one row of F."""
    pairs = {(a.col, b.col) for a in kind.slots for b in kind.slots if a.row == b.row}
    return sorted((j, l) for j, l in pairs if j <= l)


def stack_matrix(F: Tensor, like: Entry) -> Float[Array, "... 3 3"]:
    """The tensor as matrices over points of the shape of `like`."""
    rows = [
        jnp.stack([jnp.broadcast_to(jnp.asarray(e, like.dtype), like.shape) for e in row], -1)
        for row in F
    ]
    return jnp.stack(rows, axis=-2)
