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
        damping: C [N s/m], where it is not the same in every step.
        lead, drive: See `dynamics_step.Step`.
        origin: Displacement at the start [m].
        mass_rate, rate: What mass and damping are multiplied with [1/s^2, 1/s].
        share: How far within the step forces act.
    """

    damping: Array | None
    lead: Array
    drive: Array
    origin: Array
    mass_rate: Array
    rate: Array
    share: Array


class HostInertia:
    """Of the steps of a motion, one after another.

    Attributes:
        origin: Displacement where the step begins [m].
        share: How far within the step forces act.
        values: Stiffness of inertia and damping [N/m].
    """

    def __init__(self, system: sparse.SparseSymmetric, mass: Values, damping: Values | None):
        self._mass = _BothTriangles(system)
        self._matrix, self._damping = self._mass.another(), self._mass.another()
        self._mass.fill(mass)
        self._damped = damping is not None
        if damping is not None:
            self._damping.fill(damping)
        self.origin = self.values = self._pull = self._drag = np.zeros(0)
        self._rates, self.share = (0.0, 0.0), 1.0

    def begin(self, of: Numbers) -> None:
        """Go on with another step."""
        lead, drive, self.origin = (np.asarray(x) for x in (of.lead, of.drive, of.origin))
        rates, self.share = (float(of.mass_rate), float(of.rate)), float(of.share)
        if of.damping is not None:
            self._damped = True
            self._damping.fill(np.asarray(of.damping))
        if rates != self._rates or of.damping is not None:
            self._rates = rates
            with np.errstate(invalid="ignore"):  # a step cut to nothing fails for its matrix
                self.values = rates[0] * self._mass.values
                if self._damped:
                    self.values = self.values + rates[1] * self._damping.values
            self._matrix.fill(self.values)
        self._pull = self._mass @ drive.ravel()
        if self._damped:
            self._drag = self._damping @ lead.ravel()
            self._pull -= self._drag

    def force(self, u: Float[np.ndarray, "nodes dim"]) -> Vector:
        """On the body at displacement `u` [N]."""
        return self._pull - self._matrix @ (u - self.origin).ravel()

    def taken(self, u: Float[np.ndarray, "nodes dim"]) -> float:
        """What damping takes in a step whose forces act at `u` [J]."""
        if not self._damped:
            return 0.0
        moved = (u - self.origin).ravel()
        drag = self._rates[1] * (self._damping @ moved) + self._drag
        return float(drag @ moved) / self.share


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
        self._csr, self.values = order, np.zeros(0)

    def another(self) -> "_BothTriangles":
        """One more matrix of the same pattern."""
        made = object.__new__(_BothTriangles)
        made._number, made._csr, made.values = self._number, self._csr.copy(), np.zeros(0)
        return made

    def fill(self, values: Values) -> None:
        self.values, self._csr.data = values, values[self._number]

    def __matmul__(self, x: Vector) -> Vector:
        return self._csr @ x
