"""Newton's method at one load level, on the host around compiled kernels.

A step is accepted only if the smallest volume ratio keeps a tenth of its value; else it
is shortened by a closed form. The residual of thin rubber walls may rise by orders of
magnitude in the first iteration, so it is not forced to fall: the answer is judged by
update and residual together, and a state that did not converge is never returned as one.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from sorojax.fem import assemble as asm
from sorojax.fem.kept_factor import KeptFactor
from sorojax.fem.line_search import overshoots, share_of_step
from sorojax.fem.linear import Linearised, Prepared, linearise, step
from sorojax.fem.problem import Problem
from sorojax.material.hyperelastic import finite_share


class Newton(eqx.Module):
    """When to stop.

    Args:
        residual_tolerance: Largest unbalanced force over the largest load or reaction.
        step_tolerance: Largest last update over the largest displacement.
        max_iterations: Steps per load level.
    """

    residual_tolerance: float = 1e-9
    step_tolerance: float = 1e-6
    max_iterations: int = 15


class Iterate(NamedTuple):
    """State after a load level: converged unless `reason` says why not."""

    u: np.ndarray
    linearised: Linearised | None
    iterations: int
    residual: float
    negative_eigenvalues: int
    reason: str
    kept: KeptFactor | None = None


def newton_solve(
    problem: Problem,
    prepared: Prepared,
    start: np.ndarray,
    known_values: np.ndarray,
    settings: Newton,
    tangent: Linearised | None = None,
    kept: KeptFactor | None = None,
) -> Iterate:
    """Equilibrium near `start`. `tangent`, of a neighbouring equilibrium, gives a first
    guess at the price of a few back-substitutions with the factor `kept` from there, unless
    a load has kinks: the points that an obstacle moved into have no stiffness yet."""
    u, before = start, start
    state = _linearise(problem, prepared, u, before)
    known = np.asarray(prepared.known)
    move = np.where(known, known_values - u.ravel(), 0.0)
    iterations, negative, size = 0, 0, np.inf
    if kept is None:
        kept = KeptFactor(known, problem.mesh.element.dim, settings.residual_tolerance)
    if tangent is not None and all(load.smooth for load in problem.loads):
        near = kept.near(u, 1.0, 0.0)
        du, negative, new = step(problem, prepared, tangent.values, state.residual, move, near)
        kept.renew(new, u)
        if du is not None:
            u, before, state, size = _advance(problem, prepared, u, du)
            move = np.where(known, known_values - u.ravel(), 0.0)
    while True:
        norm, reference = float(state.residual_norm), float(state.reference)
        ratio = norm / reference if reference > 0 else norm
        if not (np.isfinite(norm) and float(state.volume_ratio) > 0):
            return Iterate(u, None, iterations, ratio, negative, "an element inverts")
        small = ratio < settings.residual_tolerance or norm < float(state.rounding)
        if small and size < settings.step_tolerance and not np.any(move):
            return Iterate(u, state, iterations, ratio, negative, "", kept)
        if iterations == settings.max_iterations:
            reason = f"no convergence in {iterations} Newton iterations"
            return Iterate(u, None, iterations, ratio, negative, reason)
        near = kept.near(u, ratio, size)
        du, negative, new = step(problem, prepared, state.values, state.residual, move, near)
        kept.renew(new, u)
        if du is None:
            reason = problem.space.system.unsolved
            return Iterate(u, None, iterations, ratio, negative, reason)
        iterations += 1
        if overshoots(problem) and not np.any(move):
            args = (problem, prepared.known, state.residual, jnp.asarray(u), jnp.asarray(du))
            du = float(share_of_step(*args)) * du
        u, before, state, size = _advance(problem, prepared, u, du)
        move = np.where(known, known_values - u.ravel(), 0.0)
        move[np.abs(move) <= 1e-12 * np.abs(known_values).max()] = 0.0


def _linearise(problem, prepared, u: np.ndarray, before: np.ndarray) -> Linearised:
    return linearise(problem, prepared, u, before)  # type: ignore[arg-type]


def _advance(problem: Problem, prepared: Prepared, u: np.ndarray, du: np.ndarray):
    """The state after a step, shortened where a cell would collapse."""
    new = u + du
    state = _linearise(problem, prepared, new, u)
    if not float(state.volume_ratio) > 0.1:
        new = u + safe_fraction(problem, prepared, u, du) * du
        state = _linearise(problem, prepared, new, u)
    return new, u, state, relative_size(prepared, new, du)


def safe_fraction(problem: Problem, prepared: Prepared, u: np.ndarray, du: np.ndarray) -> float:
    """Fraction of a step that keeps more than a tenth of every volume."""
    fraction = asm.largest_step(
        problem.space, prepared.geometry, problem.kinematics, jnp.asarray(u), jnp.asarray(du),
        share=finite_share(problem.material),
    )  # fmt: skip
    return 0.9 * float(fraction)


def relative_size(prepared: Prepared, u: np.ndarray, du: np.ndarray) -> float:
    """Largest entry of a step over that of the displacement."""
    # without load the displacement is rounding alone, which never gets relatively small
    return np.abs(du).max() / (np.abs(u).max() + 1e-6 * float(prepared.length))
