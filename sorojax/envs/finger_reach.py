"""A pneumatic finger brings its tip to a point."""

import math
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.envs.core import AbstractEnv, State, Verdict, in_shares
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

_MARKERS = np.array([0.25, 0.5, 0.75, 1.0])
_POISSON = 0.49
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


class ReachGoal(NamedTuple):
    """Where the tip should be [m], and the pressures that hold it there [Pa]."""

    target: Float[Array, "3"]
    pressure: Float[Array, " actions"]


class FingerReach(AbstractEnv):
    """Bring the tip of a hanging finger with three chambers to a point within its reach.

    The finger is a Cosserat rod with two modes of bending in each plane and one of stretch,
    clamped with its axis down. The target is where its tip is at rest under three pressures
    drawn evenly from 0 to the greatest, so it can be held.

    Actions, 3 in [-1, 1]: the commanded pressures, from 0 to the greatest. They arrive by the
    `SupplyLine`.

    Observations, 33: the pressures and the commands, in shares of the greatest from -1 to 1;
    the target less the tip, and four markers now and a step before, in lengths of the finger,
    relative to where they are when it is straight.

    Reward: 1 - d / L - 0.05 |c|^2, with the distance d of the tip to the target, the length L
    and the change c of the commands since the step before, in shares; 1 at best. An episode
    ends by its time alone, or where it diverges. `info` has `distance` [m] and `success`: it
    is below `tolerance`.

    Attributes:
        tolerance: Distance of success [m].
    """

    tolerance: float = eqx.field(static=True, default=5 * mm)
    num_actions: ClassVar[int] = 3
    num_observations: ClassVar[int] = 2 * 3 + 3 + 2 * 4 * 3

    def default_params(self) -> FingerParams:
        return FingerParams()

    def begin(self, key, params):
        model, chambers = _finger(params)
        pressure = params.max_pressure * jax.random.uniform(key, (3,), params.length.dtype)
        held = settled(model, (Pressurised(chambers, pressure), *_always(params)))
        goal = ReachGoal(tip_pose(model, held.q)[:3, 3], pressure)
        return RodBody(rest(model), rest(model)), jnp.zeros_like(pressure), goal

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
        return after, near_base(places(model, after.q, _MARKERS), params.length)

    def markers(self, body, params):
        return places(_finger(params)[0], body.q, _MARKERS)

    def observed(self, state, params):
        straight = params.length * jnp.asarray(_MARKERS, params.length.dtype)
        seen = state.seen.at[:, :, 0].add(-straight[None]) / params.length
        ahead = (state.goal.target - state.seen[0, -1]) / params.length
        supplied = jnp.stack([state.supply.value, state.supply.commands[0]])
        shares = in_shares(supplied, params.max_pressure)
        return jnp.concatenate([shares.ravel(), ahead, seen.ravel()])

    def judged(self, before, action, after, params):
        distance = _distance(after, self.markers(after.body, params))
        change = action - in_shares(before.supply.commands[0], params.max_pressure)
        reward = 1 - distance / params.length - 0.05 * jnp.sum(change**2) / 4
        news = {"distance": distance, "success": distance < self.tolerance}
        return Verdict(reward, jnp.zeros((), bool), news)

    def scene(self, state, params):
        from sorojax import view

        model, chambers = _finger(params)
        hung = assembly(
            SE3(), finger=Part(model, offset=homogeneous(jnp.asarray(_DOWN), jnp.zeros(3)))
        )
        inside = (PartForce("finger", Pressurised(chambers, state.supply.value)),)
        drawn = view.scene_of(hung, np.asarray(state.body.q), forces=inside)
        target = np.asarray(state.goal.target)[None] @ _DOWN.T
        tip = np.asarray(self.markers(state.body, params))[-1:] @ _DOWN.T
        marks = view.Dots(target, "#c0392b", 9.0, "target"), view.Dots(tip, size=5.0)
        return view.merge_scenes(drawn, view.Scene(marks))


def _distance(state: State, markers: Array) -> Float[Array, ""]:
    """Of the tip to the target [m]; smooth where it arrives."""
    gap = markers[-1] - state.goal.target
    return jnp.sqrt(jnp.sum(gap**2) + (0.1 * mm) ** 2) - 0.1 * mm


def _finger(params: FingerParams) -> tuple[Rod, AbstractPressureMap]:
    """The rod and its chambers."""
    body = rod(
        SE3(),
        chebyshev(kappa_y=2, kappa_z=2, sigma_x=1),
        circle(params.radius),
        length=params.length,
        young_modulus=params.young_modulus,
        poisson_ratio=_POISSON,
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
