"""The pneumatic finger that several tasks ask something of."""

import math
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.envs.core import AbstractEnv, State, in_shares
from sorojax.envs.rods import Inflated, RodBody, near_base, places, rolled, settled
from sorojax.envs.supply_line import SupplyLine
from sorojax.math.lie import SE3, homogeneous
from sorojax.math.ode.steppers import ImplicitMidpoint
from sorojax.rod import (
    AbstractPressureMap,
    Damping,
    Gravity,
    Part,
    PartForce,
    Pressurised,
    Rod,
    Straight,
    assembly,
    chebyshev,
    circle,
    rest,
    rod,
    thread_chambers,
    tip_pose,
)
from sorojax.units import kPa, mm

if TYPE_CHECKING:
    from sorojax.view import Scene

MARKERS = np.array([0.25, 0.5, 0.75, 1.0])
POISSON = 0.49
_DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # of x, in pictures


class FingerParams(eqx.Module):
    """Numbers of the finger and its supply.

    Attributes:
        length: [m].
        radius: [m].
        young_modulus: [Pa].
        density: [kg/m^3].
        damping: Retardation time of the rubber [s].
        chamber_offset: Of each chamber from the axis [m].
        chamber_area: Of each chamber across [m^2].
        max_pressure: Of the supply [Pa].
        gravity: Along the finger, which hangs down [m/s^2].
        supply: Dead time and lag of the pressures.
        marker_noise: Standard deviation of measured positions [m].
    """

    length: Float[Array, ""] = eqx.field(converter=real, default=100 * mm)
    radius: Float[Array, ""] = eqx.field(converter=real, default=10 * mm)
    young_modulus: Float[Array, ""] = eqx.field(converter=real, default=200 * kPa)
    density: Float[Array, ""] = eqx.field(converter=real, default=1070.0)
    damping: Float[Array, ""] = eqx.field(converter=real, default=0.02)
    chamber_offset: Float[Array, ""] = eqx.field(converter=real, default=6 * mm)
    chamber_area: Float[Array, ""] = eqx.field(converter=real, default=40 * mm**2)
    max_pressure: Float[Array, ""] = eqx.field(converter=real, default=100 * kPa)
    gravity: Float[Array, ""] = eqx.field(converter=real, default=9.81)
    supply: SupplyLine = eqx.field(default_factory=lambda: SupplyLine(0.05, 0.01))
    marker_noise: Float[Array, ""] = eqx.field(converter=real, default=0.1 * mm)


class AbstractFinger(AbstractEnv):
    """A hanging finger with three chambers, a Cosserat rod with two modes of bending in each
    plane and one of stretch, clamped with its axis down; what it is asked to do is left open.
    """

    num_actions: ClassVar[int] = 3

    def commanded(self, command, action, params):
        return params.max_pressure * (1 + action) / 2

    def moved(self, body, delivery, goal, params):
        model, chambers = _finger(params)
        forces = (Inflated(chambers, delivery), *_always(params))
        after = rolled(
            model,
            body,
            forces,
            ImplicitMidpoint(passes=1),
            time_step=self.time_step,
            steps=self.substeps,
        )
        return after, near_base(places(model, after.q, MARKERS), params.length)

    def markers(self, body, params):
        return places(_finger(params)[0], body.q, MARKERS)


def tip_at_rest(pressure: Float[Array, "3"], params: FingerParams) -> Float[Array, "3"]:
    """Where the tip is under held pressures [m]."""
    model, chambers = _finger(params)
    held = settled(model, (Pressurised(chambers, pressure), *_always(params)))
    return tip_pose(model, held.q)[:3, 3]


def hanging(params: FingerParams) -> RodBody:
    """The finger at rest in its own shape."""
    q = rest(_finger(params)[0])
    return RodBody(q, q)


def supplied(state: State, params: FingerParams) -> Float[Array, "6"]:
    """Pressures and commands in shares of the greatest."""
    both = jnp.stack([state.supply.value, state.supply.commands[0]])
    return in_shares(both, params.max_pressure).ravel()


def seen(state: State, params: FingerParams) -> Float[Array, "24"]:
    """Markers now and a step before, in lengths, relative to where they are when straight."""
    straight = params.length * jnp.asarray(MARKERS, params.length.dtype)
    return (state.seen.at[:, :, 0].add(-straight[None]) / params.length).ravel()


def distance(gap: Float[Array, " dim"]) -> Float[Array, ""]:
    """Length of a gap [m]; smooth where it closes."""
    return jnp.sqrt(jnp.sum(gap**2) + (0.1 * mm) ** 2) - 0.1 * mm


def change(before: State, action: Float[Array, "3"], params: FingerParams) -> Float[Array, ""]:
    """Square of the change of the commands since the step before, in shares."""
    gap = action - in_shares(before.supply.commands[0], params.max_pressure)
    return jnp.sum(gap**2) / 4


def scene_of(state: State, params: FingerParams) -> "Scene":
    """The finger, which hangs down in pictures, with the air in its chambers, and its tip."""
    from sorojax import view

    model, chambers = _finger(params)
    hung = assembly(
        SE3(), finger=Part(model, offset=homogeneous(jnp.asarray(_DOWN), jnp.zeros(3)))
    )
    inside = (PartForce("finger", Pressurised(chambers, state.supply.value)),)
    drawn = view.scene_of(hung, np.asarray(state.body.q), forces=inside)
    tip = in_picture(places(model, state.body.q, MARKERS[-1:]))
    return view.merge_scenes(drawn, view.Scene((view.Dots(tip, size=5.0),)))


def in_picture(points: Float[Array, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Points with the axis of the finger down."""
    return np.asarray(points) @ _DOWN.T


def _finger(params: FingerParams) -> tuple[Rod, AbstractPressureMap]:
    """The rod and its chambers."""
    body = rod(
        SE3(),
        chebyshev(kappa_y=2, kappa_z=2, sigma_x=1),
        circle(params.radius),
        length=params.length,
        young_modulus=params.young_modulus,
        poisson_ratio=POISSON,
        density=params.density,
        nodes=6,
    )
    angles = [2 * math.pi * k / 3 for k in range(3)]
    routes = tuple(
        Straight(params.chamber_offset * jnp.asarray([math.cos(a), math.sin(a)]), nodes=6)
        for a in angles
    )
    return body, thread_chambers(body, routes, jnp.broadcast_to(params.chamber_area, (3,)))


def _always(params: FingerParams) -> tuple[Any, ...]:
    """Weight along the finger, and the damping of its rubber."""
    down = params.gravity * jnp.asarray([1.0, 0.0, 0.0], params.gravity.dtype)
    return Gravity(down), Damping(params.damping)
