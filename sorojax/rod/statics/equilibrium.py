"""Equilibrium of a rod or an assembly under its forces."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float, Int

from sorojax import _check
from sorojax._types import real
from sorojax.math.compiled import door
from sorojax.math.implicit_root import implicit_root
from sorojax.math.status import Status
from sorojax.rod.forces.loads import Load, total_force
from sorojax.rod.model.assembly import dtype_of, num_coordinates, rest as at_rest
from sorojax.rod.model.model import Model, motion, operators
from sorojax.rod.statics.tangent import (
    increments,
    is_unstable,
    linearised,
    metric,
    moved,
    negative_eigenvalues,
    squared,
    unit_energy,
)
from sorojax.rod.statics.validity import checked_status

_DECREASE = 1e-4  # Armijo: share of the promised decrease that a step must give
_SHORTEST = 1e-3  # of a Newton step

Residual = Callable[[Array], Array]


class Equilibrium(eqx.Module):
    """Where a search for rest ended.

    Attributes:
        q: Coordinates.
        status: How it ended.
        num_iterations: Of Newton.
        negative: Negative eigenvalues of the symmetric part of the tangent; 0 is stable. A
            straight column past its critical load has one, and the status
            `unstable_equilibrium`.
    """

    q: Float[Array, " coordinates"]
    status: Status
    num_iterations: Int[Array, ""]
    negative: Int[Array, ""]


class Search(NamedTuple):
    """Settings and scales of a Newton search.

    Attributes:
        model: The rod or assembly.
        metric: Measures increments, in energy.
        floor: Energy of an increment that is nothing but rounding.
        tolerance: Size of the last step relative to the strained shape.
        max_iterations: Limit of the search.
    """

    model: Model
    metric: Float[Array, "dof dof"]
    floor: Float[Array, ""]
    tolerance: Float[Array, ""]
    max_iterations: int


class Found(NamedTuple):
    """Where a search ended, and the tangent of its last step."""

    q: Float[Array, " coordinates"]
    slope: Float[Array, "dof dof"]
    done: Bool[Array, ""]
    count: Int[Array, ""]


@door
def equilibrium(
    model: Model,
    forces: tuple[Load, ...] = (),
    q: Float[Array, " coordinates"] | None = None,
    *,
    t=0.0,
    tolerance=1e-10,
    max_iterations: int = 50,
) -> Equilibrium:
    """Static equilibrium: coordinates at which the generalised forces vanish.

    Newton's method with the exact tangent and a line search on the residual, measured by the
    elastic energy that it would store. The derivative in model and forces is that of the
    implicit function, not of the iterations. Where the search fails, `equilibrium_path` applies
    the load in steps.

    Args:
        model: The rod or assembly.
        forces: Generalised forces beside elasticity: `Gravity()`, `TipWrench(...)`,
            `Tendons(...)`, contacts, ...; none by default.
        q: First guess, curvature modes in [1/m]; at rest by default.
        t: Time at which the forces act [s].
        tolerance: Size of the last step relative to q, both in elastic energy norm [-].
        max_iterations: Limit of the search.

    Returns:
        Coordinates, how the search ended, and the number of negative eigenvalues of the tangent
        (0 where stable). Nothing is raised where no equilibrium is found: check `status`.

    Raises:
        ValueError: If `q` has the wrong shape.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> rest = rod.equilibrium(finger, (rod.Gravity(),))
        >>> print(f"{float(rod.tip_pose(finger, rest.q)[1, 2]) / mm:.1f} mm")
        -19.0 mm

    Reference:
        Nocedal and Wright, Numerical Optimization, 2006, chapter 11.
    """
    constants, t = operators(model), real(t).astype(dtype_of(model))
    guess = first_guess("equilibrium", model, q)
    search = prepare(model, constants, tolerance, max_iterations)

    def residual(q: Array) -> Array:
        return -total_force(forces, t, motion(model, q, constants=constants))

    def find(_, guess):
        found = newton(residual, guess, search)
        # What comes with a root has a derivative of zero, so it is floating.
        ends = (found.done, found.count, *stability(found.slope, search))
        return found.q, tuple(x.astype(guess.dtype) for x in ends)

    rest, (done, count, negative, unstable) = implicit_root(
        lambda q: squared(model, q, residual(q)), guess, find, _solve_tangent, has_aux=True
    )
    status = checked_status(ended(done, rest, residual(rest), unstable=unstable), model, rest)
    return Equilibrium(rest, status, count.astype(jnp.int32), negative.astype(jnp.int32))


def first_guess(where: str, model: Model, q: Array | None) -> Float[Array, " coordinates"]:
    """The guess of a search, or the model at rest."""
    if q is None:
        return at_rest(model)
    do = "It is a guess of the coordinates; leave it out to start from rest."
    _check.shape(where, "q", q, (num_coordinates(model),), do)
    return real(q).astype(dtype_of(model))


def prepare(model: Model, constants, tolerance, max_iterations: int) -> Search:
    """A search for the equilibria of `model`; its metric takes no part in derivatives."""
    measure = jax.lax.stop_gradient(metric(model, constants))
    rounding = 4 * float(jnp.finfo(measure.dtype).eps)
    # Forces far larger than those of the rod, as of a stiff pin, leave rounding of their own.
    floor = (16 * rounding) ** 2 * jax.lax.stop_gradient(unit_energy(model, measure))
    tolerance = jnp.maximum(real(tolerance).astype(measure.dtype), 16 * rounding)
    return Search(model, measure, floor, tolerance, max_iterations)


def newton(residual: Residual, guess: Array, search: Search) -> Found:
    """A root of `residual`, by Newton with backtracking."""
    factor = cho_factor(search.metric)

    def size(force):
        return force @ cho_solve(factor, force)

    def improve(state):
        q, _, _, _, count = state
        force, slope = linearised(residual, search.model, q)
        step = -jnp.linalg.solve(slope, force)
        shape = increments(search.model, q)
        strained = shape @ search.metric @ shape
        small = step @ search.metric @ step <= search.tolerance**2 * strained + search.floor
        start = size(force)

        def too_long(trial):
            length, value = trial
            enough = value <= (1 - 2 * _DECREASE * length) * start
            return ~enough & (length > _SHORTEST)

        def at(length):
            return length, size(residual(moved(search.model, q, length * step)))

        one = jnp.ones((), q.dtype)
        # A step of rounding is nothing but noise: it is taken as it is.
        first = jax.lax.cond(small, lambda: (one, 0 * start), lambda: at(one))
        length, value = jax.lax.while_loop(too_long, lambda trial: at(trial[0] / 2), first)
        good = value <= start
        new = jnp.where(good, moved(search.model, q, length * step), q)
        return new, slope, small & good, ~good, count + 1

    def searching(state):
        _, _, done, stuck, count = state
        return ~done & ~stuck & (count < search.max_iterations)

    no = jnp.array(False)
    begin = (guess, search.metric, no, no, jnp.array(0, dtype=jnp.int32))
    q, slope, done, _, count = jax.lax.while_loop(searching, improve, begin)
    return Found(q, slope, done & jnp.all(jnp.isfinite(q)), count)


def stability(
    slope: Float[Array, "dof dof"], search: Search
) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """Negative eigenvalues at the end of a search, and whether they make it unstable."""
    negative = negative_eigenvalues(slope, search.metric)
    return negative, is_unstable(slope, search.metric, negative)


def ended(done: Array, *values: Array, unstable: Array | bool = False) -> Status:
    """The status of a search, given what must be finite."""
    finite = jnp.array(True)
    for value in values:
        finite = finite & jnp.all(jnp.isfinite(value))
    failed = Status.where(finite, Status.not_converged, Status.not_finite)
    good = Status.where(
        jnp.asarray(unstable).astype(bool), Status.unstable_equilibrium, Status.successful
    )
    return Status.where(finite & done.astype(bool), good, failed)


def _solve_tangent(linear, right: Array) -> Array:
    return jnp.linalg.solve(jax.jacobian(linear)(right), right)
