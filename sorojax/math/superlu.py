"""The fall-back direct solver: SciPy's SuperLU in symmetric mode (BSD)."""

import warnings
from typing import Any

import numpy as np


class SuperLUFactor:
    """A numeric LU factor."""

    def __init__(self, lu: Any):
        self._lu = lu
        diagonal_pivots = np.array_equal(lu.perm_r, lu.perm_c)
        self.negative_eigenvalues = int(np.sum(lu.U.diagonal() < 0)) if diagonal_pivots else -1

    def solve(self, b: np.ndarray) -> np.ndarray:
        b = np.asarray(b, np.float64)
        return self._lu.solve(b) if b.ndim == 1 else self._lu.solve(b.T).T.copy()


class SuperLU:
    """Symmetric-mode LU of the full matrix; ordering is repeated at every factor."""

    name = "superlu"

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, num_factors: int):
        import scipy.sparse as sp

        size, nnz = len(indptr) - 1, len(indices)
        upper = sp.csr_matrix((np.arange(1.0, nnz + 1), indices, indptr), (size, size))
        full = (upper + sp.triu(upper, 1).T).tocsc()
        full.sort_indices()
        self._shape, self._indices, self._indptr = full.shape, full.indices, full.indptr
        self._source = full.data.astype(np.int64) - 1

    def factor(self, values: np.ndarray, slot: int) -> SuperLUFactor | None:
        """Factor, or `None` if the matrix is singular to working precision."""
        import scipy.sparse as sp
        import scipy.sparse.linalg as spla

        matrix = sp.csc_matrix(
            (np.asarray(values, np.float64)[self._source], self._indices, self._indptr),
            self._shape,
        )
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                lu = spla.splu(
                    matrix,
                    permc_spec="MMD_AT_PLUS_A",
                    diag_pivot_thresh=1e-3,
                    options={"SymmetricMode": True},
                )
        except RuntimeError:  # "Factor is exactly singular"
            return None
        return SuperLUFactor(lu)
