"""The shape of a rod from markers on it, frame by frame or filtered through its dynamics.

Pure and compiled once, so one object serves recorded, simulated and live data. A marker
that was not seen is NaN and counts for nothing.

References:
    Caasenbrood, Pogromsky, Nijmeijer, "Sorotoki: a Matlab toolkit for design, modeling,
    and control of soft robots", IEEE Access 12, 2024, section VI-E.
    Simon, Optimal State Estimation, 2006, chapter 13.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.math.compiled import jit_public
from sorojax.math.linalg.dense import product, solve_columns, solve_symmetric
from sorojax.math.status import Status
from sorojax.rod import Rod, inertia, motion, operators, total_force
from sorojax.rod.dynamics.dynamics import Forces
from sorojax.rod.dynamics.moving import swept
from sorojax.rod.dynamics.points import points
from sorojax.rod.forces.loads import damping_matrix, tangent_stiffness
from sorojax.rod.model.assembly import num_dof


class Markers(eqx.Module):
    """Markers on a rod: sections `s` in [0, 1], and where they sit in them.

    Attributes:
        rod: The rod.
        s: Sections, in [0, 1].
        offset: From the centre line, in the directors of the section [m]; zero if omitted.
    """

    rod: Rod
    s: Float[Array, " markers"] = eqx.field(converter=real)
    offset: Float[Array, "markers dim"] | None = eqx.field(
        converter=optional_real, default=None
    )

    def __check_init__(self):
        low, high = -1e-6, 1 + 1e-6
        _check.between("Markers", "s", self.s, low, high, "", "Divide by the length.")
        if self.offset is not None:
            shape = (self.s.shape[0], self.rod.group.space_dim)
            _check.shape("Markers", "offset", self.offset, shape, "Give one row per marker.")


class Shape(eqx.Module):
    """The estimate of one frame.

    Attributes:
        q: Coordinates.
        error: Root mean square distance of the seen markers to the shape [m].
        seen: How many markers counted.
        status: `not_finite` where the search broke down.
    """

    q: Float[Array, " dof"]
    error: Float[Array, ""]
    seen: Int[Array, ""]
    status: Status


@jit_public
def estimate_shape(
    markers: Markers,
    positions: Float[Array, "markers dim"],
    q: Float[Array, " dof"],
    *,
    forces: Forces = (),
    trust=1e-3,
    iterations: int = 3,
) -> Shape:
    """The coordinates at which the rod is where its markers are.

    Damped least squares from the last frame's answer, in a fixed number of steps. What the
    markers leave open is filled by the equilibrium of the rod's elasticity with `forces`
    (gravity, pressures as commanded): the least-squares problem gains the unbalanced
    force, measured as the displacement that it would make and weighed by `trust`, so that
    one marker or none will do.

    Args:
        markers: Where they sit on the rod.
        positions: What the camera saw [m], in the rod's base frame; NaN if not seen.
        q: First guess, the last answer.
        forces: What the rod's elasticity balances.
        trust: Weight of the model against the markers [-]; larger where markers are noisy
            and the forces are known.
        iterations: Steps.

    Returns:
        Coordinates, and how well they meet the markers.
    """
    rod, constants = markers.rod, operators(markers.rod)
    seen = jnp.all(jnp.isfinite(positions), axis=1)
    goal = jnp.where(seen[:, None], positions, jnp.zeros_like(positions))
    rest = motion(rod, jnp.zeros_like(q), constants=constants)
    stiffness = tangent_stiffness(forces, rest)
    weight = trust**2 * jnp.diag((rod.length / sizes(rod, q)) ** 2)

    def rows(q):
        moment = motion(rod, q, constants=constants)
        place, jacobian = places(markers, moment)
        count = jnp.where(seen, jnp.ones_like(markers.s), jnp.zeros_like(markers.s))
        error = (count[:, None] * (goal - place)).reshape(-1)
        jacobian = (count[:, None, None] * jacobian).reshape(error.shape[0], -1)
        return error, jacobian, moment

    def improve(_, q):
        error, jacobian, moment = rows(q)
        normal, down = jacobian.T @ jacobian, jacobian.T @ error
        # the displacement that the unbalanced force would make, as further errors
        pull = solve_symmetric(stiffness, total_force(forces, jnp.zeros((), q.dtype), moment))
        return q + solve_symmetric(normal + weight, down + weight @ pull)

    q = jax.lax.fori_loop(0, iterations, improve, q)
    error, *_ = rows(q)
    number = jnp.sum(seen)
    size = root_mean_square(error, number)
    fine = jnp.all(jnp.isfinite(q))
    status = Status.where(fine, Status.successful, Status.not_finite)
    return Shape(q, size, number, status)


def places(markers: Markers, moment) -> tuple[Array, Array]:
    """Positions of the markers [m] and their derivative in the coordinates."""
    at = points(moment, markers.s)
    if markers.offset is None:
        return at.position, at.linear_jacobian
    arm = jnp.einsum("mij,mj->mi", at.directors, markers.offset)
    return at.position + arm, at.linear_jacobian + swept(at.angular_jacobian, arm)


def root_mean_square(error: Float[Array, " rows"], count: Int[Array, ""]) -> Float[Array, ""]:
    """Root mean square over the markers that were seen."""
    mean = error @ error / jnp.maximum(count, 1).astype(error.dtype)
    return jnp.sqrt(jnp.where(mean > 0, mean, jnp.finfo(error.dtype).tiny))


def sizes(rod: Rod, q) -> Float[Array, " dof"]:
    """Coordinates that each move the tip by about the length of the rod."""
    moment = motion(rod, jnp.zeros_like(q))
    reach = jnp.sqrt(jnp.sum(points(moment, jnp.ones(1)).linear_jacobian[0] ** 2, axis=0))
    turn = jnp.sqrt(jnp.sum(points(moment, jnp.ones(1)).angular_jacobian[0] ** 2, axis=0))
    return rod.length / (reach + rod.length * turn)


# The motion of a rod from markers on it, filtered through its dynamics


#: Updates without a marker after which an estimate is only a prediction.
STALE = 3


class ShapeFilter(eqx.Module):
    """An extended Kalman filter whose prediction is the rod's own dynamics.

    Attributes:
        markers: Where they sit on the rod.
        period: Between two updates [s].
        marker_noise: Standard deviation of a marker's coordinate [m].
        force_noise: Standard deviation of unknown forces, relative to those that bend the
            rod by its own length; what contact may do to it [-].
        substeps: Of the dynamics, each linearly implicit, within a period.
    """

    markers: Markers
    period: Float[Array, ""] = eqx.field(converter=real)
    marker_noise: Float[Array, ""] = eqx.field(converter=real, default=3e-4)
    force_noise: Float[Array, ""] = eqx.field(converter=real, default=0.05)
    substeps: int = eqx.field(static=True, default=2)

    def __check_init__(self):
        for name in ("period", "marker_noise", "force_noise"):
            _check.positive("ShapeFilter", name, getattr(self, name), "", "See its docstring.")


class FilterState(eqx.Module):
    """State of a filter.

    Attributes:
        q, v: Coordinates and rates.
        covariance: Of both, q first.
        missed: Updates since a marker was last seen; the estimate is `stale` from three on.
        error: Root mean square distance of the seen markers to the prediction [m].
        status: Whether numbers stayed finite.
    """

    q: Float[Array, " dof"]
    v: Float[Array, " dof"]
    covariance: Float[Array, "state state"]
    missed: Int[Array, ""]
    error: Float[Array, ""]
    status: Status

    @property
    def stale(self) -> Array:
        return self.missed >= STALE


def start_filter(
    estimator: ShapeFilter, q: Float[Array, " dof"] | None = None, *, spread=0.1
) -> FilterState:
    """A filter at rest at `q` (zero if omitted).

    `spread` is how far off that may be: the displacement of the tip over the length.

    Args:
        estimator: The filter.
        q: Coordinates at which it begins.
        spread: Displacement of the tip over the length [-].

    Returns:
        The first estimate.
    """
    rod = estimator.markers.rod
    q = jnp.zeros(num_dof(rod)) if q is None else real(q)
    size = spread * sizes(rod, q)
    covariance = jnp.diag(jnp.concatenate([size, size / estimator.period]) ** 2)
    nothing = jnp.zeros((), q.dtype)
    return FilterState(
        q, jnp.zeros_like(q), covariance, jnp.zeros((), jnp.int32), nothing, Status.successful
    )


@jit_public
def update_filter(
    estimator: ShapeFilter,
    last: FilterState,
    positions: Float[Array, "markers dim"] | None = None,
    *,
    forces: Forces = (),
    t=0.0,
) -> FilterState:
    """The estimate one period later, with what the camera saw by then, or without.

    Without markers (None, or all NaN) it is the prediction, with a growing covariance.
    Where numbers stop being finite the last estimate is kept and `status` says so.

    Args:
        estimator: The filter.
        last: The last estimate.
        positions: Markers [m] in the rod's base frame; NaN if not seen.
        forces: On the rod over the period: damping, gravity, what is commanded.
        t: Time at the start of the period [s].

    Returns:
        The new estimate with its covariance.
    """
    dof = last.q.shape[0]
    before = jnp.concatenate([last.q, last.v])
    ahead = _prediction(estimator, forces, real(t))
    slopes, (state, mass, stiffness) = jax.jacfwd(ahead, has_aux=True)(before)
    process = _process(estimator, forces, mass, stiffness)
    covariance = product(product(slopes, last.covariance), slopes.T) + process
    missed, error = last.missed + 1, jnp.zeros((), state.dtype)
    if positions is not None:
        state, covariance, error, seen = _corrected(estimator, state, covariance, positions)
        missed = jnp.where(seen > 0, jnp.zeros_like(missed), missed)
    new = FilterState(state[:dof], state[dof:], covariance, missed, error, Status.successful)
    fine = jnp.all(jnp.isfinite(state)) & jnp.all(jnp.isfinite(covariance))
    kept = jax.tree.map(lambda a, b: jnp.where(fine, a, b), eqx.filter(new, eqx.is_array), last)
    status = Status.where(fine, Status.successful, Status.not_finite)
    missed = jnp.where(fine, missed, last.missed + 1)
    return eqx.tree_at(lambda x: (x.missed, x.status), kept, (missed, status))


def _prediction(estimator: ShapeFilter, forces: Forces, t):
    """(q, v) -> (q, v) a period later, by linearly implicit Euler steps; beside it again the
    state, with the mass matrix and the stiffness of the last step."""
    rod, constants = estimator.markers.rod, operators(estimator.markers.rod)
    h = estimator.period / estimator.substeps
    damping = damping_matrix(forces, rod, constants)

    def step(_, carry):
        q, v = jnp.split(carry[0], 2)
        moment = motion(rod, q, v, constants=constants)
        mass, coriolis = inertia(moment)
        stiffness = tangent_stiffness(forces, moment)
        force = total_force(forces, t, moment) - coriolis
        implicit = mass + h * damping + h * h * stiffness
        v = v + solve_symmetric(implicit, h * (force - h * (stiffness @ v)))
        state = jnp.concatenate([q + h * v, v])
        return state, mass, stiffness

    def ahead(state):
        nothing = jnp.zeros((state.shape[0] // 2,) * 2, state.dtype)
        start = state, nothing, nothing
        end = jax.lax.fori_loop(0, estimator.substeps, step, start)
        return end[0], end

    return ahead


def _process(estimator: ShapeFilter, forces: Forces, mass, stiffness) -> Array:
    """Covariance of what unknown forces do in a period."""
    rod, h = estimator.markers.rod, estimator.period
    # a force that would hold the rod bent, met by inertia, damping and elasticity
    push = estimator.force_noise * stiffness * sizes(rod, jnp.zeros_like(mass[0]))[None]
    damping = damping_matrix(forces, rod, operators(rod))
    implicit = mass + h * damping + h * h * stiffness
    kick = solve_columns(implicit, h * push)
    both = jnp.concatenate([h * kick, kick])
    return product(both, both.T)


def _corrected(estimator: ShapeFilter, state, covariance, positions):
    """Kalman's update by the markers that were seen, in the form that stays symmetric."""
    dof = state.shape[0] // 2
    seen = jnp.all(jnp.isfinite(positions), axis=1)
    moment = motion(estimator.markers.rod, state[:dof])
    place, jacobian = places(estimator.markers, moment)
    ahead = jnp.where(seen[:, None], positions - place, 0.0).reshape(-1)
    rows = jnp.where(seen[:, None, None], jacobian, 0.0).reshape(ahead.shape[0], dof)
    variance = estimator.marker_noise**2
    seen_with = product(rows, covariance[:dof])
    spread = product(seen_with[:, :dof], rows.T)
    spread = spread + variance * jnp.eye(ahead.shape[0], dtype=state.dtype)
    gain = solve_columns(spread, seen_with).T
    taken = product(gain, rows)  # Joseph's form; markers do not see rates
    left = covariance - product(taken, covariance[:dof])
    covariance = left - product(left[:, :dof], taken.T) + variance * product(gain, gain.T)
    count = jnp.sum(seen)
    error = root_mean_square(ahead, count)
    return state + product(gain, ahead[:, None])[:, 0], covariance, error, count
