"""The stable state that a body falls into when the equilibrium that it had is gone.

Designs under large loads reach their buckling load while they are optimised. Beyond it
Newton's method has nothing near to converge to, and a load path ends at a limit point; the
body snaps. Here its energy falls, step by step, by Newton's method with a shift that keeps
the tangent positive definite.

Reference: Nocedal, Wright, "Numerical Optimization", 2nd ed., 2006, sections 3.2 and 3.4.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.fem import Problem
from sorojax.fem.energy_form import potential_energy
from sorojax.fem.linear import Prepared, constrain, linearise, prepare
from sorojax.fem.newton import safe_fraction
from sorojax.math.sparse import SparseSymmetric

_FIRST, _GROWTH, _SHRINK = 1e-3, 4.0, 0.25  # of the shift, relative to the diagonal at rest
_DESCENT = 1e-4  # share of the decrease by the slope that a step has to bring
_HALVINGS = 12
_SAFE = 0.9  # what `safe_fraction` returns where no cell comes near to inverting


def settled(
    problem: Problem, u: Float[Any, "nodes dim"], *, steps: int = 100, tolerance: float = 1e-6
) -> tuple[Float[np.ndarray, "nodes dim"], bool]:
    """A state of least energy downhill of the displacement `u` [m], and whether it was
    reached and is stable.

    All loads act in full. For concrete numbers; the answer is a start for `fem.solve`.

    Args:
        problem: Whose supports hold at `u`.
        u: Where to begin.
        steps: Most factorisations.
        tolerance: Largest unbalanced force over the largest load or reaction.
    """
    prepared, u = prepare(problem), np.asarray(u)
    still = jnp.zeros(u.size)
    size = _diagonal(problem.space.system, _linearised(problem, prepared, 0 * u).values)
    shift, state = 0.0, _linearised(problem, prepared, u)
    energy = float(potential_energy(problem, jnp.asarray(u)))
    for _ in range(steps):
        done = float(state.residual_norm) <= tolerance * float(state.reference)
        values = state.values + (0.0 if done else shift) * size
        matrix, rhs = constrain(
            problem.space.system, values, state.residual, prepared.known, still
        )
        factor = problem.space.system.solver.factor(np.asarray(matrix))
        if done:
            return u, factor is not None and not factor.negative_eigenvalues
        if factor is None or factor.negative_eigenvalues:
            shift = max(_GROWTH * shift, _FIRST)
            continue
        du = factor.solve(np.asarray(rhs)).reshape(u.shape)
        slope = -float(np.vdot(np.asarray(rhs), du))
        share = safe_fraction(problem, prepared, u, du)
        share = share if share < _SAFE else 1.0
        for _ in range(_HALVINGS):
            new = float(potential_energy(problem, jnp.asarray(u + share * du)))
            if new <= energy + _DESCENT * share * slope + 1e-12 * abs(energy):
                break
            share /= 2
        else:
            shift = max(_GROWTH * shift, _FIRST)
            continue
        u, energy = u + share * du, new
        shift = shift * _SHRINK if share > 0.5 else shift
        shift = shift if shift > 1e-2 * _FIRST else 0.0
        state = _linearised(problem, prepared, u)
    return u, False


def _linearised(problem: Problem, prepared: Prepared, u: np.ndarray):
    at = jnp.asarray(u)
    return linearise(problem, prepared, at, at)


@jax.jit
def _diagonal(system: SparseSymmetric, values: Float[Array, " nnz"]) -> Float[Array, " nnz"]:
    return jnp.where(system.rows == system.cols, jnp.abs(values), jnp.zeros_like(values))
