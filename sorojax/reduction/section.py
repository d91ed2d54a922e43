"""The uniform section that carries the mass of a body along a curve."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import Numbers, real
from sorojax.fem.assembly.fields import quadrature_points
from sorojax.fem.dynamics.damping import lumped_mass
from sorojax.fem.kinematics import PlaneStrain, Solid
from sorojax.fem.problem import Problem
from sorojax.math.host import KDTree
from sorojax.reduction.curve import AbstractCurve, Line, reference
from sorojax.rod import AbstractForce, Section, points

_SAMPLES = 201


def mean_section(
    problem: Problem, curve: AbstractCurve, *, up: Numbers | None = None
) -> Section:
    """The section of a uniform rod along `curve` with the mass of the body, its mean offset
    from the curve and its rotary inertia about it. Of a solid the torsion constant is the
    polar moment, an upper bound.

    Raises:
        ValueError: If the body is neither plane strain nor solid.
    """
    kinematics = problem.kinematics
    if not isinstance(kinematics, PlaneStrain | Solid):
        raise ValueError(
            f"mean_section: got {type(kinematics).__name__}, need PlaneStrain or Solid. Give "
            "the rod a section of your own."
        )
    known = reference(curve, _SAMPLES, up)
    inside = quadrature_points(problem.mesh, kinematics)
    points = jnp.moveaxis(inside.position, 0, -1).reshape(-1, kinematics.dim)
    near = KDTree(known.position).query(np.asarray(jax.lax.stop_gradient(points)))[1]
    axes = known.position[near], known.frame[near]
    volume, offsets, moments = _moments(points, inside.volumes.reshape(-1), *axes)
    area, about_z = volume / known.length, moments[0] / known.length
    if isinstance(kinematics, Solid):
        about_y = moments[1] / known.length
    else:
        about_y = area * kinematics.thickness**2 / 12
    return Section(
        area, about_y, about_z, about_y + about_z, 5 / 6,
        mass_offset_y=offsets[0], mass_offset_z=offsets[1] if len(offsets) > 1 else None,
    )  # fmt: skip


@jax.jit
def _moments(
    points: Array, volumes: Array, places: Array, frames: Array
) -> tuple[Array, list[Array], list[Array]]:
    """Volume, its mean place along each axis of the section, and its second moments."""
    local = jnp.einsum("pi,pij->pj", points - places, frames)
    total, across = jnp.sum(volumes), [local[:, k] for k in range(1, local.shape[1])]
    means = [jnp.sum(volumes * x) / total for x in across]
    return total, means, [jnp.sum(volumes * x**2) for x in across]


# The weight of a solid on the rod that stands in for it


_STATIONS = 24


class OffsetWeight(AbstractForce):
    """Weight of a planar rod whose mass lies beside its line, evenly along it.

    Attributes:
        mass: In all [kg].
        arm: From the line to the mass, along the second director [m].
        acceleration: [m/s^2].
    """

    mass: Float[Array, ""] = eqx.field(converter=real)
    arm: Float[Array, ""] = eqx.field(converter=real)
    acceleration: Float[Array, "2"] = eqx.field(converter=real)

    def __call__(self, t, motion):
        at = points(motion, (np.arange(_STATIONS) + 0.5) / _STATIONS)
        away = self.arm * at.directors[:, :, 1]
        load = jnp.broadcast_to(self.mass / _STATIONS * self.acceleration, away.shape)
        turn = away[:, 0] * load[:, 1] - away[:, 1] * load[:, 0]
        return at.generalised(load, turn[:, None])


def offset_weight(problem: Problem, line: Line, acceleration: Numbers) -> OffsetWeight:
    """The weight of a planar solid about a straight line in it.

    Args:
        problem: The solid, with a density.
        line: Of the rod.
        acceleration: Of gravity [m/s^2].
    """
    shares = np.asarray(lumped_mass(problem)).reshape(-1, 2)[:, 0]
    start, end = np.asarray(line.start), np.asarray(line.end)
    along = (end - start) / np.linalg.norm(end - start)
    middle = shares @ np.asarray(problem.mesh.points) / shares.sum() - start
    return OffsetWeight(shares.sum(), along[0] * middle[1] - along[1] * middle[0], acceleration)
