"""What tasks share in which soft fingers handle a thing: numbers, grip, markers, and ends."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax._types import real
from sorojax.contact import LinePenalty
from sorojax.envs.core import AbstractEnv
from sorojax.envs.rods import RodBody
from sorojax.envs.supply_line import Delivery, SupplyLine
from sorojax.rod import Assembly, forward_kinematics, num_dof, rest, tip_pose
from sorojax.sdf import AbstractSdf
from sorojax.units import kPa, mm

POISSON, POINTS = 0.49, 24
LOST = 10.0  # reward that is taken where the thing is dropped
_SLIP = 2e-3  # m/s, below which friction is viscous
_HARD, _DEEP = 1.0e4, 0.02 * mm  # N/m of a point of what is rigid, and the smooth start


class GraspParams(eqx.Module):
    """Numbers of the fingers, their supply, and the thing that they handle.

    Attributes:
        length: Of a finger [m].
        radius: Of a finger [m].
        young_modulus: [Pa].
        density: [kg/m^3].
        damping: Retardation time of the rubber [s].
        chamber_offset: Of a chamber from the axis of its finger [m].
        chamber_area: Of a chamber across [m^2].
        max_pressure: Of the supply [Pa].
        gravity: [m/s^2].
        friction: Coefficient of all that touch [-].
        mass: Of the thing [kg].
        supply: The slowest supply of an episode.
        fastest: The fastest one.
        marker_noise: Standard deviation of measured positions [m].
    """

    length: Float[Array, ""] = eqx.field(converter=real, default=90 * mm)
    radius: Float[Array, ""] = eqx.field(converter=real, default=8 * mm)
    young_modulus: Float[Array, ""] = eqx.field(converter=real, default=300 * kPa)
    density: Float[Array, ""] = eqx.field(converter=real, default=1070.0)
    damping: Float[Array, ""] = eqx.field(converter=real, default=0.02)
    chamber_offset: Float[Array, ""] = eqx.field(converter=real, default=5 * mm)
    chamber_area: Float[Array, ""] = eqx.field(converter=real, default=40 * mm**2)
    max_pressure: Float[Array, ""] = eqx.field(converter=real, default=80 * kPa)
    gravity: Float[Array, ""] = eqx.field(converter=real, default=9.81)
    friction: Float[Array, ""] = eqx.field(converter=real, default=0.8)
    mass: Float[Array, ""] = eqx.field(converter=real, default=0.04)
    supply: SupplyLine = eqx.field(default_factory=lambda: SupplyLine(0.08, 0.03))
    fastest: SupplyLine = eqx.field(default_factory=lambda: SupplyLine(0.03, 0.005))
    marker_noise: Float[Array, ""] = eqx.field(converter=real, default=0.2 * mm)


class AbstractGrasp(AbstractEnv):
    """A task of soft fingers and a thing, whose goal has the `supply` of the episode."""

    time_step: float = eqx.field(static=True, default=2e-3)
    substeps: int = eqx.field(static=True, default=10)

    def supply_line(self, goal, params):
        return goal.supply


class Share(eqx.Module):
    """Some of what is delivered, as a function of the time since the step began [s]."""

    delivery: Delivery
    first: int = eqx.field(static=True)
    end: int = eqx.field(static=True)

    def __call__(self, t: Float[Array, ""]) -> Float[Array, " some"]:
        return self.delivery(t)[self.first : self.end]


def soft(params: GraspParams) -> LinePenalty:
    """Between a finger and a thing: as stiff as the rubber, so that some points share it."""
    depth = 0.02 * params.radius
    return LinePenalty(params.young_modulus, depth, params.friction, slip=_SLIP)


def hard(params: GraspParams, length: Array) -> LinePenalty:
    """Between points of rigid bodies, each of which stands for a length [m]."""
    return LinePenalty(_HARD / length, _DEEP, params.friction, slip=_SLIP)


def at_rest(model: Assembly) -> RodBody:
    """Fingers and thing as they are assembled, without a motion."""
    q = rest(model)
    return RodBody(q, jnp.zeros(num_dof(model), q.dtype))


def lines(
    model: Assembly, q: Float[Array, " coordinates"], fingers: Sequence[str], s: np.ndarray
) -> Float[Array, "fingers points dim"]:
    """Points on the axes of the fingers [m]."""
    poses = forward_kinematics(model, q, s)
    return jnp.stack([poses[name][:, :-1, -1] for name in fingers])


def of_thing(
    model: Assembly, q: Float[Array, " coordinates"], name: str, points: Array
) -> Float[Array, "points dim"]:
    """Points of a link where they are now [m]."""
    pose = tip_pose(model, q)[name]
    return points @ pose[:-1, :-1].T + pose[None, :-1, -1]


def gaps(
    shape: AbstractSdf,
    model: Assembly,
    q: Float[Array, " coordinates"],
    name: str,
    at: Float[Array, "*points dim"],
) -> Float[Array, " all"]:
    """Distances [m] of points to the shape of a link, which are negative inside."""
    pose = tip_pose(model, q)[name]
    flat = at.reshape(-1, at.shape[-1]) - pose[None, :-1, -1]
    return jax.vmap(lambda x: shape.distance(*x))(flat @ pose[:-1, :-1])


def within(points: Float[Array, "*points dim"], reach: Array) -> Bool[Array, ""]:
    """Whether no point is farther from the origin than a reach [m]."""
    return jnp.all(jnp.sum(points**2, axis=-1) < reach**2)
