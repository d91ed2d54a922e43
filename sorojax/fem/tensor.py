"""Three-by-three algebra on the entries of a tensor; what is absent costs nothing."""

from functools import cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.fem.kinematics import AbstractKinematics
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


def volume_slopes(kinematics: AbstractKinematics, F: Entries) -> Entries:
    """dJ/dF by the kept entries."""
    C = cofactor(kinematics.embed(tuple(F)))
    return jnp.stack([C[s.row][s.col] for s in kinematics.slots])


@cache
def _tables(kind: type[AbstractKinematics]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per pair of kept entries: number and sign of the entry of F in d2J / dF dF, and
    number of the stress S that meets both."""
    slots = kind.slots
    at = {(s.row, s.col): number for number, s in enumerate(slots)}
    pairs = stress_pairs(kind)
    m = len(slots)
    place, sign = np.zeros((m, m), int), np.zeros((m, m))
    stress = np.full((m, m), len(pairs))
    for e, a in enumerate(slots):
        for f, b in enumerate(slots):
            if a.row == b.row:
                stress[e, f] = pairs.index((min(a.col, b.col), max(a.col, b.col)))
            if a.row != b.row and a.col != b.col:
                even = (_NEXT[a.row] == b.row) == (_NEXT[a.col] == b.col)
                # entries that are not kept are those of the identity, after the last
                third = (3 - a.row - b.row, 3 - a.col - b.col)
                place[e, f] = at.get(third, m)
                known = third in at or third[0] == third[1]
                sign[e, f] = (1.0 if even else -1.0) if known else 0.0
    return place, sign, stress


def curvature_table(kinematics: AbstractKinematics) -> tuple[np.ndarray, np.ndarray]:
    """Numbers among `curvature_entries` and signs of d2J / dF_e dF_f."""
    return _tables(type(kinematics))[:2]


def curvature_entries(F: Entries) -> Entries:
    """The kept entries of F, and one."""
    return jnp.concatenate([F, jnp.ones_like(F[:1])])


def stress_table(kinematics: AbstractKinematics) -> np.ndarray:
    """Number of the S entry between two kept entries in one row of F, or one too many."""
    return _tables(type(kinematics))[2]


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
