"""Equilibrium by adaptive load steps on the host, of one problem or of a batch of variants.

All members of a batch share the pattern and its symbolic analysis, and the geometry where
none moves a node. A member starts from its nearest solved neighbour where that saves
iterations: the neighbour's tangent gives the first guess. The result is the equilibrium of
its own load path: only a stable neighbour serves, and an answer that needs many iterations or
is not stable is discarded and the load path followed from rest.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._progress import report, reported_if_long
from sorojax.fem.equilibrium import rules
from sorojax.fem.equilibrium.linear import Prepared, prepare
from sorojax.fem.equilibrium.newton import Newton, newton_solve
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


class StartingPoint(NamedTuple):
    """A known equilibrium to start from, with the tangent there."""

    u: np.ndarray
    problem: Problem
    tangent: Float[Array, " nnz"] | None


class Log:
    """Settings and record of one solve on the host."""

    def __init__(self, newton: Newton, steps: int, max_cuts: int):
        self.newton, self.num_steps, self.max_cuts = newton, steps, max_cuts
        self.clear()

    def clear(self) -> None:
        self.steps: list[LoadStep] = []
        self.cuts, self.reason = 0, ""
        self.end: StartingPoint

    @property
    def status(self) -> Status:
        return Status.not_converged if self.reason else Status.successful

    def stats(self) -> Stats:
        return Stats(tuple(self.steps), self.cuts, self.reason)


def at_rest(problem: Problem) -> StartingPoint:
    """The unloaded body."""
    return StartingPoint(np.zeros(problem.mesh.points.shape), unloaded(problem), None)


def follow(problem: Problem, begin: StartingPoint, log: Log) -> np.ndarray:
    """Step from `begin` to `problem`, halving steps that fail."""
    prepared = prepare(problem)
    u, tangent, kept, way = begin.u, begin.tangent, None, rules.first_step(log.num_steps)
    while way.done < 1.0:
        goal = rules.goal(way)
        here = problem if goal == 1.0 else between(begin.problem, problem, goal)
        known = np.asarray(known_values(here.supports, *u.shape))
        with reported_if_long("newton", log.newton.max_iterations) as tell:
            result = newton_solve(here, prepared, u, known, log.newton, tangent, kept, tell)
        if result.reason:
            way, tangent, kept = rules.cut(way), None, None
            log.cuts = way.cuts
            if not rules.goes_on(way, log.num_steps, log.max_cuts):
                log.reason = result.reason
                return u
            continue
        u, tangent, kept = result.u, result.tangent, result.kept
        way = rules.accept(way, result.iterations)
        log.steps.append(
            LoadStep(goal, result.iterations, result.residual, result.negative_eigenvalues)
        )
        log.end = StartingPoint(u, problem, tangent)
        if len(log.steps) + log.cuts > 1:  # one step is no wait worth a line
            report("load", goal, 1.0, iterations=result.iterations, cuts=log.cuts)
    return u


def unloaded(problem: Problem) -> Problem:
    """The body with every load and every prescribed displacement at zero."""
    return _with_terms(problem, lambda _, b: jnp.zeros_like(b), problem)


def between(first: Problem, last: Problem, fraction: float | Float[Array, ""]) -> Problem:
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
            lambda support: getattr(support, b.ramped),
            b,
            moved(getattr(a, b.ramped), getattr(b, b.ramped)),
        )

    loads = tuple(loaded(a, b) for a, b in zip(first.loads, last.loads, strict=True))
    supports = tuple(held(a, b) for a, b in zip(first.supports, last.supports, strict=True))
    return eqx.tree_at(lambda p: (p.loads, p.supports), last, (loads, supports))


# Equilibria of many variants of one problem, one after another on the host


_MAX_ITERATIONS = 6  # a neighbour that is near enough needs three


def solve_lanes(
    problem_of: Callable[[int], Problem],
    features: Float[np.ndarray, "lanes features"],
    logs: Sequence[Log],
    same_body: bool,
) -> list[np.ndarray]:
    """Displacements of all lanes; how each of them went is in `logs`.

    Args:
        problem_of: The problem of a lane.
        features: What differs between lanes, scaled to be comparable.
        logs: One record per lane; their `end` is the state that lane reached.
        same_body: Whether all lanes have the geometry of the first.
    """
    shared = prepare(problem_of(0))
    answers: list[np.ndarray] = [np.zeros(0)] * len(logs)
    account = _Account()
    for count, (lane, neighbour) in enumerate(_by_distance(features)):
        problem, log = problem_of(lane), logs[lane]
        spent = problem.space.system.solver.num_factorisations
        u, tried = None, False
        if neighbour >= 0 and _is_stable(logs[neighbour]) and account.neighbours_pay:
            prepared = shared if same_body else prepare(problem)
            u, tried = _from_neighbour(problem, prepared, logs[neighbour].end, log), True
        if u is None:
            u = follow(problem, at_rest(problem), log)
        account.add(tried, problem.space.system.solver.num_factorisations - spent)
        answers[lane] = u
        report("lanes", count + 1, len(logs), iterations=log.stats().iterations)
    return answers


class _Account:
    """Mean number of factorisations of a lane with and without a neighbour."""

    def __init__(self):
        self._spent = {True: [], False: []}

    def add(self, tried: bool, factorisations: int) -> None:
        self._spent[tried].append(factorisations)

    @property
    def neighbours_pay(self) -> bool:
        tried, alone = self._spent[True], self._spent[False]
        return len(tried) < 3 or float(np.mean(tried)) < float(np.mean(alone))


def _is_stable(log: Log) -> bool:
    return not log.reason and all(step.negative_eigenvalues == 0 for step in log.steps)


def _from_neighbour(
    problem: Problem, prepared: Prepared, near: StartingPoint, log: Log
) -> np.ndarray | None:
    """Equilibrium by Newton from a neighbour's, or `None` if that is not to be trusted."""
    known = np.asarray(known_values(problem.supports, *near.u.shape))
    settings = Newton(
        log.newton.residual_tolerance,
        log.newton.step_tolerance,
        min(_MAX_ITERATIONS, log.newton.max_iterations),
    )
    found = newton_solve(problem, prepared, near.u, known, settings, near.tangent)
    if found.reason or found.negative_eigenvalues != 0:
        return None
    log.steps.append(LoadStep(1.0, found.iterations, found.residual, 0))
    log.end = StartingPoint(found.u, problem, found.tangent)
    return found.u


def scaled_features(leaves: Sequence[np.ndarray]) -> Float[np.ndarray, "lanes features"]:
    """The numbers that differ between lanes, each array over its largest entry."""
    columns = []
    for leaf in leaves:
        rows = np.asarray(leaf, float).reshape(len(leaf), -1)
        columns.append(rows / (np.abs(rows).max(initial=0.0) or 1.0))
    return np.concatenate(columns, axis=1)


def _by_distance(features: np.ndarray) -> Iterator[tuple[Int, Int]]:
    """Lanes with their nearest lane before them, -1 for the first: a shortest tree that
    grows from the middle."""
    centred = features - features.mean(axis=0)
    square = np.sum(centred**2, axis=1)
    distance = square[:, None] + square[None] - 2 * centred @ centred.T
    distance = np.where(np.isfinite(distance), distance, np.inf)
    first = int(np.argmin(np.where(np.isfinite(square), square, np.inf)))
    waiting = np.ones(len(features), bool)
    waiting[first] = False
    yield first, -1
    near = np.full(len(features), first)
    best = distance[:, first].copy()
    for _ in range(len(features) - 1):
        candidates = np.flatnonzero(waiting)
        lane = int(candidates[np.argmin(best[candidates])])
        waiting[lane] = False
        yield lane, int(near[lane])
        closer = distance[:, lane] < best
        near[closer], best[closer] = lane, distance[closer, lane]
