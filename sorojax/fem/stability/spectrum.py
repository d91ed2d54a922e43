"""Extreme eigenvalues of the tangent of a problem, by Lanczos with its direct factor.

Reference: Ericsson and Ruhe, "The spectral transformation Lanczos method for the
numerical solution of large sparse generalized symmetric eigenvalue problems",
Mathematics of Computation 35, 1980.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.math.linalg import sparse

_DENSE = 40  # below this many unknowns Lanczos has no room


class Pencil(NamedTuple):
    """A symmetric matrix and its factor, with the unknowns that are free."""

    system: sparse.SparseSymmetric
    values: Float[np.ndarray, " nnz"]
    free: np.ndarray
    factor: sparse.Factor
    shift: float

    @property
    def negative_eigenvalues(self) -> int:
        return self.factor.negative_eigenvalues


def pencil(
    system: sparse.SparseSymmetric,
    values: Float[Array, " nnz"],
    known: np.ndarray,
    mass: Float[Array, " nnz"] | None = None,
) -> Pencil:
    """Factor K, or K - sigma M with a tiny sigma where K is singular to rounding."""
    diagonal = np.asarray(system.rows == system.cols).astype(float)
    metric = diagonal if mass is None else np.asarray(mass)
    fixed = jnp.asarray(known)
    host = np.asarray(values)
    scale = np.abs(host * diagonal).max() / np.abs(metric * diagonal).max()
    for shift in (0.0, -1e-12 * scale, -1e-9 * scale):
        matrix = sparse.fix(system, jnp.asarray(host - shift * metric), fixed)
        factor = system.solver.factor(np.asarray(matrix))
        if factor is not None:
            return Pencil(system, host, np.flatnonzero(~known), factor, shift)
    raise ValueError(
        "eigenvalues: the tangent is singular or not finite, need a state at which it can be "
        "factored. Check the supports and the displacement."
    )


def solve(pencil: Pencil, b: np.ndarray) -> np.ndarray:
    """(K - shift M)^-1 b on the free unknowns."""
    full = np.zeros(pencil.system.size)
    full[pencil.free] = np.ravel(b)
    return pencil.factor.solve(full)[pencil.free]


def free_matrix(pencil: Pencil, values: np.ndarray):
    """Values in the pattern as a SciPy matrix over the free unknowns."""
    import scipy.sparse as sp

    size = pencil.system.size
    rows, cols = np.asarray(pencil.system.rows), np.asarray(pencil.system.cols)
    off = rows != cols
    values = np.asarray(values)
    matrix = sp.csr_matrix(
        (
            np.concatenate([values, values[off]]),
            (np.concatenate([rows, cols[off]]), np.concatenate([cols, rows[off]])),
        ),
        (size, size),
    )
    return matrix[pencil.free][:, pencil.free]


def lowest(
    pencil: Pencil, count: int, mass: Float[Array, " nnz"] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The `count` lowest eigenvalues of K phi = mu M phi, rising, and vectors (count, dofs)
    with phi' M phi = 1; M is the identity when omitted.

    Shift and invert finds those nearest zero. The inertia of K says how many of them are
    negative, so that none below is missed.
    """
    stiffness = free_matrix(pencil, pencil.values)
    metric = None if mass is None else free_matrix(pencil, np.asarray(mass))
    negative = max(0, pencil.negative_eigenvalues)
    wanted = count + negative
    while True:
        values, vectors = _near_zero(pencil, stiffness, metric, wanted)
        tolerance = abs(pencil.shift)
        if np.sum(values < tolerance) >= negative or len(values) == len(pencil.free):
            order = np.argsort(values)[:count]
            return values[order], _embed(pencil, vectors[:, order])
        wanted = 2 * wanted


def _near_zero(pencil: Pencil, stiffness, metric, count: int):
    import scipy.linalg
    import scipy.sparse.linalg as spla

    size = len(pencil.free)
    if count >= size - 1 or size <= _DENSE:
        metric = None if metric is None else metric.toarray()
        values, vectors = scipy.linalg.eigh(stiffness.toarray(), metric)
        nearest = np.argsort(np.abs(values))[:count]
        return values[nearest], vectors[:, nearest]
    inverse = spla.LinearOperator((size, size), matvec=lambda b: solve(pencil, b), dtype=float)
    start = np.random.default_rng(0).standard_normal(size)
    return spla.eigsh(
        stiffness,
        k=count,
        M=metric,
        sigma=pencil.shift,
        OPinv=inverse,
        v0=start,
        ncv=min(size, max(2 * count + 1, 20)),
    )


def lowest_of_pair(pencil: Pencil, other: np.ndarray, count: int):
    """The `count` most negative eigenvalues of `other` phi = nu K phi for a positive
    definite K, and their vectors (count, dofs)."""
    import scipy.linalg
    import scipy.sparse.linalg as spla

    stiffness, other = free_matrix(pencil, pencil.values), free_matrix(pencil, other)
    size = len(pencil.free)
    if count >= size - 1 or size <= _DENSE:
        pair = other.toarray(), stiffness.toarray()  # type: ignore[attr-defined]
        values, vectors = scipy.linalg.eigh(*pair)
    else:
        inverse = spla.LinearOperator(
            (size, size), matvec=lambda b: solve(pencil, b), dtype=float
        )
        start = np.random.default_rng(0).standard_normal(size)
        values, vectors = spla.eigsh(
            other,
            k=count,
            M=stiffness,
            Minv=inverse,
            which="SA",
            v0=start,
            ncv=min(size, max(4 * count, 40)),
        )
    order = np.argsort(values)[:count]
    return values[order], _embed(pencil, vectors[:, order])


def _embed(pencil: Pencil, vectors: np.ndarray) -> np.ndarray:
    full = np.zeros((vectors.shape[1], pencil.system.size))
    full[:, pencil.free] = vectors.T
    return full
