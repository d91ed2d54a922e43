"""Solutions of a linear system by the factor of a neighbouring one.

The matrix of an adjoint belongs to the converged state, the last factor of Newton's method
to the state before: near enough that two or three back-substitutions give every digit that a
factor of its own would, at a fraction of its price.

Reference: Higham, "Accuracy and Stability of Numerical Algorithms", 2nd ed., 2002, chapter 12.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

_MOST = 3  # corrections: beyond, a new factor is cheaper
_FAST = 0.1  # largest share of the error that a correction may leave
_EXACT = 1e-12  # error of the solution that is none, relative to its largest entry


class Solves(Protocol):
    """A numeric factor."""

    def solve(self, b: np.ndarray) -> np.ndarray: ...


def refined(
    factor: Solves, product: Callable[[np.ndarray], np.ndarray], b: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"] | None:
    """x with product(x) = b by corrections with a factor of a matrix near to that of
    `product`; `None` where they do not converge at once."""
    x = factor.solve(b)
    before = np.max(np.abs(x), initial=0.0)
    for _ in range(_MOST):
        correction = factor.solve(b - product(x))
        x = x + correction
        size, largest = np.max(np.abs(correction), initial=0.0), np.max(np.abs(x), initial=0.0)
        if size * size <= _EXACT * largest * before:  # what the next one would be
            return x
        if not size <= _FAST * before:
            return None
        before = size
    return None


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
