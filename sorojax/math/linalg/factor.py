"""Direct solvers of one sparsity pattern on the host: the symbolic analysis, the last few
factors, and solutions by the factor of a neighbouring matrix.

The matrix of the last iterations of Newton's method, or of an adjoint, differs little from
one that is factored already: conjugate gradients preconditioned with that factor need two or
three back-substitutions, each a fraction of the cost of a factor. Both matrices must be
positive definite; where the new one is not, a search direction or the spectrum that the
iteration sees (Lanczos) shows it.

Reference: Saad, "Iterative Methods for Sparse Linear Systems", 2nd ed., 2003, chapters 6, 9.
"""

import functools
import hashlib
import os
import threading
import weakref
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Int

from sorojax.math.linalg import host_solvers
from sorojax.math.linalg.conjugate_gradient import Iterative, IterativeBackend, IterativeFactor

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
        self, values: Float[np.ndarray, " nnz"], x: Float[np.ndarray, "n *columns"]
    ) -> Float[np.ndarray, "n *columns"]:
        self._rows.data = self._columns.data = values
        return self._rows @ x + self._columns @ x - (values[self._diagonal] * x.T).T


# Solvers on the host: symbolic analysis, the last few factors, who owns them


_NUM_FACTORS = 4
Factor = (
    host_solvers.PardisoFactor
    | host_solvers.SuperLUFactor
    | host_solvers.BandedFactor
    | IterativeFactor
)


def available_solvers() -> dict[str, str]:
    """Direct solvers found on this machine, best first, with their versions."""
    import scipy

    mkl = host_solvers.version()
    found = {"pardiso": f"MKL {mkl}"} if mkl else {}
    return found | {"superlu": f"SciPy {scipy.__version__}"}


def _backend():
    asked = os.environ.get("SOROJAX_SOLVER", "")
    if asked not in ("", "pardiso", "superlu"):
        raise ValueError(
            f"SOROJAX_SOLVER is {asked!r}, need 'pardiso' or 'superlu'. Unset it for the "
            "best solver found."
        )
    if asked != "superlu" and host_solvers.library() is not None:
        return host_solvers.Pardiso
    if asked == "pardiso":
        raise ValueError("SOROJAX_SOLVER is 'pardiso': install sorojax[pardiso] first.")
    return host_solvers.SuperLU


class DirectSolver:
    """Host side of a system: symbolic analysis, or what an iterative solver knows of the
    pattern, and the last few numeric factors.

    A slot records the values that its factor belongs to, so that a factor is never
    used for other values than its own. Programs that run at the same time take turns.
    """

    def __init__(self, key: Any, backend: Any, indptr: np.ndarray, indices: np.ndarray):
        self._key, self._solver = np.array(key), backend
        self._pattern = (indptr, indices)
        self._product: SymmetricProduct | None = None
        self._slots: OrderedDict[int, tuple[np.ndarray, Factor]] = OrderedDict()
        self._turn = threading.RLock()
        self.num_factorisations = 0

    @property
    def name(self) -> str:
        return self._solver.name

    @property
    def recipe(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, Iterative | None]:
        """The fields as a tree: key, pattern by rows, and the iterative solver, if any."""
        iterates = isinstance(self._solver, IterativeBackend)
        return self._key, *self._pattern, self._solver.solver if iterates else None

    def factor(self, values: np.ndarray) -> Factor | None:
        """Factor of `values`, reused if a slot holds it; `None` if singular."""
        values = np.asarray(values)
        with self._turn:
            for slot, (owner, factor) in self._slots.items():
                if owner is values or _equal(owner, values):
                    self._slots.move_to_end(slot)
                    return factor
            if not np.all(np.isfinite(values)):
                return None
            slot = len(self._slots)
            if slot == _NUM_FACTORS:
                slot, _ = self._slots.popitem(last=False)
            factor = self._solver.factor(values, slot)
            self.num_factorisations += 1
            if factor is not None:
                self._slots[slot] = (values.copy(), factor)
            else:  # keep the slot's number in circulation
                self._slots[slot] = (np.full(1, np.nan), factor)  # type: ignore[arg-type]
                self._slots.move_to_end(slot, last=False)
            return factor

    def solve(self, values: np.ndarray, b: np.ndarray) -> np.ndarray:
        """x with A(values) x = b for any leading batch axes; NaN where singular."""
        values, b = np.asarray(values), np.asarray(b)
        lead = np.broadcast_shapes(values.shape[:-1], b.shape[:-1])
        with self._turn:
            if values.ndim == 1 or values.size == values.shape[-1]:
                return self._solve_many(values.reshape(-1), b, lead)
            values = np.broadcast_to(values, (*lead, values.shape[-1]))
            b = np.broadcast_to(b, (*lead, b.shape[-1]))
            x = np.empty(b.shape)
            for index in np.ndindex(*lead):
                x[index] = self._solve_many(values[index], b[index], ())
            return x

    def solve_near(self, values: np.ndarray, b: np.ndarray) -> np.ndarray:
        """x with A(values) x = b by the nearest factor that is there, refined, where that
        converges at once; by a new factor otherwise."""
        values, b = np.asarray(values), np.asarray(b)
        with self._turn:
            near = self._nearest(values)
            x = None if near is None else refined(near, self._product_with(values), b)
            return self.solve(values, b) if x is None else x

    def solve_by(
        self,
        factor: Factor,
        values: np.ndarray,
        b: np.ndarray,
        start: np.ndarray | None,
        tolerance: float,
    ) -> np.ndarray | None:
        """x with A(values) x = b by `factor` of a neighbour, see `refined`; `None` where the
        factor is gone or not near enough."""
        with self._turn:
            if not self.holds(factor):
                return None
            return refined(factor, self._product_with(values), b, start, tolerance)

    def product(
        self, values: np.ndarray, x: Float[np.ndarray, "n *columns"]
    ) -> Float[np.ndarray, "n *columns"]:
        """A(values) x."""
        with self._turn:
            return self._product_with(np.asarray(values))(x)

    def holds(self, factor: Factor) -> bool:
        """Whether `factor` still is one of the last few."""
        return any(factor is own for _, own in self._slots.values())

    def _product_with(self, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        if self._product is None:
            self._product = SymmetricProduct(*self._pattern)
        return functools.partial(self._product, values)

    def _nearest(self, values: np.ndarray) -> Factor | None:
        """The factor of a positive definite matrix whose values differ least, by some."""
        kept = [
            (np.max(np.abs(owner[::_FEW] - values[::_FEW]), initial=0.0), factor)
            for owner, factor in self._slots.values()
            if factor is not None
            and not isinstance(factor, IterativeFactor)
            and factor.negative_eigenvalues == 0
        ]
        return min(kept, key=lambda pair: pair[0], default=(0.0, None))[1]

    def solve_with_inertia(self, values: np.ndarray, b: np.ndarray) -> tuple:
        """x with A(values) x = b, and how many eigenvalues are negative: -1 and zeros where
        A is singular, so that a failed step stays finite."""
        with self._turn:
            factor = self.factor(values)
            if factor is None:
                return np.zeros(b.shape), np.int32(-1)
            return factor.solve(np.asarray(b)), np.int32(max(factor.negative_eigenvalues, 0))

    def _solve_many(self, values, b, lead) -> np.ndarray:
        factor = self.factor(values)
        if factor is None:
            return np.full((*lead, b.shape[-1]), np.nan)
        rhs = b.reshape(-1, b.shape[-1])
        x = factor.solve(rhs[0])[None] if len(rhs) == 1 else factor.solve(rhs)
        return np.broadcast_to(x.reshape(b.shape), (*lead, b.shape[-1]))


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether all entries are; most others differ in the first few."""
    return np.array_equal(a[:_GLANCE], b[:_GLANCE]) and np.array_equal(a, b)


_GLANCE, _FEW = 256, 16
_solvers: weakref.WeakValueDictionary[bytes, DirectSolver] = weakref.WeakValueDictionary()
_rebuilt: deque[DirectSolver] = deque(maxlen=2)  # by callbacks, which own nothing
_making = threading.Lock()


def direct_solver_of(key, rows, cols, owned: bool = False) -> DirectSolver:
    """The direct solver of a pattern."""

    def analysed(starts, cols):
        general = _backend()(starts, cols, _NUM_FACTORS)
        asked = os.environ.get("SOROJAX_SOLVER")
        order = None if asked else host_solvers.narrow_order(starts, cols)
        if order is None:
            return general
        return host_solvers.Banded(general, order, starts, cols, _NUM_FACTORS)

    return solver_of(key, rows, cols, analysed, owned)


def solver_of(
    key, rows, cols, make: Callable[[np.ndarray, np.ndarray], Any], owned: bool = False
) -> DirectSolver:
    """The solver of a system, made again where the system that it was made for is gone.

    Solvers live as long as an owner; without one the last two are kept.
    """
    name = np.ascontiguousarray(key).tobytes()
    with _making:
        solver = _solvers.get(name)
        if solver is None:
            rows, cols = np.asarray(rows).ravel(), np.asarray(cols).ravel()
            size = int(rows[-1]) + 1 if len(rows) else 0
            starts = np.searchsorted(rows, np.arange(size + 1))
            solver = DirectSolver(key, make(starts, cols), starts, cols)
            _solvers[name] = solver
            if not owned:
                _rebuilt.append(solver)
    return solver


def pattern_key(
    rows: np.ndarray, cols: np.ndarray, iterative: tuple[Any, ...] = ()
) -> Int[np.ndarray, " 2"]:
    """A digest of the pattern and of the solver that was asked for, which is that of
    `iterative` settings and arrays if there are any."""
    digest = hashlib.blake2b(digest_size=8)
    digest.update(repr(iterative[0]).encode() if iterative else _backend().name.encode())
    for array in (rows, cols, *iterative[1:]):
        digest.update(np.ascontiguousarray(array).tobytes())
    return np.frombuffer(digest.digest(), np.int32)
