"""Equilibria of many variants of one problem, one after another on the host.

All lanes share the pattern and its symbolic analysis, and the geometry where no lane
moves a node. A lane starts from its nearest solved neighbour where that pays: the
neighbour's tangent gives the first guess. What comes out is the equilibrium that its own
load path leads to: only a stable neighbour serves, and an answer that needs many
iterations or is not stable itself is thrown away and the load path followed from rest.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int

from sorojax._progress import report
from sorojax.fem.follow import LoadStep, Log, Start, begin_at, follow
from sorojax.fem.linear import Prepared, prepare
from sorojax.fem.newton import Newton, newton_solve
from sorojax.fem.problem import Problem
from sorojax.fem.supports import known_values

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
            u = follow(problem, begin_at(problem, None), log)
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
    problem: Problem, prepared: Prepared, near: Start, log: Log
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
    log.end = Start(found.u, problem, found.linearised)
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
