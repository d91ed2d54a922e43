"""Arc-length steps along a path of equilibria, and Newton's method with a few further
unknowns.

The unknowns are the displacement and a load factor (or the pressures of cavities) y, which
obey one further equation each. An arc-length step ends on the plane that is normal to the
path at its start, at a given distance of displacement. The bordered system

    [K  B] [du]     [R]
    [C' D] [dy] = - [c]

is solved by block elimination: all right-hand sides take one factor of K, whose
sparse pattern stays that of the mesh. K may be indefinite; it is singular only at
isolated points of a path.

References:
    Riks, "An incremental approach to the solution of snapping and buckling problems",
    Int. J. Solids and Structures 15, 1979.
    Crisfield, "A fast incremental/iterative solution procedure that handles
    snap-through", Computers & Structures 13, 1981.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax._jax.jit import once
from sorojax.fem.equilibrium import rules
from sorojax.fem.equilibrium.linear import Linearised, Prepared, linearise
from sorojax.fem.equilibrium.load_stepping import between, unloaded
from sorojax.fem.equilibrium.newton import (
    Newton,
    imbalance,
    left_to_move,
    safe_fraction,
    verdict,
)
from sorojax.fem.equilibrium.solve import value_of
from sorojax.fem.problem import Problem, load_force
from sorojax.fem.supports import known_values
from sorojax.math.linalg import sparse


class Border(NamedTuple):
    """The further equations at one state; `scale` is the size of a gap worth its name."""

    force_rate: Float[Array, "rows dofs"]  # B = dR/dy at fixed u
    known: Float[Array, " dofs"]  # displacements at the supports
    known_rate: Float[Array, "rows dofs"]
    gap: Float[Array, " rows"]  # c
    gap_slope: Float[Array, "rows dofs"]  # C
    gap_rate: Float[Array, "rows rows"]  # D
    scale: Float[Array, " rows"]


class BorderedIterate(NamedTuple):
    """State and further unknowns after Newton's method: converged unless `reason` says why
    not."""

    u: np.ndarray
    y: np.ndarray
    linearised: Linearised | None
    iterations: int
    residual: float
    reason: str


class Response(NamedTuple):
    """Answers of the tangent: to the residual, and to each unknown of the border."""

    correction: Float[np.ndarray, " dofs"]
    rates: Float[np.ndarray, "rows dofs"]
    negative_eigenvalues: int


At = Callable[[np.ndarray, np.ndarray], tuple[Problem, Border]]


@jax.jit
def _constrain(
    system: sparse.SparseSymmetric,
    values: Float[Array, " nnz"],
    forces: Float[Array, "rows dofs"],
    known: Bool[Array, " dofs"],
    moves: Float[Array, "rows dofs"],
):
    """Matrix and right-hand sides in which known unknowns take given moves."""
    rhs = -forces - jax.vmap(lambda move: sparse.product(system, values, move))(moves)
    zero = jnp.zeros_like(rhs)
    return sparse.fix(system, values, known), jnp.where(known[None], zero, rhs)


def respond(
    problem: Problem,
    prepared: Prepared,
    state: Linearised,
    border: Border,
    move: np.ndarray,
) -> Response | None:
    """Back-substitutions of one state, all with the same factor; `None` if singular."""
    system = problem.space.system
    forces = jnp.concatenate([state.residual[None], border.force_rate])
    moves = np.concatenate([move[None], np.asarray(border.known_rate)])
    matrix, rhs = _constrain(system, state.values, forces, prepared.known, jnp.asarray(moves))
    factor = system.solver.factor(np.asarray(matrix))
    if factor is None:
        return None
    x = factor.solve(np.asarray(rhs)) + moves
    return Response(x[0], x[1:], factor.negative_eigenvalues)


def newton_bordered(
    at: At, prepared: Prepared, u: np.ndarray, y: np.ndarray, settings: Newton
) -> BorderedIterate:
    """Equilibrium near `u`, `y` that obeys the further equations.

    `at(u, y)` is the problem with the unknowns put in, and the border there.
    """
    problem, border = at(u, y)
    state = linearise(problem, prepared, u, u)
    iterations, size = 0, np.inf
    while True:
        move = left_to_move(np.asarray(prepared.known), np.asarray(border.known), u)
        closed = np.all(np.abs(border.gap) <= 1e-9 * np.asarray(border.scale))
        still = bool(closed) and not np.any(move)
        reason, step = verdict(state, size, still, iterations, settings), None
        if reason is None:
            step = _step(problem, prepared, state, border, move)
            reason = "the tangent is singular"
        if step is None:
            linearised = None if reason else state
            return BorderedIterate(u, y, linearised, iterations, imbalance(state), reason)
        iterations += 1
        du, dy = step[0].reshape(u.shape), step[1]
        before = u
        u, y, problem, border, state = _advance(at, prepared, problem, u, y, du, dy)
        size = rules.relative_size(u - before, u, float(prepared.length))


def _step(problem, prepared, state, border, move) -> tuple[np.ndarray, np.ndarray] | None:
    found = respond(problem, prepared, state, border, move)
    if found is None:
        return None
    gap = np.asarray(border.gap) + np.asarray(border.gap_slope) @ found.correction
    try:
        # D - C' K^-1 B: what the further equations see of the further unknowns
        seen = np.asarray(border.gap_slope) @ found.rates.T + np.asarray(border.gap_rate)
        dy = np.linalg.solve(seen, -gap)
    except np.linalg.LinAlgError:
        return None
    return found.correction + dy @ found.rates, dy


def _advance(at: At, prepared: Prepared, problem: Problem, u, y, du, dy):
    """The state after a step, shortened where a cell would collapse."""
    fraction = 1.0
    while True:
        new_u, new_y = u + fraction * du, y + fraction * dy
        new_problem, border = at(new_u, new_y)
        state = linearise(new_problem, prepared, new_u, u)
        if fraction < 1.0 or rules.keeps_volume(float(state.volume_ratio)):
            return new_u, new_y, new_problem, border, state
        fraction = float(safe_fraction(problem, prepared, u, du))


# Steps of given length along a path of equilibria, over limit points


class Loading:
    """A problem whose loads and moved supports grow with one factor: all of them, or the one
    called `name`."""

    def __init__(self, where: str, problem: Problem, name: str | None):
        self.full, self.name = problem, name
        if name is None:
            self.rest = unloaded(problem)
        else:
            self.value = value_of(problem, name, where)
            self.rest = eqx.tree_at(self.value, problem, replace_fn=jnp.zeros_like)

    def at(self, factor) -> Problem:
        """The problem at a load factor."""
        return between(self.rest, self.full, factor)

    def rates(self, factor: float, u):
        """dR/df of the loads, the known displacements and their rate."""
        return _rates(self.rest, self.full, jnp.asarray(float(factor)), jnp.asarray(u))


@once
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
        linearised = linearise(problem, prepared, u, u)
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
    state = linearise(problem, prepared, u, start.u)
    return u if rules.keeps_volume(float(state.volume_ratio)) else start.u
