"""Newton's method for one time step, on the host.

A factor is kept from iteration to iteration and from step to step as long as each solve
with it takes the residual down well: a residual and a back-substitution cost a fraction of
a tangent and its factor. A step that raises the energy is shortened.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.fem import assemble as asm
from sorojax.fem.linear import Prepared, linearise, unbalanced
from sorojax.fem.newton import Newton, relative_size, safe_fraction
from sorojax.fem.problem import Problem, unsupported
from sorojax.math import sparse

#: A kept factor is given up where the residual keeps more than this share in an iteration.
_SLOW = 0.2
_SLOPE_TURNED, _MAX_SHORTENINGS = 0.5, 12


class Kept(NamedTuple):
    """A tangent with its supports applied, whose factor goes on being used."""

    matrix: np.ndarray
    largest: float


class Balance(NamedTuple):
    """Unbalanced force [N] at a state, its largest free entry, the largest force that it is
    judged by, the length that rounding is judged by and the smallest J / J_before."""

    residual: Float[Array, " dofs"]
    norm: Float[Array, ""]
    reference: Float[Array, ""]
    length: Float[Array, ""]
    volume_ratio: Float[Array, ""]


class Found(NamedTuple):
    """State that a step converged to, unless `reason` says why not."""

    u: np.ndarray
    residual: np.ndarray
    iterations: int
    factorisations: int
    kept: Kept | None
    reason: str


def balance(problem: Problem, prepared: Prepared, u, before) -> Balance:
    """Unbalanced force at `u`."""
    return _balance(unsupported(problem), prepared, u, before)


@eqx.filter_jit
def _balance(problem: Problem, prepared: Prepared, u, before) -> Balance:
    body = asm.assemble(
        problem.space, prepared.geometry, problem.material, problem.kinematics, u, before
    )
    return Balance(*unbalanced(problem, prepared, body.force, u), body.volume_ratio)


class StepSolver:
    """Solves the steps of one motion; remembers the last tangent."""

    def __init__(self, prepared: Prepared, system: sparse.SparseSymmetric, newton: Newton):
        self.prepared, self.newton = prepared, newton
        self.system, self.solver = system, system.solver
        self.known = np.asarray(prepared.known)
        self.kept: Kept | None = None

    def solve(self, problem: Problem, guess: np.ndarray, held: np.ndarray) -> Found:
        """Equilibrium near `guess`, where known unknowns are `held`."""
        settings = self.newton
        u, before, fresh, size = guess, guess, 0, np.inf
        now = self._balance(problem, u, u)
        last, refactor, iterations = np.inf, self.kept is None, 0
        while True:
            move = np.where(self.known, held - u.ravel(), 0.0)
            move[np.abs(move) <= 1e-12 * np.abs(held).max(initial=0.0)] = 0.0
            moves = bool(np.any(move))
            norm, reference = float(now.norm), float(now.reference)
            if not (np.isfinite(norm) and float(now.volume_ratio) > 0):
                return self._failed(u, iterations, fresh, "an element inverts")
            largest = self.kept.largest if self.kept else 0.0
            rounding = 2 * np.finfo(float).eps * largest * float(now.length)
            small = norm <= settings.residual_tolerance * reference or norm <= rounding
            if small and size < settings.step_tolerance and not moves:
                residual = np.asarray(now.residual)
                return Found(u, residual, iterations, fresh, self.kept, "")
            if fresh >= settings.max_iterations or iterations >= 6 * settings.max_iterations:
                reason = f"no convergence in {iterations} Newton iterations"
                return self._failed(u, iterations, fresh, reason)
            slow = iterations > 0 and norm > _SLOW * last and not small
            if refactor or slow or moves:
                if not self._renew(problem, u, before):
                    return self._failed(u, iterations, fresh, "the tangent is singular")
                refactor, fresh = False, fresh + 1
            last, iterations = norm, iterations + 1
            rhs = -np.asarray(now.residual)
            if moves:
                rhs = rhs - np.asarray(self._product(problem, u, before, move))
            rhs[self.known] = 0.0
            factor = self.solver.factor(self.kept.matrix)  # type: ignore[union-attr]
            if factor is None:
                return self._failed(u, iterations, fresh, "the tangent is singular")
            du = (factor.solve(rhs) + move).reshape(u.shape)
            slope = None if moves else -float(rhs @ du.ravel())
            before = u
            u, now, size = self._advance(problem, u, du, slope)

    def _renew(self, problem: Problem, u, before) -> bool:
        found = linearise(problem, self.prepared, jnp.asarray(u), jnp.asarray(before))
        self._values = found.values
        matrix = np.asarray(_fixed(self.system, found.values, self.prepared.known))
        return self.keep(matrix)

    def keep(self, matrix: np.ndarray) -> bool:
        """Go on with the factor of `matrix`; False if it is not finite."""
        self.kept = Kept(matrix, float(np.abs(matrix).max()))
        return bool(np.isfinite(self.kept.largest))

    def _product(self, problem, u, before, move):
        return sparse.product(self.system, self._values, jnp.asarray(move))

    def _balance(self, problem: Problem, u, before) -> Balance:
        return balance(problem, self.prepared, jnp.asarray(u), jnp.asarray(before))

    def _advance(self, problem: Problem, u, du, slope):
        """The state after a step, shortened where a cell would collapse or the energy has
        turned at its end."""
        new = u + du
        now = self._balance(problem, new, u)
        if not float(now.volume_ratio) > 0.1:
            du = safe_fraction(problem, self.prepared, u, du) * du
            new = u + du
            now = self._balance(problem, new, u)
        size = relative_size(self.prepared, new, du)
        if slope is None or not slope < 0:
            return new, now, size
        share = 1.0
        for _ in range(_MAX_SHORTENINGS):
            end = float(np.where(self.known, 0.0, np.asarray(now.residual)) @ du.ravel())
            if not end > _SLOPE_TURNED * -slope:
                break
            share *= slope / (slope - end)
            new = u + share * du
            now = self._balance(problem, new, u)
        return new, now, share * size

    def _failed(self, u, iterations: int, fresh: int, reason: str) -> Found:
        self.kept = None
        return Found(u, np.zeros(u.size), iterations, fresh, None, reason)


_fixed = eqx.filter_jit(sparse.fix)
