"""Direct solvers of sparse symmetric systems on the host: MKL Pardiso, SciPy's SuperLU, and
banded Cholesky.

oneMKL is closed source but redistributable and optional (the extra `pardiso`). The library is
found in the file list of the `mkl` package, loaded once and held to one thread; phases are
called one by one so that the symbolic analysis is reused. A sparse factor of a few thousand
unknowns spends most of its time on bookkeeping: small or slender bodies in the plane, in an
order from end to end, are one banded call of LAPACK.

References:
    oneMKL Developer Reference, "oneMKL PARDISO - Parallel Direct Sparse Solver Interface".
    Anderson et al., "LAPACK Users' Guide", 3rd ed., 1999: dpbtrf, dpbtrs.
    Gibbs, Poole, Stockmeyer, "An algorithm for reducing the bandwidth and profile of a sparse
    matrix", SIAM J. Numer. Anal. 13, 1976: levels from the far end of a body.
"""

import ctypes
import functools
import importlib.metadata
import sys
import warnings
from typing import Any

import numpy as np
from jaxtyping import Float, Int

_SEQUENTIAL = 1
_ANALYSE, _FACTOR, _SOLVE, _RELEASE_ALL = 11, 22, 33, -1
_POSITIVE_DEFINITE, _INDEFINITE = 2, -2
_NOT_POSITIVE_DEFINITE = -4


@functools.cache
def library() -> ctypes.CDLL | None:
    """The MKL runtime, or `None` where the `mkl` package is not installed."""
    try:
        files = importlib.metadata.files("mkl") or []
    except importlib.metadata.PackageNotFoundError:
        return None
    for file in files:
        if "mkl_rt" in file.name and not file.name.endswith(".lib"):
            try:
                lib = ctypes.CDLL(str(file.locate()))
            except OSError:
                continue
            lib.MKL_Set_Threading_Layer(ctypes.c_int(_SEQUENTIAL))
            return lib
    return None


def version() -> str | None:
    """Version of the installed MKL, or `None`."""
    return importlib.metadata.version("mkl") if library() is not None else None


def _number(value: int):
    return ctypes.byref(ctypes.c_int(value))


def _pointer(array: np.ndarray | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(0 if array is None else array.ctypes.data)


class _Phases:
    """One analysed pattern for one matrix type, with several numeric factors."""

    def __init__(self, indptr, indices, matrix_type: int, num_factors: int):
        self.lib = library()
        self.size = len(indptr) - 1
        self.indptr = np.ascontiguousarray(indptr, np.int32)
        self.indices = np.ascontiguousarray(indices, np.int32)
        self.matrix_type, self.num_factors = matrix_type, num_factors
        self.memory = np.zeros(64, np.int64)
        self.params = np.zeros(64, np.int32)
        # user values; nested dissection; pivot perturbation 1e-8 (LDL'); Bunch-Kaufman
        # pivoting; zero-based indices. Entry 7 = 0 refines only where pivots were
        # perturbed; any other value refines every solve.
        for entry, value in ((0, 1), (1, 2), (7, 0), (9, 8), (20, 1), (34, 1)):
            self.params[entry] = value
        self.pattern_values = np.ones(len(self.indices))
        self._memory, self._params = _pointer(self.memory), _pointer(self.params)
        self._pattern = _pointer(self.indptr), _pointer(self.indices)
        self._count, self._kind = _number(num_factors), _number(matrix_type)
        self._size, self._quiet = _number(self.size), _number(0)
        self.call(_ANALYSE, 0, self.pattern_values)

    def call(self, phase: int, slot: int, values, b=None, x=None, num_rhs: int = 1) -> int:
        error = ctypes.c_int(0)
        assert self.lib is not None
        self.lib.pardiso(
            self._memory,
            self._count,
            _number(slot + 1),
            self._kind,
            _number(phase),
            self._size,
            _pointer(values),
            *self._pattern,
            None,
            _number(num_rhs),
            self._params,
            self._quiet,
            _pointer(b),
            _pointer(x),
            ctypes.byref(error),
        )
        return error.value

    def __del__(self):
        if sys.is_finalizing() or getattr(self, "lib", None) is None:
            return
        if self.memory.any():
            self.call(_RELEASE_ALL, 0, self.pattern_values)


class PardisoFactor:
    """A numeric factor held in one slot of the analysed pattern."""

    def __init__(self, phases: _Phases, slot: int, negative_eigenvalues: int):
        self._phases, self._slot = phases, slot
        self.negative_eigenvalues = negative_eigenvalues

    def solve(self, b: np.ndarray) -> np.ndarray:
        b = np.ascontiguousarray(b, np.float64)
        x = np.empty_like(b)
        num_rhs = 1 if b.ndim == 1 else b.shape[0]
        error = self._phases.call(
            _SOLVE, self._slot, self._phases.pattern_values, b, x, num_rhs
        )
        if error:
            raise RuntimeError(f"linear solve: Pardiso reports error {error} in the solve.")
        return x


class Pardiso:
    """LL' while the matrix is positive definite, else LDL' with its inertia."""

    name = "pardiso"

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, num_factors: int):
        self._pattern = (indptr, indices, num_factors)
        self._phases: dict[int, _Phases] = {}

    def factor(self, values: np.ndarray, slot: int) -> PardisoFactor | None:
        """Factor in `slot`, or `None` if the matrix is singular to working precision."""
        values = np.ascontiguousarray(values, np.float64)
        if self._get(_POSITIVE_DEFINITE).call(_FACTOR, slot, values) == 0:
            return PardisoFactor(self._get(_POSITIVE_DEFINITE), slot, 0)
        phases = self._get(_INDEFINITE)
        if phases.call(_FACTOR, slot, values) != 0 or phases.params[13] > 0:
            return None
        return PardisoFactor(phases, slot, int(phases.params[22]))

    def _get(self, matrix_type: int) -> _Phases:
        if matrix_type not in self._phases:
            indptr, indices, count = self._pattern
            self._phases[matrix_type] = _Phases(indptr, indices, matrix_type, count)
        return self._phases[matrix_type]


# The fall-back direct solver: SciPy's SuperLU in symmetric mode (BSD)


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


# Cholesky of matrices with a narrow band: small or slender bodies in the plane


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
    if (mkl := library()) is None:
        from scipy.linalg import get_lapack_funcs

        dpbtrf = get_lapack_funcs("pbtrf", (lower,))
        found, info = dpbtrf(lower.T, lower=1, overwrite_ab=1)
        if not np.shares_memory(found, lower):
            lower[:] = found.T
        return info == 0
    info = ctypes.c_int(0)
    mkl.dpbtrf(
        b"L",
        _number(size),
        _number(width - 1),
        _pointer(lower),
        _number(width),
        ctypes.byref(info),
    )
    return info.value == 0


def _solve(lower: Float[np.ndarray, "size band"], b: np.ndarray) -> None:
    """x of L L' x = b in the place of b, for any leading axes."""
    size, width = lower.shape
    rows = b.reshape(-1, size)
    if (mkl := library()) is None:
        from scipy.linalg import get_lapack_funcs

        dpbtrs = get_lapack_funcs("pbtrs", (lower,))
        rows[:] = dpbtrs(lower.T, rows.T, lower=1)[0].T
        return
    mkl.dpbtrs(
        b"L",
        _number(size),
        _number(width - 1),
        _number(len(rows)),
        _pointer(lower),
        _number(width),
        _pointer(rows),
        _number(size),
        ctypes.byref(ctypes.c_int(0)),
    )
