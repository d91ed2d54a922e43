"""Finite-strain kinematics written on the entries of a tensor.

A tensor is a nested tuple of its nine entries, each an array over any number of
points (or a Python float). Entries that are the Python number 0.0 are absent:
products with them vanish at trace time, so a planar state pays for no third
dimension.

Reference: Bonet & Wood, Nonlinear Continuum Mechanics for Finite Element Analysis,
2008, chapters 4 and 6.
"""

from typing import Any

from jaxtyping import Array, Float

from sorojax.math.linalg.dense import inverse_cube_root

Entry = Any  # float or array over points
Tensor = tuple[tuple[Entry, Entry, Entry], ...]


def absent(entry: Entry) -> bool:
    return isinstance(entry, float) and entry == 0.0


def times(a: Entry, b: Entry) -> Entry:
    return 0.0 if absent(a) or absent(b) else a * b


def plus(a: Entry, b: Entry) -> Entry:
    if absent(a):
        return b
    return a if absent(b) else a + b


def minus(a: Entry, b: Entry) -> Entry:
    return a if absent(b) else a - b


def from_matrix(F: Float[Array, "3 3"]) -> Tensor:
    """Entries of a matrix."""
    return tuple(tuple(F[i, j] for j in range(3)) for i in range(3))  # type: ignore


def is_planar(F: Tensor) -> bool:
    """Whether the third direction is a principal one because its shears are absent."""
    return all(absent(entry) for entry in (F[0][2], F[1][2], F[2][0], F[2][1]))


def cofactor(F: Tensor) -> Tensor:
    """dJ/dF."""
    rows = []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows.append(
            tuple(
                minus(
                    times(F[j][(m + 1) % 3], F[k][(m + 2) % 3]),
                    times(F[j][(m + 2) % 3], F[k][(m + 1) % 3]),
                )
                for m in range(3)
            )
        )
    return tuple(rows)


def determinant(F: Tensor) -> Entry:
    """J = det F, the volume ratio."""
    (a, b, c), (d, e, f), (g, h, i) = F
    first = times(a, minus(times(e, i), times(f, h)))
    second = times(b, minus(times(d, i), times(f, g)))
    third = times(c, minus(times(d, h), times(e, g)))
    return plus(minus(first, second), third)


def square_norm(F: Tensor) -> Entry:
    """I1 = tr(F'F)."""
    total: Entry = 0.0
    for row in F:
        for entry in row:
            total = plus(total, times(entry, entry))
    return total


def right_cauchy_green(F: Tensor) -> Tensor:
    """C = F'F."""
    return tuple(
        tuple(
            plus(
                plus(times(F[0][i], F[0][j]), times(F[1][i], F[1][j])), times(F[2][i], F[2][j])
            )
            for j in range(3)
        )
        for i in range(3)
    )  # type: ignore


def isochoric_first_invariant(F: Tensor) -> Entry:
    """J^(-2/3) tr(F'F)."""
    root = inverse_cube_root(determinant(F))
    return root * root * square_norm(F)


def isochoric_second_invariant(F: Tensor) -> Entry:
    """J^(-4/3) |cof F|^2, half of tr(C)^2 - tr(C^2) of the isochoric C."""
    square = inverse_cube_root(determinant(F)) ** 2
    return square * square * square_norm(cofactor(F))
