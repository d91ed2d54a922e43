"""Cholesky of matrices with a narrow band: small or slender bodies in the plane.

A sparse factor of a few thousand unknowns spends most of its time on its own bookkeeping. In
an order that follows the body from end to end it is one call of LAPACK.

References:
    Anderson et al., "LAPACK Users' Guide", 3rd ed., 1999: dpbtrf, dpbtrs.
    Gibbs, Poole, Stockmeyer, "An algorithm for reducing the bandwidth and profile of a sparse
    matrix", SIAM J. Numer. Anal. 13, 1976: levels from the far end of a body.
"""

import ctypes
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sorojax.math import pardiso

#: Widest band, and most unknowns, for which a sparse factor takes longer.
_WIDEST, _MOST = 64, 20_000
_TURNS = 3  # from one end of the body to the other


class BandedFactor:
    """L of A = L L' in one slot, in the order of `Banded`."""

    negative_eigenvalues = 0

    def __init__(self, lower: Float[np.ndarray, "size band"], order: Int[np.ndarray, " size"]):
        self._lower, self._order = lower, order

    def solve(self, b: np.ndarray) -> np.ndarray:
        found = np.ascontiguousarray(b[..., self._order], np.float64)
        _solve(self._lower, found)
        x = np.empty_like(found)
        x[..., self._order] = found
        return x


class Banded:
    """Factors of positive definite matrices of one pattern; all others go to `general`."""

    def __init__(self, general: Any, order: np.ndarray, indptr, indices, num_factors: int):
        self._general, self._order, self.name = general, order, general.name
        place = np.empty(len(order), np.int64)
        place[order] = np.arange(len(order))
        rows = place[np.repeat(np.arange(len(order)), np.diff(indptr))]
        cols = place[indices]
        first, away = np.minimum(rows, cols), np.abs(rows - cols)
        self._shape = len(order), int(away.max(initial=0)) + 1
        self._slots = first * self._shape[1] + away
        self._memory: list[np.ndarray | None] = [None] * num_factors

    def factor(self, values: np.ndarray, slot: int):
        """Factor in `slot`, or `None` if the matrix is singular to working precision."""
        lower = self._memory[slot]
        if lower is None:
            lower = self._memory[slot] = np.empty(self._shape)
        lower.fill(0.0)
        lower.reshape(-1)[self._slots] = values
        if _factor(lower):
            return BandedFactor(lower, self._order)
        return self._general.factor(values, slot)


def narrow_order(
    indptr: Int[np.ndarray, " rows"], indices: Int[np.ndarray, " nnz"]
) -> Int[np.ndarray, " size"] | None:
    """An order of the unknowns in which the pattern, an upper triangle by rows, has a narrow
    band; `None` if there is no such order, or too many unknowns."""
    size = len(indptr) - 1
    if not 0 < size <= _MOST:
        return None
    rows, cols = np.repeat(np.arange(size), np.diff(indptr)), np.asarray(indices)
    both = np.concatenate([rows, cols]), np.concatenate([cols, rows])
    order = np.argsort(both[0], kind="stable")
    starts = np.searchsorted(both[0][order], np.arange(size + 1))
    neighbours = both[1][order]
    ends, best = np.array([0]), None
    for _ in range(_TURNS):
        found, ends = _followed(starts, neighbours, ends)
        if found is None:
            return None
        place = np.empty(size, np.int64)
        place[found] = np.arange(size)
        width = int(np.abs(place[rows] - place[cols]).max(initial=0)) + 1
        if best is None or width < best[0]:
            best = width, found
    assert best is not None
    return best[1] if best[0] <= _WIDEST else None


def _followed(starts, neighbours, ends: np.ndarray):
    """All unknowns level by level from `ends`, each after its first neighbour in the level
    before, and the last level; `None` for a body in parts or levels too wide."""
    size = len(starts) - 1
    seen = np.zeros(size, bool)
    level, order, count = ends, [ends], len(ends)
    seen[ends] = True
    while count < size:
        if not len(level) or len(level) > 2 * _WIDEST:
            return None, ends
        spans = [neighbours[starts[k] : starts[k + 1]] for k in level]
        near = np.concatenate(spans)
        near = near[~seen[near]]
        found, first = np.unique(near, return_index=True)
        level = found[np.argsort(first, kind="stable")]
        seen[level] = True
        order.append(level)
        count += len(level)
    return np.concatenate(order), level


def _factor(lower: Float[np.ndarray, "size band"]) -> bool:
    """L in the place of A, diagonal by diagonal of each row; whether A is positive definite."""
    size, width = lower.shape
    if (mkl := pardiso.library()) is None:
        from scipy.linalg import get_lapack_funcs

        dpbtrf = get_lapack_funcs("pbtrf", (lower,))
        found, info = dpbtrf(lower.T, lower=1, overwrite_ab=1)
        if not np.shares_memory(found, lower):
            lower[:] = found.T
        return info == 0
    info = ctypes.c_int(0)
    mkl.dpbtrf(
        b"L", _number(size), _number(width - 1), _pointer(lower), _number(width),
        ctypes.byref(info),
    )  # fmt: skip
    return info.value == 0


def _solve(lower: Float[np.ndarray, "size band"], b: np.ndarray) -> None:
    """x of L L' x = b in the place of b, for any leading axes."""
    size, width = lower.shape
    rows = b.reshape(-1, size)
    if (mkl := pardiso.library()) is None:
        from scipy.linalg import get_lapack_funcs

        dpbtrs = get_lapack_funcs("pbtrs", (lower,))
        rows[:] = dpbtrs(lower.T, rows.T, lower=1)[0].T
        return
    mkl.dpbtrs(
        b"L", _number(size), _number(width - 1), _number(len(rows)), _pointer(lower),
        _number(width), _pointer(rows), _number(size), ctypes.byref(ctypes.c_int(0)),
    )  # fmt: skip


def _number(value: int):
    return ctypes.byref(ctypes.c_int(value))


def _pointer(array: np.ndarray):
    return ctypes.c_void_p(array.ctypes.data)
