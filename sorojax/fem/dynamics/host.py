"""Time integration on the host: steps of a grid, halved where they fail or their error is too
large, and grown again.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sorojax._jax.jit import once
from sorojax.fem.assembly import assemble as asm
from sorojax.fem.assembly.geometry import Geometry
from sorojax.fem.contact.swept import gains, passed_through
from sorojax.fem.dynamics.newton import (
    UNSOUND,
    Found,
    HostInertia,
    Numbers,
    StepSolver,
    Task,
    has_lists,
    listed_at,
    may_rest,
)
from sorojax.fem.dynamics.step import (
    Dynamics,
    Inertia,
    Interval,
    Matter,
    State,
    TimeStep,
    begin_step,
    end_step,
    matter,
)
from sorojax.fem.equilibrium import rules
from sorojax.fem.equilibrium.linear import prepare
from sorojax.fem.equilibrium.newton import Newton
from sorojax.fem.loads.loads import AbstractLoad, has_masses
from sorojax.fem.problem import Problem, body, load_force
from sorojax.fem.supports import known_values
from sorojax.math.compiled import Split, kernel
from sorojax.math.ode.step_control import halved, may_double
from sorojax.math.status import Status

_CALM = 0.8  # a step whose forces act at more of every volume does not get near to that


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

    def __init__(self, dynamics: Dynamics, control: Control):
        self.control, self.now = control, Split(dynamics.start)
        self.follows, self.listed = False, None
        self._take(dynamics)
        self.rows: list[tuple[int, float, float, np.ndarray]] = []
        self.share, self.reason = float(dynamics.start.share), ""
        self.steps = self.iterations = self.factorisations = self.cuts = 0

    def resume(self, begun: State) -> None:
        """Go on as the run would have that ended at `begun`; lists follow from here on."""
        self.follows = has_lists(self.dynamics.problem)
        if begun.listed is not None:
            problem, self.listed = listed_at(self.dynamics.problem, begun.listed, None)
            self._take(dataclasses.replace(self.dynamics, problem=problem))
        if begun.tangent is not None and begun.tangent.shape == self.matter.mass.shape:
            self.solver.keep(np.asarray(begun.tangent))

    def _take(self, dynamics: Dynamics) -> None:
        """Prepare for a problem with other lists, and perhaps a pattern of its own."""
        self.dynamics, problem = dynamics, dynamics.problem
        self.prepared = prepare(problem)
        self.matter = compiled_matter(dynamics)
        mass, damping = jax.tree.map(np.asarray, tuple(self.matter)[:2])
        inertia = HostInertia(problem.space.system, mass, damping)
        same = zip(problem.loads, _steady(dynamics), strict=True)
        steady = tuple(load for load, always in same if always)
        dead = np.asarray(_force_of(problem, steady))
        newton = self.control.newton
        self.solver = StepSolver(self.prepared, problem, newton, inertia, dead)
        self._fixed = Split((dynamics, self.matter, self.prepared.geometry))

    def _follow_lists(self) -> None:
        before, kept = self.dynamics.problem, self.solver.kept
        problem, self.listed = listed_at(before, self.state.displacement, self.listed)
        if problem is not before:
            self._take(dataclasses.replace(self.dynamics, problem=problem))
            if problem.space is before.space and kept is not None:
                self.solver.keep(kept.matrix)

    @property
    def _loads_only(self) -> bool:
        """Whether the forces on nodes are those of loads and supports, and nothing else's."""
        inertial = any(map(has_masses, self.dynamics.problem.loads))
        return not (inertial or self.dynamics.conserves)

    @property
    def state(self) -> State:
        return self.now.whole()

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
        return dataclasses.replace(self.state, share=share, tangent=tangent, listed=self.listed)

    def advance(self, index: int) -> bool:
        """From grid point `index` to the next; False where it cannot be reached."""
        done, failures = 0.0, 0
        while done < 1.0:
            if self.steps == self.control.max_steps:
                self.reason = self.reason or f"{self.steps} steps were taken"
                return False
            if self.follows:
                self._follow_lists()
            end = done + self.share
            ends = np.int32(index), np.float64(done), np.float64(end)
            new = self._step(Interval(*ends))  # type: ignore[arg-type]
            if new is None:
                share, failures, goes_on = halved(self.share, failures, self.control.max_cuts)
                self.cuts += 1
                if not goes_on:
                    return False
                self.share = share
                continue
            self.now, done, failures = new, end, 0
            if self._easy and may_double(self.share, done):
                self.share *= 2
        self.reason = ""
        return True

    def _step(self, interval: Interval) -> Split | None:
        step, task, held, predicted = _begin((self._fixed, self.now), interval)
        self.solver.begin(task)
        start, held = task.inertia.origin, np.asarray(held)
        found = self._solve(predicted, held)
        if found.reason == UNSOUND:
            found = self._solve(start, held)
        if found.reason:
            found = self._solve(start, held)
        if found.reason:
            self.reason = found.reason
            return None
        taken = self.solver.inertia.taken(found.u)
        given = np.float64(self._given(found)) if self._loads_only else None
        args = interval, found.u, given, np.float64(taken)
        new, displacement, error, through, gained = _end((self._fixed, self.now, step), *args)
        if through:
            self.reason = "a point goes through an obstacle"
        elif gained:
            self.reason = "a contact gives energy to the body"
        elif not (found.volume > _CALM or self._keeps_volume(start, displacement)):
            self.reason = UNSOUND
        else:
            self.reason = ""
        if self.reason:
            return None
        ratio = 0.0
        if self.control.error is not None:
            args = self.control.error, np.asarray(displacement), float(self.prepared.length)
            ratio = rules.error_ratio(float(error), *args)
            if not ratio <= 1.0:
                self.reason = f"an error of a step of {float(error):.3g} m"
                return None
        self._easy = rules.is_easy(found.iterations, self.control.newton, ratio)
        self.steps += 1
        ends = float(interval.begin), float(interval.end)
        self.rows.append((int(interval.index), *ends, found.u))
        return new

    def _given(self, found: Found) -> float:
        """Work [J] of loads and supports in a step, with the forces that the step takes."""
        inertia, known = self.solver.inertia, self.solver.known
        moved = (found.u - inertia.origin).ravel() / inertia.share
        work = float(found.load @ moved)
        if any(support.ramped is not None for support in self.dynamics.problem.supports):
            work += float(found.residual[known] @ moved[known])
        return work

    def _keeps_volume(self, u, new) -> bool:
        """Whether no cell loses most of its volume in a step to displacement `new`, which is
        further than where its forces act."""
        problem = self.dynamics.problem
        args = (problem.space, self.prepared.geometry, problem.kinematics)
        return rules.keeps_volume(float(asm.kept_volume(*args, u, new - u)))

    def _solve(self, start, held: np.ndarray) -> Found:
        found = self.solver.solve(np.asarray(start), held)
        self.iterations += found.iterations
        self.factorisations += found.factorisations
        return found


def ended(dynamics: Dynamics, known: Matter, state: State, interval, step: TimeStep, u, *sums):
    """The state after a step whose equilibrium is `u`, an estimate of its error [m], whether a
    point went through an obstacle, and whether a contact gave energy; `sums` of `end_step`."""
    new = end_step(dynamics, known, state, interval, step, u, *sums)
    through = passed_through(dynamics.problem, step.terms[0], new.displacement)
    gained = gains(dynamics, known, state, step, new, u)
    return new, step_error(dynamics, interval, state, new), through, gained


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


compiled_matter: Callable[[Dynamics], Matter] = once(matter)


def _steady(dynamics: Dynamics) -> list[bool]:
    """Which loads have the same force in every step."""
    rows = zip(dynamics.problem.loads, dynamics.loads, strict=True)
    return [
        load.dead and row is None and type(load).begun is AbstractLoad.begun
        for load, row in rows
    ]


@once
def _force_of(problem: Problem, loads: tuple[AbstractLoad, ...]):
    """Force of `loads` on the body at rest [N]."""
    bare = dataclasses.replace(body(problem), loads=loads)
    return load_force(bare, jnp.zeros_like(problem.mesh.points)).ravel()


@kernel
def _begin(fixed: tuple[Dynamics, Matter, Geometry], state: State, interval: Interval):
    """A step and what there is to solve, the displacements held in it and predicted."""
    dynamics, known, _ = fixed
    step = begin_step(dynamics, known, state, interval)
    problem, u, c = dynamics.problem, state.displacement, dynamics.scheme
    loads, few, room = step.terms[0], None, jnp.zeros((), u.dtype)
    rooms = [x for x in (load.room(problem) for load in loads) if x is not None]
    acting = tuple(load for load in loads if not (load.dead or isinstance(load, Inertia)))
    others = ((), *step.terms[2:])
    if rooms:
        few = Split((tuple(load for load in acting if not may_rest(load)), *others))
        room = jnp.min(jnp.stack(rooms))
    same = zip(loads, _steady(dynamics), strict=False)
    changing = tuple(load for load, steady in same if load.dead and not steady)
    dead = _force_of(problem, changing) if changing else None
    h = (interval.end - interval.begin) * dynamics.step
    varying = None if all(term.constant for term in dynamics.damping) else step.matrix
    rates = (1 - c.am) / (c.beta * h**2 * (1 - c.af)), c.gamma / (c.beta * h)
    numbers = Numbers(varying, step.lead, step.drive, u, *rates, 1 - c.af)
    needed = step.terms
    if not dynamics.conserves:
        needed = loads[: len(problem.loads)], step.terms[1]
    ending = step._replace(terms=needed, matrix=None)
    task = Task(Split((acting, *others)), few, room, dead, numbers)
    return Split(ending), task, known_values(step.terms[1], *u.shape), step.predicted


@kernel
def _end(fixed, state: State, step: TimeStep, interval: Interval, u, work, taken):
    dynamics, known, _ = fixed
    new, *found = ended(dynamics, known, state, interval, step, u, work, taken)
    return Split(new), new.displacement, *found
