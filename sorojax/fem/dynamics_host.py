"""A motion on the host: steps of the grid, halved where they fail or err, grown again."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.fem import assemble as asm
from sorojax.fem.dynamics_newton import Found, StepSolver
from sorojax.fem.dynamics_step import (
    Dynamics,
    Interval,
    Matter,
    State,
    Step,
    begin_step,
    end_step,
    matter,
    with_terms,
)
from sorojax.fem.linear import prepare
from sorojax.fem.newton import Newton
from sorojax.fem.supports import known_values
from sorojax.math.status import Status

#: A prediction that leaves a cell less of its volume is no guess to start from.
LEAST_VOLUME = 0.1


class Control(NamedTuple):
    """How to step: Newton's tolerances, cuts in a row at most, and the largest local error
    over the largest displacement, if steps follow it; accepted steps at most."""

    newton: Newton
    max_cuts: int
    error: float | None
    max_steps: int


class MotionStats(NamedTuple):
    """Numbers of a motion: accepted steps, iterations, factorisations, cut steps, and why
    the last step failed, if it did."""

    steps: int
    iterations: int
    factorisations: int
    cuts: int
    reason: str = ""


class Run:
    """A motion that goes on from grid point to grid point."""

    def __init__(
        self, dynamics: Dynamics, control: Control, tangent: Float[Array, " nnz"] | None = None
    ):
        self.dynamics, self.control = dynamics, control
        problem = dynamics.problem
        self.matter = compiled_matter(dynamics)
        self.prepared = prepare(problem)
        self.solver = StepSolver(self.prepared, problem.space.system, control.newton)
        if tangent is not None:
            self.solver.keep(np.asarray(tangent))
        self.state = dynamics.start
        self.rows: list[tuple[int, float, float, np.ndarray]] = []
        self.share, self.reason = float(dynamics.start.share), ""
        self.steps = self.iterations = self.factorisations = self.cuts = 0

    @property
    def status(self) -> Status:
        return Status.not_converged if self.reason else Status.successful

    def stats(self) -> MotionStats:
        return MotionStats(
            self.steps, self.iterations, self.factorisations, self.cuts, self.reason
        )

    def end(self) -> State:
        """The state reached, with all that the next step depends on."""
        kept = self.solver.kept
        tangent = None if kept is None else jnp.asarray(kept.matrix)
        share = jnp.asarray(self.share, self.dynamics.step.dtype)
        return dataclasses.replace(self.state, share=share, tangent=tangent)

    def advance(self, index: int) -> bool:
        """From grid point `index` to the next; False where it cannot be reached."""
        done, failures = 0.0, 0
        while done < 1.0:
            if self.steps == self.control.max_steps:
                self.reason = self.reason or f"{self.steps} steps were taken"
                return False
            end = done + self.share
            new = self._step(Interval(*map(jnp.asarray, (np.int32(index), done, end))))
            if new is None:
                failures += 1
                self.cuts += 1
                if failures > self.control.max_cuts:
                    return False
                self.share /= 2
                continue
            self.state, done, failures = new, end, 0
            wide = 2 * self.share
            if self._easy and wide <= 1.0 and done % wide == 0.0:
                self.share = wide
        self.reason = ""
        return True

    def _step(self, interval: Interval) -> State | None:
        step = _begin(self.dynamics, self.matter, self.state, interval)
        problem = with_terms(self.dynamics.problem, step.terms)
        held = np.asarray(known_values(step.terms[1], *problem.mesh.points.shape))
        start = self.state.displacement
        found = self._solve(problem, step.predicted if self._is_sound(step) else start, held)
        if found.reason:
            found = self._solve(problem, start, held)
        if found.reason:
            self.reason = found.reason
            return None
        u = jnp.asarray(found.u)
        new, error = _end(self.dynamics, self.matter, self.state, interval, step, u)
        self._easy = found.iterations <= 6 * self.control.newton.max_iterations // 4
        if self.control.error is not None:
            scale = float(jnp.max(jnp.abs(new.displacement))) + 0.01 * float(
                self.prepared.length
            )
            ratio = float(error) / (self.control.error * scale)
            if not ratio <= 1.0:
                self.reason = f"an error of a step of {float(error):.3g} m"
                return None
            self._easy = self._easy and ratio < 0.1
        self.steps += 1
        self.rows.append((int(interval.index), *_ends(interval), found.u))
        return new

    def _is_sound(self, step: Step) -> bool:
        """Whether the prediction keeps the cells from inverting."""
        problem, u = self.dynamics.problem, self.state.displacement
        kept = asm.kept_volume(
            problem.space, self.prepared.geometry, problem.kinematics, u, step.predicted - u
        )
        return float(kept) > LEAST_VOLUME

    def _solve(self, problem, start, held: np.ndarray) -> Found:
        found = self.solver.solve(problem, np.asarray(start), held)
        self.iterations += found.iterations
        self.factorisations += found.factorisations
        return found


def _ends(interval: Interval) -> tuple[float, float]:
    return float(interval.begin), float(interval.end)


def step_error(dynamics: Dynamics, interval: Interval, state: State, new: State):
    """Estimate of the local error of a step [m]: what the acceleration's change has more in
    the exact displacement.

    Reference: Zienkiewicz, Xie, "A simple error estimator and adaptive time stepping procedure
    for dynamic analysis", Earthquake Engineering & Structural Dynamics 20, 1991.
    """
    h = (interval.end - interval.begin) * dynamics.step
    beta = dynamics.scheme.beta
    change = jnp.max(jnp.abs(new.acceleration - state.acceleration))
    return h**2 * jnp.abs(beta - 1 / 6) * change


compiled_matter: Callable[[Dynamics], Matter] = eqx.filter_jit(matter)


@eqx.filter_jit
def _begin(dynamics: Dynamics, known: Matter, state: State, interval: Interval) -> Step:
    return begin_step(dynamics, known, state, interval)


@eqx.filter_jit
def _end(dynamics: Dynamics, known: Matter, state: State, interval: Interval, step: Step, u):
    new = end_step(dynamics, known, state, interval, step, u)
    return new, step_error(dynamics, interval, state, new)
