"""A tentacle is pushed through clutter and steers with two tendons."""

from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.contact import LinePenalty
from sorojax.envs.core import AbstractEnv, Verdict, in_shares
from sorojax.envs.rods import RodBody, near_base, places, rolled
from sorojax.envs.supply_line import SupplyLine
from sorojax.math.lie import SE2
from sorojax.math.ode.linearly_implicit import LinearlyImplicit
from sorojax.rod import (
    Assembly,
    Converging,
    Damping,
    JointEffort,
    ObstacleContact,
    Part,
    PartForce,
    Prismatic,
    Tendons,
    assembly,
    chebyshev,
    circle,
    rest,
    rod,
    taper,
)
from sorojax.sdf import AbstractSdf, Circle, union
from sorojax.units import MPa, mm

_MARKERS = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
_POISSON, _POINTS = 0.49, 24
_STIFF = 5.0  # of a contact, in Young's moduli
_FIRST, _APART = 1.1, 0.1  # where posts stand along the tentacle at the start, over its length
_GOAL, _WIDE = 1.4, 0.16  # the same of the goal, and how far both are to the sides


class TentacleParams(eqx.Module):
    """Numbers of the tentacle, its drives and the posts.

    Attributes:
        length: [m].
        root_radius: [m].
        tip_radius: [m].
        young_modulus: [Pa].
        density: [kg/m^3].
        damping: Retardation time of the rubber [s].
        tendon_offset: Of both tendons from the axis at the root [m]; a third of it at the tip.
        max_tension: [N].
        max_travel: Of the feed [m].
        servo_stiffness: Of the feed [N/m].
        servo_damping: Of the feed [N s/m].
        servo_mass: What the feed moves beside the tentacle [kg].
        post_radius: [m].
        friction: Coefficient between tentacle and posts [-].
        supply: Dead time and lag of the drives.
        marker_noise: Standard deviation of measured positions [m].
    """

    length: Float[Array, ""] = eqx.field(converter=real, default=250 * mm)
    root_radius: Float[Array, ""] = eqx.field(converter=real, default=6 * mm)
    tip_radius: Float[Array, ""] = eqx.field(converter=real, default=3 * mm)
    young_modulus: Float[Array, ""] = eqx.field(converter=real, default=1 * MPa)
    density: Float[Array, ""] = eqx.field(converter=real, default=1070.0)
    damping: Float[Array, ""] = eqx.field(converter=real, default=0.02)
    tendon_offset: Float[Array, ""] = eqx.field(converter=real, default=4.5 * mm)
    max_tension: Float[Array, ""] = eqx.field(converter=real, default=2.0)
    max_travel: Float[Array, ""] = eqx.field(converter=real, default=125 * mm)
    servo_stiffness: Float[Array, ""] = eqx.field(converter=real, default=500.0)
    servo_damping: Float[Array, ""] = eqx.field(converter=real, default=20.0)
    servo_mass: Float[Array, ""] = eqx.field(converter=real, default=0.2)
    post_radius: Float[Array, ""] = eqx.field(converter=real, default=8 * mm)
    friction: Float[Array, ""] = eqx.field(converter=real, default=0.3)
    supply: SupplyLine = eqx.field(default_factory=lambda: SupplyLine(0.03, 0.01))
    marker_noise: Float[Array, ""] = eqx.field(converter=real, default=0.2 * mm)


class ClutterGoal(NamedTuple):
    """Where the tip should be, and where the posts stand [m]."""

    target: Float[Array, "2"]
    posts: Float[Array, "posts 2"]


class Pulled(eqx.Module):
    """The tensions among what is delivered, as a function of time [s]."""

    delivery: Any

    def __call__(self, t):
        return self.delivery(t)[1:]


class TentaclePush(AbstractEnv):
    """Push a tentacle between posts, which it may touch, until its tip is at a point behind.

    The tentacle lies on a table without friction, a planar Cosserat rod with four modes of
    bending on a linear feed. Three posts stand before its tip, one behind the other, and the
    goal behind them, all at random places across.

    Actions, 3 in [-1, 1]: the rates of the commands to the feed and both tendons; at 1 a
    command goes from 0 to its greatest in `full_range` seconds. Tensions arrive by the
    `SupplyLine`, and so does the place that the servo of the feed holds, once a step.

    Observations, 34: what arrives and the commands, in shares of the greatest from -1 to 1; in
    lengths of the tentacle the target less the tip, the posts less the tip, and five markers
    now and a step before, relative to where they are at the start.

    Reward: 1 - d / L - 0.02 |a|^2 / 3, with the distance d of the tip to the target, the length
    L and the action a; 1 at best. An episode ends by its time alone, or where it diverges: a
    post is passed through, for example. `info` has `distance` [m] and `success`: it is below
    `tolerance`.

    Attributes:
        tolerance: Distance of success [m].
        full_range: Time of a command from 0 to its greatest [s].
    """

    max_steps: int = eqx.field(static=True, default=150)
    tolerance: float = eqx.field(static=True, default=10 * mm)
    full_range: float = eqx.field(static=True, default=1.0)
    num_actions: ClassVar[int] = 3
    num_observations: ClassVar[int] = 2 * 3 + 2 + 2 * 3 + 2 * 5 * 2

    def default_params(self) -> TentacleParams:
        return TentacleParams()

    def begin(self, key, params):
        # as many numbers as places across: three posts and the goal
        across = jax.random.uniform(key, (4,), params.length.dtype, -_WIDE, _WIDE)
        along = jnp.asarray([*(_FIRST + _APART * k for k in range(3)), _GOAL], across.dtype)
        found = params.length * jnp.stack([along, across], axis=1)
        q = rest(_tentacle(params))
        command = jnp.zeros(3, params.length.dtype)
        return RodBody(q, jnp.zeros_like(q)), command, ClutterGoal(found[3], found[:3])

    def commanded(self, command, action, params):
        most = _most(params)
        moved = command + most * action * (self.period / self.full_range)
        return jnp.clip(moved, 0.0, most)

    def moved(self, body, delivery, goal, params):
        posts = _posts(goal, params)
        after = rolled(
            _tentacle(params),
            body,
            _forces(params, delivery, self.period, posts),
            LinearlyImplicit(),
            time_step=self.time_step,
            steps=self.substeps,
        )
        line = places(_tentacle(params), after.q, np.linspace(0.0, 1.0, 2 * _POINTS))
        outside = jnp.all(posts.distance(line[:, 0], line[:, 1]) > 0)
        return after, outside & near_base(line, params.length)

    def markers(self, body, params):
        return places(_tentacle(params), body.q, _MARKERS)

    def observed(self, state, params):
        start = params.length * jnp.asarray(_MARKERS, params.length.dtype)
        tip = state.seen[0, -1]
        ahead = jnp.concatenate([(state.goal.target - tip)[None], state.goal.posts - tip[None]])
        seen = state.seen.at[:, :, 0].add(-start[None])
        supplied = jnp.stack([state.supply.value, state.supply.commands[0]])
        shares = in_shares(supplied, _most(params)[None])
        parts = shares.ravel(), ahead.ravel() / params.length, seen.ravel() / params.length
        return jnp.concatenate(parts)

    def judged(self, before, action, after, params):
        gap = self.markers(after.body, params)[-1] - after.goal.target
        distance = jnp.sqrt(jnp.sum(gap**2) + (0.1 * mm) ** 2) - 0.1 * mm
        reward = 1 - distance / params.length - 0.02 * jnp.sum(action**2) / 3
        news = {"distance": distance, "success": distance < self.tolerance}
        return Verdict(reward, jnp.zeros((), bool), news)

    def scene(self, state, params):
        from sorojax import view

        posts = view.scene_of(_posts(state.goal, params))
        drawn = view.scene_of(_tentacle(params), np.asarray(state.body.q))
        target = view.Dots(np.asarray(state.goal.target)[None], "#c0392b", 9.0, "target")
        merged = view.merge_scenes(posts, drawn, view.Scene((target,)))
        size = float(params.length)
        lower, upper = np.array([-0.04, -0.36]) * size, np.array([1.55, 0.36]) * size
        return replace(merged, extent=(lower, upper))


def _posts(goal: ClutterGoal, params: TentacleParams) -> AbstractSdf:
    return union(*(Circle(post, params.post_radius) for post in goal.posts))


def _most(params: TentacleParams) -> Float[Array, "3"]:
    """The greatest commands: travel [m] and two tensions [N]."""
    return jnp.stack([params.max_travel, params.max_tension, params.max_tension])


def _tentacle(params: TentacleParams) -> Assembly:
    """The rod on its feed."""
    body = rod(
        SE2(),
        chebyshev(kappa_z=4),
        taper(circle, params.root_radius, params.tip_radius),
        length=params.length,
        young_modulus=params.young_modulus,
        poisson_ratio=_POISSON,
        density=params.density,
        nodes=8,
    )
    feed = Prismatic(
        [1.0, 0.0],
        stiffness=params.servo_stiffness,
        damping=params.servo_damping,
        armature=params.servo_mass,
    )
    return assembly(SE2(), arm=Part(body, feed))


def _forces(
    params: TentacleParams, delivery, period: float, posts: AbstractSdf
) -> tuple[Any, ...]:
    """Servo, tendons, posts and the damping of the rubber."""
    aim = params.servo_stiffness * delivery(jnp.asarray(period, params.length.dtype))[0]
    side = jnp.asarray([1.0, 0.0], params.length.dtype) * params.tendon_offset
    routes = [Converging(sign * side, sign * side / 3, nodes=8) for sign in (1.0, -1.0)]
    s = (np.arange(_POINTS) + 0.5) / _POINTS
    along = jnp.asarray(np.append(s, 1.0), params.length.dtype)
    radius = params.root_radius + (params.tip_radius - params.root_radius) * along
    law = LinePenalty(
        _STIFF * params.young_modulus, 0.02 * params.tip_radius, params.friction, slip=5e-3
    )
    return (
        JointEffort("arm", aim[None]),
        PartForce("arm", Tendons(routes, Pulled(delivery))),
        PartForce("arm", ObstacleContact(posts, radius, law, points=_POINTS)),
        Damping(params.damping),
    )
