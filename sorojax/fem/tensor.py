"""Three-by-three algebra on the entries of a tensor; what is absent costs nothing."""

from functools import reduce

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.kinematics import AbstractKinematics, identity
from sorojax.material.kinematics import (
    Entry,
    Tensor,
    cofactor,
    determinant,
    minus,
    plus,
    times,
)

Entries = Float[Array, "entries quad lanes"]


def inverse(F: Tensor) -> Tensor:
    """F^-1."""
    C, shrink = cofactor(F), 1 / determinant(F)
    return tuple(tuple(times(C[j][i], shrink) for j in range(3)) for i in range(3))  # type: ignore


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


def second_piola(kinematics: AbstractKinematics, F: Entries, P: Entries) -> tuple[Entry, ...]:
    """S = F^-1 P, the entries that `stress_pairs` lists."""
    back = inverse(kinematics.embed(tuple(F)))
    return _pairs(kinematics, _product(back, _full(kinematics, P)))


def extrapolated_piola(
    kinematics: AbstractKinematics, F: Entries, step: Entries, P: Entries, rate: Entries
) -> tuple[Entry, ...]:
    """S and its change where F changes by `step` and P by `rate`, as F S = P."""
    back = inverse(kinematics.embed(tuple(F)))
    S = _product(back, _full(kinematics, P))
    turned = _product(_full(kinematics, step), S)
    rows = zip(_full(kinematics, rate), turned, strict=True)
    change = _product(back, tuple(tuple(map(minus, *pair)) for pair in rows))
    return tuple(map(plus, _pairs(kinematics, S), _pairs(kinematics, change)))


def _full(kinematics: AbstractKinematics, entries: Entries) -> Tensor:
    full: list[list[Entry]] = [[0.0] * 3 for _ in range(3)]
    for slot, value in zip(kinematics.slots, entries, strict=True):
        full[slot.row][slot.col] = value
    return tuple(map(tuple, full))  # type: ignore[arg-type]


def _product(a: Tensor, b: Tensor) -> Tensor:
    def entry(i, j):
        return reduce(plus, (times(a[i][k], b[k][j]) for k in range(3)))

    return tuple(tuple(entry(i, j) for j in range(3)) for i in range(3))  # type: ignore


def _pairs(kinematics: AbstractKinematics, S: Tensor) -> tuple[Entry, ...]:
    return tuple(S[i][j] for i, j in stress_pairs(type(kinematics)))


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
