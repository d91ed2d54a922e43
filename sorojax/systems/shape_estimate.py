"""The shape of a rod from markers on it, frame by frame.

Pure and compiled once, so one object serves recorded, simulated and live data. A marker
that was not seen is NaN and counts for nothing.

Reference:
    Caasenbrood, Pogromsky, Nijmeijer, "Sorotoki: a Matlab toolkit for design, modeling,
    and control of soft robots", IEEE Access 12, 2024, section VI-E.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._types import real
from sorojax.math.dense import solve_symmetric
from sorojax.math.door import door
from sorojax.math.status import Status
from sorojax.rod import Rod, motion, operators, total_force
from sorojax.rod.dynamics import Forces
from sorojax.rod.loads import tangent_stiffness
from sorojax.rod.points import points


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
        converter=lambda x: None if x is None else real(x), default=None
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


@door
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
    if markers.rod.group.space_dim == 2:
        swept = jnp.stack([-arm[:, 1], arm[:, 0]], axis=1)[:, :, None] * at.angular_jacobian
    else:
        swept = jnp.cross(
            jnp.swapaxes(at.angular_jacobian, 1, 2), arm[:, None], axisa=2, axisb=2
        )
        swept = jnp.swapaxes(swept, 1, 2)
    return at.position + arm, at.linear_jacobian + swept


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
