"""Inertia and damping of a step by products on the host.

A product there takes a quarter of the time of the compiled one, which scatters every entry of
the pattern twice.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from sorojax.math import sparse

Vector = Float[np.ndarray, " dofs"]
Values = Float[np.ndarray, " nnz"]


class Numbers(NamedTuple):
    """What inertia and damping of a step depend on.

    Attributes:
        matrix: Of both [N/m].
        damping: C [N s/m], `None` without.
        dead: Forces that are the same in every state [N].
        lead, drive: See `dynamics_step.Step`.
        origin: Displacement at the start [m].
        rate: Velocity over displacement in the step [1/s].
        share: How far within the step forces act.
    """

    matrix: Array
    damping: Array | None
    dead: Array
    lead: Array
    drive: Array
    origin: Array
    rate: Array
    share: Array


class HostInertia:
    """Of the steps of a motion, one after another."""

    def __init__(self, system: sparse.SparseSymmetric, mass: Values):
        self._mass = _BothTriangles(system)
        self._matrix, self._damping = self._mass.another(), self._mass.another()
        self._mass.fill(mass)
        self.origin = self._pull = self._drag = np.zeros(0)
        self._damped, self._rate, self._share = False, 0.0, 1.0

    def begin(self, of: Numbers) -> None:
        """Go on with another step."""
        lead, drive, self.origin = (np.asarray(x) for x in (of.lead, of.drive, of.origin))
        self._matrix.fill(np.asarray(of.matrix))
        self._pull = np.asarray(of.dead) + self._mass @ drive.ravel()
        self._damped = of.damping is not None
        if of.damping is not None:
            self._damping.fill(np.asarray(of.damping))
            self._drag = self._damping @ lead.ravel()
            self._pull -= self._drag
            self._rate, self._share = float(of.rate), float(of.share)

    def force(self, u: Float[np.ndarray, "nodes dim"]) -> Vector:
        """On the body at displacement `u`, with dead loads [N]."""
        return self._pull - self._matrix @ (u - self.origin).ravel()

    def taken(self, u: Float[np.ndarray, "nodes dim"]) -> float:
        """What damping takes in a step whose forces act at `u` [J]."""
        if not self._damped:
            return 0.0
        moved = (u - self.origin).ravel()
        drag = self._rate * (self._damping @ moved) + self._drag
        return float(drag @ moved) / self._share


class _BothTriangles:
    """A symmetric matrix in the pattern of `system` with both its triangles."""

    def __init__(self, system: sparse.SparseSymmetric):
        from scipy.sparse import csr_array

        rows, cols = np.asarray(system.rows), np.asarray(system.cols)
        off = np.flatnonzero(rows != cols)
        number = np.concatenate([np.arange(len(rows)), off])
        at = np.concatenate([rows, cols[off]]), np.concatenate([cols, rows[off]])
        order = csr_array((number + 1.0, at), (system.size, system.size))
        self._number = (order.data - 1).astype(np.int64)
        self._csr, self._values = order, None

    def another(self) -> "_BothTriangles":
        """One more matrix of the same pattern."""
        made = object.__new__(_BothTriangles)
        made._number, made._csr, made._values = self._number, self._csr.copy(), None
        return made

    def fill(self, values: Values) -> None:
        if self._values is None or not np.array_equal(values, self._values):
            self._values, self._csr.data = values.copy(), values[self._number]

    def __matmul__(self, x: Vector) -> Vector:
        return self._csr @ x
