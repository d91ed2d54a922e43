"""Equilibria under loads that are applied in steps, and along a curve in coordinates and load,
over limit points.

Reference:
    Riks, "An incremental approach to the solution of snapping and buckling problems",
    Int. J. Solids and Structures 15, 1979.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax._display import number, outcome, printed
from sorojax._types import Numbers, real
from sorojax.math.compiled import jit_public
from sorojax.math.host import tell
from sorojax.math.implicit_root import implicit_root
from sorojax.math.status import Status
from sorojax.rod.forces.loads import Load, relaxed
from sorojax.rod.model.assembly import dtype_of
from sorojax.rod.model.model import Model, operators
from sorojax.rod.statics.equilibrium import (
    Search,
    checked_status,
    ended,
    first_guess,
    linearised,
    negative_eigenvalues,
    newton,
    prepare,
    squared,
    stability,
)
from sorojax.rod.statics.loops import (
    advanced,
    reactions_at,
    unbalanced,
    within_closures,
    without_reactions,
)

Loading = Callable[[Array], tuple[Load, ...]]


@printed
class Path(eqx.Module):
    """Equilibria along a path of loads.

    Where a search fails, the path stops: the rest of `q` repeats the last equilibrium
    and says so in `status`. A state that is in balance without being stable is an
    `unstable_equilibrium`; the path goes on.

    Attributes:
        q: Coordinates.
        status: How each search ended.
        factors: Load factors, one or a row of them for each step.
        negative_eigenvalues: Of the symmetric part of the tangent; 0 is stable under dead
            loads.
        iterations: Of Newton's method; of a path by arc lengths the corrections.
        reactions: Wrenches of closures by name, as in `equilibrium`; None without any.
    """

    q: Float[Array, "steps coordinates"]
    status: Status
    factors: Float[Array, "steps *loads"]
    negative_eigenvalues: Int[Array, " steps"]
    iterations: Int[Array, " steps"]
    reactions: dict[str, Float[Array, "steps twist"]] | None = None

    def _text(self) -> str:
        count = self.q.shape[0]
        return (
            f"Path: {count} states, {outcome(self.status)}, q {number(self.q)}\n  factors "
            f"{number(self.factors)}, negative eigenvalues {number(self.negative_eigenvalues)}"
        )


@jit_public
def equilibrium_path(
    model: Model,
    loading: Loading,
    factors: Float[Array, "steps *loads"],
    q: Float[Array, " coordinates"] | None = None,
    *,
    begin: Numbers | None = None,
    t: Numbers | Callable[[Array], Array] = 0.0,
    tolerance=1e-10,
    max_iterations: int = 25,
    max_cuts: int = 8,
    progress: bool = False,
) -> Path:
    """Equilibria at given load factors, each search started from the equilibrium before.

    A step whose search fails is halved, all in one compiled loop. Differentiable as
    `equilibrium` is, in all that `loading` holds.

    Args:
        model: The rod or assembly.
        loading: Takes a factor [-], or a row of pressures [Pa], to the forces. Define it once:
            a new function compiles anew.
        factors: Load factors, or one row of them for each step, in the unit that `loading`
            takes.
        q: Equilibrium to start from; at rest by default.
        begin: Factors at `q`; zero by default.
        t: Time at which forces act and closures are moved [s], or a function of the factor
            that gives it: `lambda factor: factor` takes driven ends along their motion.
        tolerance: Size of the last step relative to q, both in elastic energy norm [-].
        max_iterations: Limit of one search.
        max_cuts: How often a step may be halved.
        progress: Report progress while running; under `vmap` in one report.

    Returns:
        Coordinates at each factor and how each search ended. The path stops at a search that
        fails: the rest repeats the last equilibrium and says so in `status`.

    Raises:
        ValueError: If `q` has the wrong shape.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> def loading(factor):
        ...     return (rod.Gravity([0.0, -9.81 * factor]),)
        >>> path = rod.equilibrium_path(finger, loading, jnp.array([0.5, 1.0]))
        >>> [round(float(rod.tip_pose(finger, q)[1, 2]) / mm, 1) for q in path.q]
        [-9.7, -19.0]
    """
    constants, dtype = operators(model), dtype_of(model)
    factors, time_at = real(factors).astype(dtype), _time_of(t, dtype)
    guess = without_reactions(model, first_guess("equilibrium_path", model, q))
    search = prepare(model, constants, tolerance, max_iterations)
    first = jnp.zeros_like(factors[0]) if begin is None else real(begin).astype(dtype)

    def residual(x: Array, factor: Array) -> Array:
        forces = relaxed(loading(factor))
        return unbalanced(model, constants, forces, time_at(factor), x, search.metric)

    shares = jnp.linspace(0.0, 1.0, len(factors) + 1, dtype=dtype)[1:]

    def find(_, guesses):
        def advance(state, row):
            (q, last, alive), (target, share) = state, row
            new, done, *more = _step(residual, q, last, target, alive, search, max_cuts)
            if progress:
                tell("equilibrium path", share)
            ends = tuple(x.astype(dtype) for x in (done, *more))
            return (new, target, done), (new, ends)

        start = (guesses[0], first, jnp.array(True))
        return jax.lax.scan(advance, start, (factors, shares))[1]

    def balance(q):
        return jax.vmap(lambda q, f: squared(model, q, residual(q, f)))(q, factors)

    guesses = jnp.broadcast_to(guess, (factors.shape[0], guess.shape[0]))

    rest, (done, finite, count, negative, unstable) = implicit_root(
        balance, guesses, find, _solve_rows, has_aux=True
    )
    status = jax.vmap(lambda done, q, f, u: ended(done, q, finite=f, unstable=u))(
        done, rest, finite, unstable
    )
    q, reactions = _reactions(model, constants, time_at, rest, factors)
    status = jax.vmap(lambda x, q: checked_status(x, model, q))(status, q)
    counts = (x.astype(jnp.int32) for x in (negative, count))
    return Path(q, status, factors, *counts, reactions)


def _step(residual, q: Array, last: Array, target: Array, alive, search: Search, max_cuts: int):
    """From the equilibrium `q` at `last` to `target`, in as few parts as converge."""
    whole = jnp.ones((), q.dtype)
    shortest = 0.5**max_cuts

    def going(state):
        _, at, part, *_ = state
        return alive & (at < 1) & (part >= shortest)

    def advance(state):
        q, at, part, _, count, slope = state
        aim = jnp.minimum(at + part, whole)
        factor = last + aim * (target - last)
        found = newton(lambda q: residual(q, factor), q, search)
        good = found.done
        new = jnp.where(good, found.q, q), jnp.where(good, aim, at)
        slope = jnp.where(good, found.slope, slope)
        part = jnp.where(good, 2 * part, part / 2)
        return *new, part, found.finite, count + found.count, slope

    state = (q, 0 * whole, whole, jnp.array(True), jnp.array(0, jnp.int32), search.metric)
    q, at, _, finite, count, slope = jax.lax.while_loop(going, advance, state)
    return q, alive & (at >= 1), finite, count, *stability(slope, search)


def _time_of(t: Numbers | Callable[[Array], Array], dtype: Any) -> Callable[[Array], Array]:
    """Time as a function of the factor."""
    if callable(t):
        return lambda factor: real(t(factor)).astype(dtype)
    return lambda _: real(t).astype(dtype)


def _reactions(model: Model, constants: Any, time_at, x: Array, factors: Array):
    """Coordinates, and wrenches of the closures by name, of all steps."""
    return jax.vmap(lambda x, f: reactions_at(model, constants, time_at(f), x))(x, factors)


def _solve_rows(linear, right: Float[Array, "steps unknowns"]) -> Array:
    """The steps do not see each other: one small system each, all at once."""
    eye = jnp.eye(right.shape[1], dtype=right.dtype)
    columns = jax.vmap(lambda e: linear(jnp.broadcast_to(e, right.shape)))(eye)
    return jnp.linalg.solve(jnp.moveaxis(columns, 0, 2), right[:, :, None])[:, :, 0]


# Equilibria along a curve in coordinates and load: over limit points


_ITERATIONS = 12
_EASY = 5  # corrections below which the next step is longer


class _Point(NamedTuple):
    q: Array
    factor: Array
    direction: Array  # of the path: increments, then the factor, of unit length
    length: Array
    alive: Array


@jit_public
def arc_length_path(
    model: Model,
    loading: Loading,
    q: Float[Array, " coordinates"] | None = None,
    *,
    factor=0.0,
    first=0.1,
    steps: int = 50,
    longest=2.0,
    t: Numbers | Callable[[Array], Array] = 0.0,
    tolerance=1e-10,
    max_cuts: int = 10,
    progress: bool = False,
) -> Path:
    """Equilibria one arc length apart, through limit points, where the load turns back.

    Lengths are measured in elastic energy, so that a step of the factor and the answer of
    the rod to it at the start count the same. Steps shrink where the search is hard and
    grow where it is easy. Not differentiable: start `equilibrium` from a point of it.

    Args:
        model: The rod or assembly.
        loading: Takes a factor to the forces.
        q: Where to start the search for the first equilibrium; at rest if omitted.
        factor: Load factor there.
        first: Step of the factor at the start; negative to unload.
        steps: Number of steps.
        longest: Longest step relative to the first.
        t: Time at which forces act and closures are moved [s], or a function of the factor.
        tolerance: Distance from equilibrium relative to the first step.
        max_cuts: How often a step may be halved.
        progress: Report progress while running; under `vmap` in one report.

    Returns:
        Load factors, coordinates and how each search ended, from the first equilibrium on.
    """
    constants, dtype = operators(model), dtype_of(model)
    factor, first, longest = (real(x).astype(dtype) for x in (factor, first, longest))
    time_at = _time_of(t, dtype)
    search = prepare(model, constants, tolerance, 50)

    def residual(x: Array, factor: Array) -> Array:
        forces = relaxed(loading(factor))
        return unbalanced(model, constants, forces, time_at(factor), x, search.metric)

    def tangent(q, factor):
        """Residual, its tangent and its change with the factor."""
        one = jnp.ones_like(factor)
        value, slope = linearised(lambda q: residual(q, factor), model, q)
        return value, slope, jax.jvp(lambda f: residual(q, f), (factor,), (one,))[1]

    guess = without_reactions(model, first_guess("arc_length_path", model, q))
    start = newton(lambda q: residual(q, factor), guess, search)
    _, slope, rate = tangent(start.q, factor)
    answer = -jnp.linalg.solve(slope, rate)
    unit = answer @ search.metric @ answer
    # Lengths squared: increments in energy over `unit`, the factor as it is.
    weights = jnp.pad(search.metric / unit, (0, 1)).at[-1, -1].set(1.0)
    direction = _unit(jnp.append(answer, 1.0), weights) * jnp.sign(first)
    begin = jnp.abs(first) * jnp.sqrt(jnp.asarray(2.0, dtype))

    def with_plane(slope, rate, normal):
        return jnp.concatenate([jnp.append(slope, rate[:, None], axis=1), normal[None]])

    def correct(point: _Point, length):
        """The equilibrium on the plane across the path at `length`."""
        normal = weights @ point.direction

        def at(shift):
            return advanced(model, point.q, shift[:-1]), point.factor + shift[-1]

        def improve(state):
            shift, _, count = state
            value, slope, rate = tangent(*at(shift))
            # The tangent is taken at the shifted place; increments add up to first order.
            gap = jnp.append(value, normal @ shift - length)
            step = -jnp.linalg.solve(with_plane(slope, rate, normal), gap)
            return shift + step, jnp.sqrt(step @ weights @ step), count + 1

        def searching(state):
            _, size, count = state
            return (size > search.tolerance * begin) & (count < _ITERATIONS)

        state = (length * point.direction, jnp.inf * begin, jnp.array(0))
        shift, size, count = jax.lax.while_loop(searching, improve, state)
        near = jnp.sqrt(shift @ weights @ shift) < 3 * length  # the same branch
        return *at(shift), (size <= search.tolerance * begin) & near, count

    def advance(point: _Point, share):
        def going(state):
            _, _, length, done, _ = state
            return point.alive & ~done & (length > begin * 0.5**max_cuts)

        def attempt(state):
            _, _, length, _, _ = state
            q, factor, done, count = correct(point, length)
            return q, factor, jnp.where(done, length, length / 2), done, count

        state = (point.q, point.factor, point.length, jnp.array(False), jnp.array(0))
        q, factor, length, done, count = jax.lax.while_loop(going, attempt, state)
        q, factor = jnp.where(done, q, point.q), jnp.where(done, factor, point.factor)
        _, slope, rate = tangent(q, factor)
        border = with_plane(slope, rate, weights @ point.direction)
        right = jnp.zeros_like(point.direction).at[-1].set(1.0)
        direction = _unit(jnp.linalg.solve(border, right), weights)
        length = jnp.where(count <= _EASY, 1.5 * length, length)
        new = _Point(q, factor, direction, jnp.minimum(length, longest * begin), done)
        negative = negative_eigenvalues(*within_closures(model, slope, search.metric))
        if progress:
            tell("arc length path", share)
        end = ended(done, q, finite=jnp.all(jnp.isfinite(rate)))
        return new, (q, end, factor, negative, count.astype(jnp.int32))

    point = _Point(start.q, factor, direction, begin, start.done)
    shares = jnp.linspace(0.0, 1.0, steps + 1, dtype=dtype)[1:]
    _, (q, status, *rest) = jax.lax.scan(advance, point, shares)
    q, reactions = _reactions(model, constants, time_at, q, rest[0])
    status = jax.vmap(lambda x, q: checked_status(x, model, q))(status, q)
    return Path(q, status, *rest, reactions)


def _unit(vector: Array, weights: Array) -> Array:
    return vector / jnp.sqrt(vector @ weights @ vector)
