"""Newton's method at one load level, on the host around compiled kernels.

A step is accepted only if the smallest volume ratio keeps a tenth of its value; otherwise it
is shortened by a closed form. The residual of thin rubber walls may rise by orders of
magnitude in the first iteration, so it need not fall: convergence is judged by update and
residual together (`rules`). Steps along which a contact or friction changes its state are
shortened by a line search on the energy of these loads alone. Where contacts close or open,
the tangent changes by little in rank: BFGS updates correct a factor of an earlier iteration.

References:
    Matthies, Strang, "The solution of nonlinear finite element equations", Int. J. Num.
    Meth. Eng. 14, 1979.
    Nocedal, Wright, Numerical Optimization, 2006, algorithm 7.4.
"""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax._jax.jit import once
from sorojax._types import from_host
from sorojax.fem.assembly import assemble as asm
from sorojax.fem.equilibrium import rules
from sorojax.fem.equilibrium.linear import Linearised, Neighbour, Prepared, linearise, step
from sorojax.fem.problem import Problem, unsupported
from sorojax.material.hyperelastic import finite_share
from sorojax.math.linalg import sparse
from sorojax.math.linalg.sparse import Factor

#: Movements of the body, relative to its displacement, since the factor was made: within the
#: first the tangent has the signs of its eigenvalues, up to the second a probe asks for them.
_SAME, _NEAR = 1e-3, 0.1
#: Unknowns from which on a factor costs much more than the back-substitutions, without and
#: with a probe; in 3-D factors are dense.
_WORTH, _WORTH_PROBING, _WORTH_PROBING_3D = 2_000, 60_000, 6_000
_SHARE = 0.03  # of the tolerance of the residual that an inexact step may leave
_QUADRATIC = 3e-3  # error of a step that Newton's own exceeds, relative to residual over load


class KeptFactor:
    """The last factor of one solve, and the displacement [m] that it belongs to."""

    def __init__(self, known: Bool[np.ndarray, " dofs"], dim: int, tolerance: float):
        size = known.size
        least = _WORTH_PROBING_3D if dim == 3 else _WORTH_PROBING
        self._reach = _NEAR if size >= least else _SAME if size >= _WORTH else 0.0
        self._known, self._tolerance = known, tolerance
        self._factor: sparse.Factor | None = None
        self._u = self._probe = np.zeros(0)

    def renew(self, factor: sparse.Factor | None, u: Float[np.ndarray, "nodes dim"]) -> None:
        """Keep `factor` of the tangent at `u`, if it is one of a stable state."""
        if factor is not None and self._reach > 0:
            self._factor = factor if factor.negative_eigenvalues == 0 else None
            self._u, self._probe = u, np.zeros(0)

    def near(
        self, u: Float[np.ndarray, "nodes dim"], ratio: float, size: float
    ) -> Neighbour | None:
        """The linear solver at `u`, where the residual is `ratio` of the load and the last
        step was `size` of the displacement; 0 where no eigenvalues are asked for."""
        if self._factor is None or not 0 < ratio < np.inf:
            return None
        largest = np.abs(u).max()
        moved = np.abs(u - self._u).max()
        if not moved <= self._reach * largest:
            return None
        start = None
        if (
            size > 0 and moved > _SAME * largest
        ):  # as large as the step to come, and in every mode
            start = size * size * largest * self._modes(self._factor)
        tolerance = max(min(_SHARE * self._tolerance / ratio, 1e-2), _QUADRATIC * ratio)
        return Neighbour(self._factor, start, min(tolerance, 1e-2))

    def _modes(self, factor: sparse.Factor) -> np.ndarray:
        """A displacement in which soft modes are large, one at most."""
        if not self._probe.size:
            random = np.random.default_rng(0).standard_normal(self._known.size)
            probe = factor.solve(np.where(self._known, 0.0, random))
            self._probe = probe / np.abs(probe).max()
        return self._probe


# Quasi-Newton steps: a kept factor, corrected by what the last iterations taught


_MOST = 12
_FLAT = 1e-12  # curvature along a pair, over the product of the norms, to be of use

Vector = Float[np.ndarray, " dofs"]


class Secants:
    """Pairs of steps [m] and changes of the residual [N], the newest last."""

    def __init__(self):
        self._pairs: deque[tuple[Vector, Vector, float]] = deque(maxlen=_MOST)

    def clear(self) -> None:
        self._pairs.clear()

    def add(self, move: Vector, change: Vector) -> None:
        """Learn from a step, unless the energy curves downwards along it."""
        curvature = float(move @ change)
        if curvature > _FLAT * float(np.sqrt((move @ move) * (change @ change))):
            self._pairs.append((move, change, 1 / curvature))

    def solve(self, factor: Factor, rhs: Vector) -> Vector:
        """The step for `rhs`: that of `factor` where no pair knows better."""
        rest, shares = rhs.copy(), []
        for move, change, scale in reversed(self._pairs):
            share = scale * float(move @ rest)
            rest -= share * change
            shares.append(share)
        step = factor.solve(rest)
        for (move, change, scale), share in zip(self._pairs, reversed(shares), strict=True):
            step += (share - scale * float(change @ step)) * move
        return step


# Shortening Newton steps that run past the place where a contact or friction gives way


_MOST_CHANGE = (
    1.1  # change of the slope, over what the whole energy needs, that a step may bring
)
_LEAST = 0.4  # and that a shortened one brings
_TRIALS = 40
_LOOKS = (0.125, 0.25, 0.5, 1.0)  # a whole step may end behind what it should have met


def overshoots(problem: Problem) -> bool:
    return any(load.overshoots for load in problem.loads)


def share_of_step(
    problem: Problem,
    known: Bool[Array, " dofs"],
    residual: Float[Array, " dofs"],
    u: Float[Array, "nodes dim"],
    du: Float[Array, "nodes dim"],
) -> Float[Array, ""]:
    """How much of the Newton step `du` [m] from `u` to take.

    Along a good step the slope of the energy goes from `residual` times `du` to zero. If
    that of the loads with kinks changes by more than that, the step ends where it changes by
    about as much: where contacts carry what made the body move.
    """
    return _share(unsupported(problem), known, residual, u, du)


@once
def _share(problem: Problem, known, residual, u, du):
    fall = -jnp.sum(jnp.where(known, jnp.zeros_like(residual), residual) * du.ravel())
    loads = [load for load in problem.loads if load.overshoots]

    def slope(share):
        def potential(u):
            terms = (load.potential(problem, u) for load in loads)
            return sum(terms, start=jnp.zeros((), u.dtype))

        return jax.jvp(potential, (u + share * du,), (du,))[1]

    one = jnp.min(jnp.stack([load.longest_share(du) for load in loads]))
    looks = one * jnp.asarray((0.0, *_LOOKS), u.dtype)
    return _searched(slope, looks, fall)


class _Search(NamedTuple):
    """How often the slope was asked for, its value at each look, and after those: the ends of
    the interval, the change of the slope at them, the last trial and the change there."""

    count: Array
    slopes: Float[Array, " looks"]
    low: Array
    high: Array
    below: Array
    above: Array
    share: Array
    change: Array


def _searched(slope: Callable[[Array], Array], looks: Array, fall: Array) -> Float[Array, ""]:
    """The share where the change of the slope fits, the last of `looks` if it does there; one
    loop, so that the program holds the slope once."""
    num = looks.shape[0]

    def changes(search: _Search):
        return (search.slopes[1:] - search.slopes[:1]) / fall

    def ask(search: _Search) -> _Search:
        next_ = _next(search, search.count - num)
        at = jnp.clip(search.count, 0, num - 1)
        looking = search.count < num
        here = slope(jnp.where(looking, looks[at], next_.share))
        slopes = jnp.where(looking, search.slopes.at[at].set(here), search.slopes)
        found = next_._replace(change=(here - slopes[0]) / fall)
        looked = search._replace(slopes=slopes)
        met = jnp.argmax(changes(looked) > _MOST_CHANGE)
        share, change = looks[1:][met], changes(looked)[met]
        looked = looked._replace(high=share, above=change, share=share, change=change)
        found = jax.tree.map(lambda a, b: jnp.where(looking, a, b), looked, found)
        return found._replace(count=search.count + 1)

    def unfit(search: _Search):
        # where the residual does not fall along the step there is nothing to go by
        return (fall > 0) & jnp.any(changes(search) > _MOST_CHANGE)

    def running(search: _Search):
        fits = (search.change >= _LEAST) & (search.change <= _MOST_CHANGE)
        wide = search.high - search.low > 1e-12 * search.high
        trying = unfit(search) & ~fits & (search.count < num + _TRIALS) & wide
        return (search.count < num) | trying

    zero, count = jnp.zeros_like(fall), jnp.zeros((), jnp.int32)
    start = _Search(count, jnp.zeros_like(looks), zero, *(jnp.ones_like(fall),) * 5)
    end = jax.lax.while_loop(running, ask, start._replace(below=zero))
    return jnp.where(unfit(end), end.share, looks[-1])


def _next(search: _Search, trials: Array) -> _Search:
    """The interval with the last trial as one of its ends, and where to try next."""
    far = search.change > _MOST_CHANGE
    low = jnp.where(far, search.low, search.share)
    high = jnp.where(far, search.share, search.high)
    below = jnp.where(far, search.below, search.change)
    above = jnp.where(far, search.change, search.above)
    # between a chord, which a steep end makes useless, and the middle
    chord = low + (1 - below) / (above - below) * (high - low)
    middle = jnp.where(low > 0, jnp.sqrt(low * high), high / 8)
    share = jnp.where(trials % 2 == 0, chord, middle)
    return search._replace(low=low, high=high, below=below, above=above, share=share)


# Newton's method at one load level, on the host around compiled kernels


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
    tangent: Float[Array, " nnz"] | None
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
    tangent: Float[Array, " nnz"] | None = None,
    kept: KeptFactor | None = None,
    tell: Callable[..., None] = lambda done, imbalance: None,
) -> Iterate:
    """Equilibrium near `start`. `tangent`, of a neighbouring equilibrium, gives a first
    guess at the price of a few back-substitutions with the factor `kept` from there. `tell`
    is called with the number of every iteration."""
    u, before = start, start
    state = linearise(problem, prepared, u, before)
    known = np.asarray(prepared.known)
    move = left_to_move(known, known_values, u)
    iterations, negative, size = 0, 0, np.inf
    if kept is None:
        kept = KeptFactor(known, problem.mesh.element.dim, settings.residual_tolerance)
    if tangent is not None and rules.predicts(problem.loads):
        near = kept.near(u, 1.0, 0.0)
        du, negative, new = step(problem, prepared, tangent, state.residual, move, near)
        kept.renew(new, u)
        if du is not None:
            u, before, state, size = _advance(problem, prepared, u, du)
            move = left_to_move(known, known_values, u)
    while True:
        ratio, still = imbalance(state), not np.any(move)
        reason, du = verdict(state, size, still, iterations, settings), None
        if reason is None:
            near = kept.near(u, ratio, size)
            args = state.values, state.residual, move, near
            du, negative, new = step(problem, prepared, *args)
            kept.renew(new, u)
            reason = problem.space.system.unsolved
        if du is None:
            values = None if reason else state.values
            return Iterate(u, values, iterations, ratio, negative, reason, kept)
        iterations += 1
        tell(iterations, imbalance=ratio)
        if overshoots(problem) and still:
            args = (problem, prepared.known, state.residual, from_host(u), from_host(du))
            du = float(share_of_step(*args)) * du
        u, before, state, size = _advance(problem, prepared, u, du)
        move = left_to_move(known, known_values, u)


def imbalance(state: Linearised) -> float:
    """Largest unbalanced force over the load or reaction that it is judged by; itself where
    there is none [N]."""
    norm, reference = float(state.residual_norm), float(state.reference)
    return norm / reference if reference > 0 else norm


def verdict(
    state: Linearised, size: float, still: bool, iterations: int, settings: Newton
) -> str | None:
    """Why a search ends at an iterate, nothing where that is the answer; `None` to go on."""
    norm, tolerance = float(state.residual_norm), settings.residual_tolerance
    if not rules.sound(norm, float(state.volume_ratio)):
        return "an element inverts"
    small = rules.balanced(norm, float(state.reference), float(state.rounding), tolerance)
    if rules.converged(small, size, still, settings):
        return ""
    if iterations >= settings.max_iterations:
        return f"no convergence in {iterations} Newton iterations"
    return None


def left_to_move(known: np.ndarray, known_values: np.ndarray, u: np.ndarray) -> np.ndarray:
    """How far supports are from where they should be [m]."""
    return rules.left_to_move(np.where(known, known_values - u.ravel(), 0.0), known_values)


def _advance(problem: Problem, prepared: Prepared, u: np.ndarray, du: np.ndarray):
    """The state after a step, shortened where a cell would collapse."""
    new = u + du
    state = linearise(problem, prepared, new, u)
    if not rules.keeps_volume(float(state.volume_ratio)):
        new = u + float(safe_fraction(problem, prepared, u, du)) * du
        state = linearise(problem, prepared, new, u)
    return new, u, state, rules.relative_size(du, new, float(prepared.length))


def safe_fraction(problem: Problem, prepared: Prepared, u, du) -> Float[Array, ""]:
    """Fraction of a step `du` [m] from `u` [m] that keeps enough of every volume."""
    args = (problem.space, prepared.geometry, problem.kinematics, from_host(u))
    share = finite_share(problem.material)
    longest = asm.largest_step(*args, from_host(du), keep=rules.LEAST_VOLUME, share=share)
    return rules.SAFE * longest
