"""Sparse Cholesky and LDL' through the MKL Pardiso of the `mkl` package.

oneMKL is closed source but redistributable and optional (the extra `pardiso`).
The library is found in the package's own file list, loaded once and held to one
thread; phases are called one by one so that the symbolic analysis is reused.

Reference: oneMKL Developer Reference, "oneMKL PARDISO - Parallel Direct Sparse
Solver Interface".
"""

import ctypes
import functools
import importlib.metadata
import sys

import numpy as np

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
            self._memory, self._count, _number(slot + 1), self._kind, _number(phase),
            self._size, _pointer(values), *self._pattern, None, _number(num_rhs),
            self._params, self._quiet, _pointer(b), _pointer(x), ctypes.byref(error),
        )  # fmt: skip
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
