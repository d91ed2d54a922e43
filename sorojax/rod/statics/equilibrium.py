"""Equilibrium of a rod or an assembly under its forces; whether an answer lies within what a
rod model describes; increments, tangents and units, which all searches over coordinates share.

Coordinates may outnumber rates, as a quaternion does: searches step in the rates' dimension,
and a root is found in as many equations as there are coordinates.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float, Int

from sorojax import _check
from sorojax._display import number, outcome, printed
from sorojax._types import real
from sorojax.math.compiled import floats_traced, full_products
from sorojax.math.implicit_root import implicit_root, matrix_of
from sorojax.math.quadrature import gauss_legendre, interpolation_rows
from sorojax.math.status import Status
from sorojax.math.two_programs import two_programs
from sorojax.rod.dynamics.fields import is_curvature, strains_at
from sorojax.rod.dynamics.tree import rod_motion
from sorojax.rod.forces.loads import Load, relaxed
from sorojax.rod.model.assembly import (
    dtype_of,
    is_flat,
    num_coordinates,
    num_dof,
    rest,
    rest as at_rest,
    slices,
)
from sorojax.rod.model.model import Model, inertia, motion, operators
from sorojax.rod.model.rod import Rod, strain_names
from sorojax.rod.statics.loops import (
    advanced,
    reactions_at,
    strained,
    unbalanced,
    with_reactions,
    within_closures,
    without_reactions,
)

_RESOLVED = 1e-3  # of the length: what the quadrature may leave of a rod's tip
_LONGEST = 10.0  # stretch [-]: no solid of a soft robot keeps together beyond


def checked_status(
    status: Status, model: Model, path: Float[Array, "*states coordinates"]
) -> Status:
    """`status`, or what is wrong with an answer that is called successful.

    It is `inverted` where a rod is turned inside out, `outside_model` where it is stretched
    more than tenfold, `unresolved` where twice as many nodes would put its tip elsewhere. Of a
    path the last is looked for at the most strained state alone.

    Args:
        status: Of the search or run.
        model: The rod or assembly.
        path: Coordinates of the answer, or of all saved states.
    """
    path = jax.lax.stop_gradient(jnp.atleast_2d(path))
    good = status == Status.successful
    for rod, at in _rods(model):
        rod = jax.lax.stop_gradient(rod)
        own = path[:, at]
        largest = own[jnp.argmax(jnp.sum(own**2, axis=1))] if len(own) > 1 else own[0]
        stretch, least = jax.vmap(lambda q: _stretches(rod, q))(own)  # noqa: B023
        for wrong, found in (
            (~is_resolved(rod, largest), Status.unresolved),
            (jnp.any(stretch > _LONGEST), Status.outside_model),
            (jnp.any(least <= 0), Status.inverted),
        ):
            status = Status.where(good & wrong, found, status)
    return status


def _stretches(rod: Rod, q: Array) -> tuple[Float[Array, " quad"], Float[Array, " quad"]]:
    """Stretch at every node, along the axis and the least at the distance from it that the
    section has in the mean (its radius of gyration)."""
    section, zero, (rest, rows) = rod.section, jnp.zeros((), q.dtype), strains_at(rod)
    strain = dict(zip(strain_names(rod.group), (rest + rows @ q).T, strict=True))
    about_y = strain.get("kappa_y", zero) ** 2 * section.second_moment_y
    about_z = strain.get("kappa_z", zero) ** 2 * section.second_moment_z
    bent = jnp.sqrt((about_y + about_z) / section.area)
    return strain["sigma_x"], strain["sigma_x"] - bent


def is_resolved(rod: Rod, q: Float[Array, " dof"]) -> Bool[Array, ""]:
    """Whether twice as many nodes would move the tip by less than a thousandth of the length
    of the rod."""
    distance = _tip(finer(rod), q) - _tip(rod, q)
    return jnp.sum(distance**2) <= (_RESOLVED * rod.length) ** 2


def finer(rod: Rod) -> Rod:
    """The shape of the rod at twice as many nodes; its section and material are means."""
    mean: Any = lambda x: jnp.mean(x, keepdims=False)  # noqa: E731
    section, material = jax.tree.map(mean, (rod.section, rod.material))
    rest, count = rod.rest_strain, 2 * rod.nodes
    twice = Rod(rod.group, rod.basis, section, material, rod.length, None, count, rod.breaks)
    if rest is None or rest.ndim == 1:
        varied = rest
    else:
        nodes, _ = gauss_legendre(twice.quadrature)
        varied = rest @ jnp.asarray(interpolation_rows(rod.quadrature, nodes), rest.dtype).T
    return Rod(rod.group, rod.basis, section, material, rod.length, varied, count, rod.breaks)


def _tip(rod: Rod, q: Array) -> Float[Array, " dim"]:
    moment = rod_motion(rod, q)
    return moment.operators.weights @ moment.tangent


def _rods(model: Model) -> list[tuple[Rod, slice]]:
    """The rods of a model, and where their coordinates are."""
    if isinstance(model, Rod):
        return [(model, slice(None))]
    parts = zip(model.parts, slices(model), strict=True)
    return [(p.body, at.rod_q) for p, at in parts if isinstance(p.body, Rod)]


_INERTIA_SHARE = 1e-6  # of the mean square frequency, for joints without a spring


def squared(model: Model, x: Array, residual: Float[Array, " unknowns"]) -> Array:
    """As many equations as unknowns: the residual along the coordinates that it can
    move, and the norm of a quaternion along the one it cannot."""
    if is_flat(model):
        return residual
    still = jnp.zeros_like(residual)
    normal, along = jax.jvp(lambda d: advanced(model, x, d), (still,), (residual,))
    return along + x - normal


def linearised(
    residual: Callable[[Array], Array], model: Model, x: Array
) -> tuple[Float[Array, " unknowns"], Float[Array, "unknowns unknowns"]]:
    """A residual and its exact tangent, one forward pass for all columns."""

    def along(increment):
        value = residual(advanced(model, x, increment))
        return value, value

    still = jnp.zeros(num_dof(model) + x.shape[0] - num_coordinates(model), x.dtype)
    slope, value = jax.jacfwd(along, has_aux=True)(still)
    return value, slope


def negative_eigenvalues(
    slope: Float[Array, "dof dof"], metric: Float[Array, "dof dof"]
) -> Int[Array, ""]:
    """Of the symmetric part, beyond rounding."""
    slope = _scaled(slope, metric)
    values = jnp.linalg.eigvalsh((slope + slope.T) / 2)
    rounding = 32 * jnp.finfo(slope.dtype).eps * jnp.max(jnp.abs(values))
    return jnp.sum(values < -rounding, dtype=jnp.int32)


def is_unstable(
    slope: Float[Array, "dof dof"], metric: Float[Array, "dof dof"], negative: Int[Array, ""]
) -> Bool[Array, ""]:
    """Whether a state of this tangent is surely left.

    Under loads that have a potential by a negative eigenvalue. Loads that follow the body make
    the tangent unsymmetric; then one real negative eigenvalue, as a negative determinant tells:
    the symmetric part may have one where the state is stable.

    Reference: Bolotin, "Nonconservative Problems of the Theory of Elastic Stability", 1963.
    """
    slope = _scaled(slope, metric)
    share = float(jnp.finfo(slope.dtype).eps) ** 0.5
    apart = jnp.max(jnp.abs(slope - slope.T)) > share * jnp.max(jnp.abs(slope))
    # The determinant waits for the eigenvalues: batches of both at a time can lock the threads
    # of a CPU (jaxlib 0.10.2, 14 matrices of 38 rows on two cores).
    asked = jnp.where(negative > 0, slope, jnp.eye(slope.shape[0], dtype=slope.dtype))
    sign, _ = jnp.linalg.slogdet(asked)
    return (negative > 0) & (~apart | (sign < 0))


def _scaled(slope: Array, metric: Array) -> Array:
    """Without units: strains and bends differ by many orders."""
    scale = jnp.sqrt(jnp.diag(metric))
    return slope / (scale[:, None] * scale[None])


def metric(model: Model, constants) -> Float[Array, "dof dof"]:
    """Positive matrix that measures increments in energy.

    The elastic stiffness; in an assembly with a share of the inertia at rest, as a joint
    without a spring has none.
    """
    stiffness = constants.stiffness
    if isinstance(model, Rod):
        return stiffness
    mass, _ = inertia(motion(model, rest(model), constants=constants))
    square = jnp.trace(jnp.linalg.solve(mass, stiffness)) / stiffness.shape[0]
    share = jnp.where(square > 0, _INERTIA_SHARE * square, jnp.ones_like(square))
    return stiffness + share * mass


def unit_energy(model: Model, metric: Float[Array, "..."]) -> Float[Array, ""]:
    """Size of `metric` at a bend of one radian and a strain of one."""
    units = _units(model)
    return jnp.diag(metric)[: units.shape[0]] @ units**2


def _units(model: Model) -> Float[Array, " dof"]:
    if isinstance(model, Rod):
        basis, one = model.basis, jnp.ones((), model.length.dtype)
        sizes = [one / model.length if is_curvature(name) else one for name in basis.active]
        counts = [basis.modes[name].count for name in basis.active]
        return jnp.concatenate([jnp.full(n, x) for n, x in zip(counts, sizes, strict=True)])
    units = jnp.ones(num_dof(model), dtype_of(model))
    for part, at in zip(model.parts, slices(model), strict=True):
        if isinstance(part.body, Rod):
            units = units.at[at.rod_v].set(_units(part.body))
    return units


_DECREASE = 1e-4  # Armijo: share of the promised decrease that a step must give
_SHORTEST = 1e-3  # of a Newton step

Residual = Callable[[Array], Array]


@printed
class Solution(eqx.Module):
    """The state at which a search over coordinates ended.

    Attributes:
        q: Coordinates.
        status: How it ended.
        iterations: Of Newton's method, or of inverse kinematics.
        negative_eigenvalues: Of an equilibrium: how many the symmetric part of the tangent
            has; 0 is stable. A straight column past its critical load has one, and the status
            `unstable_equilibrium`.
        error: Of inverse kinematics: norm of the weighted errors of all targets [m].
        overlap: Of inverse kinematics: by how much the worst section misses its distance to
            an obstacle [m].
        reactions: Of an equilibrium: wrench of each closure on the part that it holds, by
            name [N m], [N], world axes, the moment about the frame held; None without any.
    """

    q: Float[Array, " coordinates"]
    status: Status
    iterations: Int[Array, ""]
    negative_eigenvalues: Int[Array, ""] | None = None
    error: Float[Array, ""] | None = None
    overlap: Float[Array, ""] | None = None
    reactions: dict[str, Float[Array, " twist"]] | None = None

    def _text(self) -> str:
        ways = f"{outcome(self.status)} after {number(self.iterations)} iterations"
        error = "" if self.error is None else f", error {number(self.error, 'm')}"
        return f"Solution: {ways}, q {number(self.q)}{error}"


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
    """Where a search ended, the tangent of its last step, whether its residual was finite."""

    q: Float[Array, " coordinates"]
    slope: Float[Array, "dof dof"]
    done: Bool[Array, ""]
    finite: Bool[Array, ""]
    count: Int[Array, ""]


@floats_traced
@functools.partial(two_programs, keeps=True, lanes_apart=True, kernels=True)
@full_products
def equilibrium(
    model: Model,
    forces: tuple[Load, ...] = (),
    q: Float[Array, " coordinates"] | None = None,
    *,
    t=0.0,
    tolerance=1e-10,
    max_iterations: int = 50,
) -> Solution:
    """Static equilibrium: coordinates at which the generalised forces vanish.

    Newton's method with the exact tangent and a line search on the residual, measured by the
    elastic energy that it would store; the reactions of closures are unknowns beside the
    coordinates. The derivative in model and forces is that of the implicit function, not of the
    iterations. Where the search fails, `equilibrium_path` applies the load in steps.

    Args:
        model: The rod or assembly.
        forces: Generalised forces beside elasticity: `Gravity()`, `TipWrench(...)`,
            `Tendons(...)`, contacts, ...; none by default.
        q: First guess, curvature modes in [1/m]; at rest by default.
        t: Time at which the forces act [s].
        tolerance: Size of the last step relative to q, both in elastic energy norm [-].
        max_iterations: Limit of the search.

    Returns:
        Coordinates, how the search ended, the number of negative eigenvalues of the tangent
        (0 where stable; of motions that keep loops closed), and the reactions of closures by
        name. Nothing is raised where no equilibrium is found: check `status`.

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
    guess = without_reactions(model, first_guess("equilibrium", model, q))
    search = prepare(model, constants, tolerance, max_iterations)

    def residual(x: Array) -> Array:
        return unbalanced(model, constants, relaxed(forces), t, x, search.metric)

    flat = is_flat(model)

    def find(_, guess, at_root=None):
        found = newton(residual, guess, search, at_root=at_root)
        # What comes with a root has a derivative of zero, so it is floating.
        ends = (found.done, found.finite, found.count, *stability(found.slope, search))
        answer = found.q, tuple(x.astype(guess.dtype) for x in ends)
        return (answer, found.slope) if flat else answer

    rest, (done, finite, count, negative, unstable) = implicit_root(
        lambda q: squared(model, q, residual(q)),
        guess,
        find,
        _solve_tangent,
        has_aux=True,
        has_matrix=flat,
    )
    q, reactions = reactions_at(model, constants, t, rest)
    status = checked_status(ended(done, rest, finite=finite, unstable=unstable), model, q)
    counts = (x.astype(jnp.int32) for x in (count, negative))
    return Solution(q, status, *counts, reactions=reactions)


def first_guess(where: str, model: Model, q: Array | None) -> Float[Array, " coordinates"]:
    """The guess of a search, or the model at rest."""
    if q is None:
        return at_rest(model)
    do = "It is a guess of the coordinates; leave it out to start from rest."
    _check.shape(where, "q", q, (num_coordinates(model),), do)
    return real(q).astype(dtype_of(model))


def prepare(model: Model, constants, tolerance, max_iterations: int) -> Search:
    """A search for the equilibria of `model`; its metric takes no part in derivatives."""
    measure = jax.lax.stop_gradient(with_reactions(model, metric(model, constants)))
    rounding = 4 * float(jnp.finfo(measure.dtype).eps)
    # Forces far larger than those of the rod, as of a stiff pin, leave rounding of their own.
    floor = (16 * rounding) ** 2 * jax.lax.stop_gradient(unit_energy(model, measure))
    tolerance = jnp.maximum(real(tolerance).astype(measure.dtype), 16 * rounding)
    return Search(model, measure, floor, tolerance, max_iterations)


class _Pass(NamedTuple):
    """Newton's method on its way: the next pass tries a `length` of `step` from `q`.

    `size` is that of the residual at `q` and `slope` its tangent there. A `small` step is
    nothing but rounding; it is taken as it is.
    """

    q: Float[Array, " unknowns"]
    step: Float[Array, " unknowns"]
    slope: Float[Array, "unknowns unknowns"]
    length: Float[Array, ""]
    size: Float[Array, ""]
    small: Bool[Array, ""]
    ended: Bool[Array, ""]
    count: Int[Array, ""]


def newton(
    residual: Residual, guess: Array, search: Search, *, at_root: Bool[Array, ""] | None = None
) -> Found:
    """A root of `residual`, by Newton with backtracking; where it is asked for, one more pass
    finds the tangent `at_root`."""
    once_more = jnp.array(False) if at_root is None else at_root
    factor, model = cho_factor(search.metric), search.model

    def one(at: _Pass) -> _Pass:
        # The tangent is found where a length is tried, too, so that the residual is compiled
        # and evaluated once in a pass.
        q = advanced(model, at.q, at.length * at.step)
        force, slope = linearised(residual, model, q)
        size = force @ cho_solve(factor, force)
        step, shape = -jnp.linalg.solve(slope, force), strained(model, q)
        energy = shape @ search.metric @ shape
        small = step @ search.metric @ step <= search.tolerance**2 * energy + search.floor
        onward = _Pass(q, step, slope, one_, size, small, small & ~once_more, at.count + 1)
        least, first = at.length <= _SHORTEST, jnp.isinf(at.size)
        enough = jnp.where(least, 1.0, 1 - 2 * _DECREASE * at.length).astype(q.dtype)
        good = size <= enough * at.size
        shorter = at._replace(length=_shorter(at, size), ended=~good & (least | first))
        new = jax.tree.map(lambda a, b: jnp.where(good, a, b), onward, shorter)
        last = at._replace(slope=slope, ended=~no)
        return jax.tree.map(lambda a, b: jnp.where(at.small, a, b), last, new)

    def searching(at: _Pass):
        return ~at.ended & (at.small | (at.count < search.max_iterations))

    no, one_ = jnp.array(False), jnp.ones((), guess.dtype)
    still, none = jnp.zeros(search.metric.shape[0], guess.dtype), jnp.zeros((), jnp.int32)
    begin = _Pass(guess, still, search.metric, one_, jnp.inf * one_, no, no, none)
    end = jax.lax.while_loop(searching, one, begin)
    q = jnp.where(end.small, advanced(model, end.q, end.step), end.q)
    done = end.small & jnp.all(jnp.isfinite(q))
    return Found(q, end.slope, done, jnp.isfinite(end.size), end.count)


def _shorter(at: _Pass, size: Float[Array, ""]) -> Float[Array, ""]:
    """A length at which the parabola through both sizes, with the slope that Newton's method
    promises, is least; between a tenth and half of the last one."""
    promised = at.size * at.length
    share = promised / (size - at.size + 2 * promised)
    share = jnp.where(jnp.isfinite(size), share, jnp.zeros_like(share))
    return at.length * jnp.clip(share, 0.1, 0.5)


def stability(
    slope: Float[Array, "dof dof"], search: Search
) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """Negative eigenvalues at the end of a search, and whether they make it unstable."""
    slope, measure = within_closures(search.model, slope, search.metric)
    negative = negative_eigenvalues(slope, measure)
    return negative, is_unstable(slope, measure, negative)


def ended(
    done: Array, q: Array, *, finite: Array | bool = True, unstable: Array | bool = False
) -> Status:
    """The status of a search that ended at `q`."""
    finite = jnp.asarray(finite).astype(bool) & jnp.all(jnp.isfinite(q))
    failed = Status.where(finite, Status.not_converged, Status.not_finite)
    good = Status.where(
        jnp.asarray(unstable).astype(bool), Status.unstable_equilibrium, Status.successful
    )
    return Status.where(finite & done.astype(bool), good, failed)


def _solve_tangent(linear, right: Array) -> Array:
    return jnp.linalg.solve(matrix_of(linear, right), right)
