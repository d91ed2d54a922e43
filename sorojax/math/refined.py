"""Solutions of a linear system by the factor of a neighbouring one.

The matrix of the last iterations of Newton's method, or of an adjoint, differs little from
one that is factored already: conjugate gradients preconditioned with that factor need two or
three back-substitutions, each a fraction of what a factor costs. Both matrices must be
positive definite; where the one asked for is not, a search direction or the spectrum that the
iteration sees (Lanczos) tells.

Reference: Saad, "Iterative Methods for Sparse Linear Systems", 2nd ed., 2003, chapters 6, 9.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

_MOST = 8  # corrections: beyond, a new factor is cheaper
_FAST = 0.3  # largest share of the error that a correction may leave
_LOWEST = 0.5  # smallest eigenvalue of a neighbour, that of the factored matrix being 1
_EXACT = 1e-12  # error of the solution that is none, relative to its largest entry


class Solves(Protocol):
    """A numeric factor."""

    def solve(self, b: np.ndarray) -> np.ndarray: ...


def refined(
    factor: Solves,
    product: Callable[[np.ndarray], np.ndarray],
    b: Float[np.ndarray, " n"],
    start: Float[np.ndarray, " n"] | None = None,
    tolerance: float = _EXACT,
) -> Float[np.ndarray, " n"] | None:
    """x with product(x) = b by a factor of a matrix near to that of `product`; `None` where
    it does not converge at once, or that matrix is seen not to be positive definite.

    `start` is a guess, zero if omitted: what it has of every mode the iteration gets to see.
    `tolerance` is the largest error relative to the largest entry of x.
    """
    x = np.zeros_like(b) if start is None else start
    left = b.copy() if start is None else b - product(start)
    z, direction, energy, step = factor.solve(left), 0.0, 1.0, 1.0
    before, diagonal, beside = np.inf, [], []
    for k in range(_MOST + 1):
        size, largest = np.max(np.abs(z), initial=0.0), np.max(np.abs(x + z), initial=0.0)
        if k > 0 and size * size <= tolerance * largest * before:  # the next correction's
            return x + z if _lowest(diagonal, beside) > _LOWEST else None
        if not size <= _FAST * before or k == _MOST:
            return None
        old, energy = energy, left @ z
        share = energy / old if k > 0 else 0.0
        direction = z + share * direction
        change = product(direction)
        curved = direction @ change
        if not curved > 0:
            return x if energy == 0 else None
        diagonal.append(curved / energy + share / step)
        beside.append(np.sqrt(share) / step)
        step = energy / curved
        x, left, before = x + step * direction, left - step * change, size
        z = factor.solve(left)
    return None


def _lowest(diagonal: list[float], beside: list[float]) -> float:
    """Smallest eigenvalue of Lanczos' tridiagonal matrix."""
    matrix = np.diag(diagonal) + np.diag(beside[1:], 1) + np.diag(beside[1:], -1)
    return float(np.linalg.eigvalsh(matrix)[0]) if diagonal else 1.0


class SymmetricProduct:
    """A x of symmetric matrices of one pattern, by the rows of their upper triangle with the
    diagonal first."""

    def __init__(
        self, indptr: Int[np.ndarray, " rows_and_one"], indices: Int[np.ndarray, " nnz"]
    ):
        import scipy.sparse as sp

        shape, nothing = (len(indptr) - 1,) * 2, np.zeros(len(indices))
        self._rows = sp.csr_matrix((nothing, indices, indptr), shape)
        self._columns = sp.csc_matrix((nothing, indices, indptr), shape)
        self._diagonal = indptr[:-1]

    def __call__(
        self, values: Float[np.ndarray, " nnz"], x: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        self._rows.data = self._columns.data = values
        return self._rows @ x + self._columns @ x - values[self._diagonal] * x
