"""Steps of given length along a path of equilibria, over limit points.

The unknowns are the displacement and a load factor. A step ends on the plane that is
normal to the path at its start, at a given distance of displacement.

Reference: Riks, "An incremental approach to the solution of snapping and buckling
problems", Int. J. Solids and Structures 15, 1979.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax.fem.bordered import Border, BorderedIterate, newton_bordered, respond
from sorojax.fem.energy_form import load_force
from sorojax.fem.follow import between, unloaded
from sorojax.fem.linear import Linearised, Prepared, linearise
from sorojax.fem.newton import Newton
from sorojax.fem.problem import Problem
from sorojax.fem.supports import known_values


class Loading:
    """A problem whose loads grow with one factor: all of them, or the one called `name`."""

    def __init__(self, where: str, problem: Problem, name: str | None):
        names = [load.name for load in problem.loads]
        if name is not None and name not in names:
            raise ValueError(f"{where}: no load is called {name!r}, need one of {names}.")
        self.full, self.name = problem, name
        self.rest = unloaded(problem) if name is None else _without(problem, name)

    def at(self, factor) -> Problem:
        """The problem at a load factor."""
        return between(self.rest, self.full, factor)

    def rates(self, factor: float, u):
        """dR/df of the loads, the known displacements and their rate."""
        return _rates(self.rest, self.full, jnp.asarray(float(factor)), jnp.asarray(u))


def _without(problem: Problem, name: str) -> Problem:
    index = [load.name for load in problem.loads].index(name)
    return eqx.tree_at(lambda p: p.loads[index].value, problem, replace_fn=jnp.zeros_like)


@eqx.filter_jit
def _rates(rest: Problem, full: Problem, factor, u):
    def at(factor):
        problem = between(rest, full, factor)
        return -load_force(problem, u).ravel(), known_values(problem.supports, *u.shape)

    (_, known), (force_rate, known_rate) = jax.jvp(at, (factor,), (jnp.ones_like(factor),))
    return force_rate, known, known_rate


class PathState(NamedTuple):
    """An equilibrium on the path: du/df, the direction of travel (unit length in u, and
    df along it) and the negative eigenvalues of the tangent."""

    u: np.ndarray
    factor: float
    rate: np.ndarray
    direction: np.ndarray
    slope: float
    negative_eigenvalues: int


def tangent_state(
    loading: Loading,
    prepared: Prepared,
    u: np.ndarray,
    factor: float,
    ahead: np.ndarray | None = None,
    linearised: Linearised | None = None,
) -> PathState | None:
    """The path at an equilibrium, in the direction that agrees with `ahead`, by default
    that of growing load; `None` where the tangent is singular."""
    problem = loading.at(factor)
    if linearised is None:
        linearised = linearise(problem, prepared, jnp.asarray(u), jnp.asarray(u))
    border = _border(loading, factor, u, np.zeros(u.size), np.zeros(1))
    still = np.zeros(u.size)
    found = respond(problem, prepared, linearised, border, still)
    if found is None:
        return None
    rate = found.rates[0].reshape(u.shape)
    length = float(np.linalg.norm(rate))
    if not (np.isfinite(length) and length > 0):
        return None
    sign = 1.0 if ahead is None or np.sum(rate * ahead) >= 0 else -1.0
    return PathState(
        u, float(factor), rate, sign * rate / length, sign / length, found.negative_eigenvalues
    )


def _border(loading: Loading, factor: float, u, normal: np.ndarray, gap: np.ndarray) -> Border:
    force_rate, known, known_rate = loading.rates(factor, u)
    return Border(
        force_rate=force_rate[None],
        known=known,
        known_rate=known_rate[None],
        gap=jnp.asarray(gap),
        gap_slope=jnp.asarray(normal[None]),
        gap_rate=jnp.zeros((1, 1)),
        scale=jnp.ones(1),
    )


def arc_step(
    loading: Loading, prepared: Prepared, start: PathState, length: float, newton: Newton
) -> BorderedIterate:
    """The equilibrium at distance `length` [m, over all unknowns] from `start`."""
    normal = start.direction.ravel()

    def at(u, y):
        # relative to the length, so that the step is closed to rounding
        gap = np.array([normal @ (u - start.u).ravel() / length - 1.0])
        border = _border(loading, y[0], u, normal / length, gap)
        return loading.at(y[0]), border

    u = start.u + length * start.direction
    y = np.array([start.factor + length * start.slope])
    u = _inside(loading, prepared, start, u)
    return newton_bordered(at, prepared, u, y, newton)


def _inside(loading: Loading, prepared: Prepared, start: PathState, u: np.ndarray):
    """The guess, or the start where the guess would invert a cell."""
    problem = loading.at(start.factor)
    state = linearise(problem, prepared, jnp.asarray(u), jnp.asarray(start.u))
    return u if float(state.volume_ratio) > 0.1 else start.u
