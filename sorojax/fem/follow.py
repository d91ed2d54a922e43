"""Following an equilibrium from one load to another, on the host, in adaptive steps."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from sorojax._progress import report
from sorojax.fem.linear import Linearised, prepare
from sorojax.fem.newton import Newton, newton_solve
from sorojax.fem.problem import Problem
from sorojax.fem.supports import known_values
from sorojax.math.status import Status


class LoadStep(NamedTuple):
    """One accepted load step: fraction of the load, Newton iterations, residual over load,
    and negative eigenvalues of the tangent (0 where the state is stable)."""

    fraction: float
    iterations: int
    residual: float
    negative_eigenvalues: int


class Stats(NamedTuple):
    """Accepted steps, the number of cut steps and why the last one failed, if it did."""

    steps: tuple[LoadStep, ...]
    cuts: int
    reason: str = ""

    @property
    def iterations(self) -> int:
        return sum(step.iterations for step in self.steps)


class Start(NamedTuple):
    """A known equilibrium to start from, with the tangent there."""

    u: np.ndarray
    problem: Problem
    tangent: Linearised | None


class Log:
    """Settings and record of one solve on the host."""

    def __init__(self, newton: Newton, steps: int, max_cuts: int):
        self.newton, self.num_steps, self.max_cuts = newton, steps, max_cuts
        self.clear()

    def clear(self) -> None:
        self.steps: list[LoadStep] = []
        self.cuts, self.reason = 0, ""
        self.end: Start

    @property
    def status(self) -> Status:
        return Status.not_converged if self.reason else Status.successful

    def stats(self) -> Stats:
        return Stats(tuple(self.steps), self.cuts, self.reason)


def begin_at(problem: Problem, begin: Start | np.ndarray | None) -> Start:
    """Where to start from: the unloaded body, unless told otherwise."""
    if isinstance(begin, Start):
        return begin
    if begin is None:
        return Start(np.zeros(problem.mesh.points.shape), unloaded(problem), None)
    return Start(begin, problem, None)


def follow(problem: Problem, begin: Start, log: Log) -> np.ndarray:
    """Step from `begin` to `problem`, halving steps that fail."""
    prepared = prepare(problem)
    u, tangent, done, size, failures = begin.u, begin.tangent, 0.0, 1.0 / log.num_steps, 0
    kept = None
    least = 0.99 * size / 2 ** (log.max_cuts + 1)
    while done < 1.0:
        goal = min(1.0, done + size) if done + size < 1.0 - 1e-9 else 1.0
        here = problem if goal == 1.0 else between(begin.problem, problem, goal)
        known = np.asarray(known_values(here.supports, *u.shape))
        result = newton_solve(here, prepared, u, known, log.newton, tangent, kept)
        if result.reason:
            failures += 1
            log.cuts += 1
            size, tangent, kept = (goal - done) / 2, None, None
            # at a limit point single steps go on for ever, each shorter than the one before
            if failures > log.max_cuts or size < least:
                log.reason = result.reason
                return u
            continue
        u, tangent, done, failures = result.u, result.linearised, goal, 0
        kept = result.kept
        log.steps.append(
            LoadStep(goal, result.iterations, result.residual, result.negative_eigenvalues)
        )
        log.end = Start(u, problem, tangent)
        if len(log.steps) + log.cuts > 1:  # one step is no wait worth a line
            report("load", done, 1.0, iterations=result.iterations, cuts=log.cuts)
        if result.iterations <= 5:
            size *= 1.5
    return u


def unloaded(problem: Problem) -> Problem:
    """The body with every load and every prescribed displacement at zero."""
    return _with_terms(problem, lambda _, b: jnp.zeros_like(b), problem)


def between(first: Problem, last: Problem, fraction: float) -> Problem:
    """Loads and supports between two problems on the same body."""
    return _with_terms(first, lambda a, b: a + fraction * (b - a), last)


def _with_terms(first: Problem, mix, last: Problem) -> Problem:
    def moved(a, b):
        return mix(a, b) if eqx.is_inexact_array(b) else b

    def loaded(a, b):  # where a load acts, its origin for example, does not change its size
        return eqx.tree_at(lambda load: load.value, b, moved(a.value, b.value))

    def held(a, b):
        if b.ramped is None:
            return b
        return eqx.tree_at(
            lambda support: getattr(support, b.ramped), b,
            moved(getattr(a, b.ramped), getattr(b, b.ramped)),
        )  # fmt: skip

    loads = tuple(loaded(a, b) for a, b in zip(first.loads, last.loads, strict=True))
    supports = tuple(held(a, b) for a, b in zip(first.supports, last.supports, strict=True))
    return eqx.tree_at(lambda p: (p.loads, p.supports), last, (loads, supports))
