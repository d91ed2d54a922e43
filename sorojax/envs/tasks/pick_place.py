"""A gripper of two fluidic fingers on a gantry picks a box up and places it on a shelf."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.envs.core import Verdict, in_shares
from sorojax.envs.rods import Inflated, rolled
from sorojax.envs.supply_line import SupplyLine, between
from sorojax.envs.tasks.gripping import (
    LOST,
    POINTS,
    POISSON,
    AbstractGrasp,
    GraspParams,
    Share,
    at_rest,
    gaps,
    hard,
    lines,
    of_thing,
    soft,
    within,
)
from sorojax.math.lie import SE2, homogeneous
from sorojax.math.ode.linearly_implicit import LinearlyImplicit
from sorojax.rod import (
    AbstractPressureMap,
    Assembly,
    Damping,
    Free,
    Gravity,
    JointEffort,
    Link,
    LinkContact,
    LinkObstacle,
    ObstacleContact,
    PairForce,
    Part,
    PartForce,
    Pressurised,
    Prismatic,
    Rod,
    RodContact,
    Straight,
    assembly,
    chebyshev,
    circle,
    forward_kinematics,
    rod,
    thread_chambers,
    tip_pose,
)
from sorojax.sdf import AbstractSdf, HalfPlane, Rectangle
from sorojax.units import deg, kPa, mm

_FINGERS, _BOX = ("left", "right"), "box"
_SIDES = -1.0, 1.0  # of the fingers
_SEEN = np.array([0.5, 1.0])  # markers along a finger
_BEGIN, _END = (-90 * mm, -50 * mm), (75 * mm, 105 * mm)  # where the box may stand, and should
_EDGE = 50 * mm  # of the shelf
_LEAN = 45 * deg  # of the box, that is a fall
_STILL = 10 * mm  # speed of a box that stands [m/s]
_HANGING = np.array([[0.0, 1.0], [-1.0, 0.0]])  # x of a finger down, y to the right
_ROUND = 2 * mm  # radius of the corners of the box
_WINDOW = (-0.16, -0.02), (0.16, 0.2)  # of pictures [m]


class PickParams(GraspParams):
    """Numbers of the gripper, its gantry and the box, beside those of all grippers.

    Attributes:
        box_width: [m].
        box_height: [m].
        clearance: Between the box and a straight finger [m].
        foot_height: Of the feet of the fingers above the floor, with the gantry at 0 [m].
        shelf_height: Above the floor [m].
        max_travel: Of the gantry, to both sides and both up and down [m].
        servo_stiffness: Of the gantry [N/m].
        servo_damping: Of the gantry [N s/m].
        servo_mass: What each axis of the gantry moves beside the fingers [kg].
    """

    length: Float[Array, ""] = eqx.field(converter=real, default=70 * mm)
    radius: Float[Array, ""] = eqx.field(converter=real, default=6 * mm)
    young_modulus: Float[Array, ""] = eqx.field(converter=real, default=400 * kPa)
    chamber_offset: Float[Array, ""] = eqx.field(converter=real, default=3.5 * mm)
    chamber_area: Float[Array, ""] = eqx.field(converter=real, default=30 * mm**2)
    max_pressure: Float[Array, ""] = eqx.field(converter=real, default=150 * kPa)
    mass: Float[Array, ""] = eqx.field(converter=real, default=0.03)
    box_width: Float[Array, ""] = eqx.field(converter=real, default=30 * mm)
    box_height: Float[Array, ""] = eqx.field(converter=real, default=40 * mm)
    clearance: Float[Array, ""] = eqx.field(converter=real, default=6 * mm)
    foot_height: Float[Array, ""] = eqx.field(converter=real, default=150 * mm)
    shelf_height: Float[Array, ""] = eqx.field(converter=real, default=20 * mm)
    max_travel: Float[Array, "2"] = eqx.field(converter=real, default=(120 * mm, 60 * mm))
    servo_stiffness: Float[Array, ""] = eqx.field(converter=real, default=1000.0)
    servo_damping: Float[Array, ""] = eqx.field(converter=real, default=30.0)
    servo_mass: Float[Array, ""] = eqx.field(converter=real, default=0.15)


class PlaceGoal(NamedTuple):
    """Where the middle of the box should be [m], and the supply of the episode."""

    target: Float[Array, "2"]
    supply: SupplyLine


class PickPlace(AbstractGrasp):
    """Pick a box up from the floor, and place it on a shelf and let it go.

    All is in an upright plane. Two fingers hang from a gantry, planar Cosserat rods with three
    modes of bending, each with a chamber on its outer side. The box is free: nothing holds
    it but contact and friction with fingers, floor and shelf; the fingers touch those and each
    other as well. Where the box stands, left of the middle, and where it should stand on the
    shelf on the right are drawn evenly, and so are dead time and lag of the supply between
    `fastest` and `supply`; the supply is not observed.

    Actions, 3 in [-1, 1]: the rates of the commands to the gantry across and up, which at 1 go
    from one end to the other in `full_range` seconds, and the pressure in both fingers, from 0
    to the greatest. All arrive by the supply, the place that the servo of the gantry holds
    once a step.

    Observations, 38: what arrives and the commands, in shares of the greatest from -1 to 1; in
    travels of the gantry to a side the target less the middle of the box, that less the middle
    between the tips, and seven markers now and a step before, relative to where they are with
    the gantry, and a box, in the middle: the foot of the gripper, the middle and the tip of
    each finger, the middle of the box and a mark on its upper edge.

    Reward: 1 - d / w - 0.2 g / w - 0.02 |a|^2 / 3, with the distance d of the middle of the box
    to its target, the distance g between it and the middle of the tips, the travel w of the
    gantry to a side and the action a; and 1 more where the box is placed. An episode ends where
    the box falls over, by 45 degrees, which takes 10; it diverges where the axis of a finger is
    inside a thing. `info` has `distance` d [m], `lift` of the box above the floor [m],
    `dropped`, and `success`: d is below `tolerance`, the box is still, no finger touches it.

    Attributes:
        tolerance: Distance of success [m].
        full_range: Time of a command to the gantry from one end to the other [s].
    """

    max_steps: int = eqx.field(static=True, default=400)
    tolerance: float = eqx.field(static=True, default=5 * mm)
    full_range: float = eqx.field(static=True, default=1.5)
    num_actions: ClassVar[int] = 3
    num_observations: ClassVar[int] = 2 * 3 + 2 + 2 + 2 * 7 * 2

    def default_params(self) -> PickParams:
        return PickParams()

    def begin(self, key, params):
        draw = jax.random.uniform(key, (4,), params.length.dtype)
        start = _BEGIN[0] + (_BEGIN[1] - _BEGIN[0]) * draw[0]
        across = _END[0] + (_END[1] - _END[0]) * draw[1]
        target = jnp.stack([across, params.shelf_height + params.box_height / 2])
        body = at_rest(_gripper(params)[0])
        body = body._replace(q=body.q.at[-2].set(start))
        line = between(params.fastest, params.supply, draw[2:])
        return body, jnp.zeros(3, start.dtype), PlaceGoal(target, line)

    def commanded(self, command, action, params):
        moved = command[:2] + 2 * params.max_travel * action[:2] * self.period / self.full_range
        place = jnp.clip(moved, -params.max_travel, params.max_travel)
        return jnp.append(place, params.max_pressure * (1 + action[2]) / 2)

    def moved(self, body, delivery, goal, params):
        model, finger = _gripper(params)
        after = rolled(
            model,
            body,
            _forces(params, finger, delivery, self.period),
            LinearlyImplicit(),
            time_step=self.time_step,
            steps=self.substeps,
        )
        axes = lines(model, after.q, _FINGERS, np.linspace(0.0, 1.0, POINTS))
        flat = axes.reshape(-1, 2)
        inside = gaps(_box(params), model, after.q, "box", flat)
        x, y = flat[:, 0], flat[:, 1]
        clear = [shape.distance(x, y) for shape in _ground(params)]
        fine = jnp.all(jnp.concatenate([inside, *clear]) > 0)
        reach = jnp.sum(params.max_travel) + params.foot_height + params.length
        return after, fine & within(axes, reach)

    def markers(self, body, params):
        model, _ = _gripper(params)
        fingers = lines(model, body.q, _FINGERS, _SEEN).reshape(-1, 2)
        foot = tip_pose(model, body.q)["up"][None, :2, 2]
        return jnp.concatenate([foot, fingers, of_thing(model, body.q, "box", _marks(params))])

    def observed(self, state, params):
        start = self.markers(at_rest(_gripper(params)[0]), params)
        seen = state.seen[0]
        middle = seen[-2]
        tips = (seen[2] + seen[4]) / 2
        ahead = jnp.concatenate([state.goal.target - middle, middle - tips])
        moved = (state.seen - start[None]).ravel()
        told = jnp.concatenate([ahead, moved]) / params.max_travel[0]
        return jnp.concatenate([_shares(state, params), told])

    def judged(self, before, action, after, params):
        model, _ = _gripper(params)
        q, v = after.body
        markers = self.markers(after.body, params)
        middle, size = markers[-2], params.max_travel[0]
        distance = _length(middle - after.goal.target)
        gap = _length(middle - (markers[2] + markers[4]) / 2)
        axes = lines(model, q, _FINGERS, np.linspace(0.0, 1.0, POINTS))
        apart = jnp.min(gaps(_box(params), model, q, "box", axes)) > params.radius
        still = jnp.sum(v[-2:] ** 2) < _STILL**2
        placed = (distance < self.tolerance) & still & apart
        dropped = jnp.abs(q[-3]) > _LEAN
        effort = 0.02 * jnp.sum(action**2) / 3
        reward = 1 - distance / size - 0.2 * gap / size - effort
        reward = jnp.where(placed, reward + 1, reward)
        reward = jnp.where(dropped, reward - LOST, reward)
        lift = middle[1] - params.box_height / 2
        news = {"distance": distance, "lift": lift, "dropped": dropped, "success": placed}
        return Verdict(reward, dropped, news)

    def scene(self, state, params):
        from dataclasses import replace

        from sorojax import view

        model, finger = _gripper(params)
        drawn = _fingers_drawn(params, model, finger, state)
        lower, upper = (np.array(corner) for corner in _WINDOW)
        poses = tip_pose(model, state.body.q)
        pose, foot = (np.asarray(poses[name]) for name in ("box", "up"))
        w, h = float(params.box_width) / 2, float(params.box_height) / 2
        corners = np.array([[-w, -h], [w, -h], [w, h], [-w, h], [-w, -h]])
        outline = corners @ pose[:2, :2].T + pose[:2, 2]
        shelf = float(params.shelf_height)
        ground = np.array([[lower[0], 0.0], [_EDGE, 0.0], [_EDGE, shelf], [upper[0], shelf]])
        wide = float(_half(params) + params.radius)
        beam = foot[:2, 2] + np.array([[-wide, 0.0], [wide, 0.0]])
        goal = np.asarray(state.goal.target)
        parts = (
            view.Lines([ground, beam], width=2.0),
            view.Lines([corners + goal], "#c0392b", 0.8, name="target"),
            view.Lines([outline], "#1f3b57", 2.0, name="box"),
        )
        return replace(view.merge_scenes(drawn, view.Scene(parts)), extent=(lower, upper))


def _length(gap: Float[Array, "2"]) -> Float[Array, ""]:
    """Of a gap [m]; smooth where it closes."""
    return jnp.sqrt(jnp.sum(gap**2) + (0.1 * mm) ** 2) - 0.1 * mm


def _shares(state, params: PickParams) -> Float[Array, "6"]:
    """What arrives and the commands, in shares of the greatest."""
    both = jnp.stack([state.supply.value, state.supply.commands[0]])
    place = both[:, :2] / params.max_travel[None]
    return jnp.concatenate([place, in_shares(both[:, 2:], params.max_pressure)], axis=1).ravel()


def _fingers_drawn(params: PickParams, model: Assembly, finger: Rod, state):
    """The fingers alone, as a scene, with the air in their chambers."""
    from dataclasses import replace

    from sorojax import view

    poses = forward_kinematics(model, state.body.q, np.array([0.0]))
    hung = {name: Part(finger, offset=poses[name][0]) for name in _FINGERS}
    q = state.body.q[2:-3]  # between the gantry and the box
    inside = tuple(
        PartForce(name, Pressurised(_chamber(params, finger, side), state.supply.value[2:]))
        for name, side in zip(_FINGERS, _SIDES, strict=True)
    )
    drawn = view.scene_of(assembly(SE2(), **hung), np.asarray(q), forces=inside)
    named = [part.name for part in drawn.parts]
    once = (
        replace(part, name="") if part.name in named[:k] else part
        for k, part in enumerate(drawn.parts)
    )
    return replace(drawn, parts=tuple(once))


def _half(params: PickParams) -> Float[Array, ""]:
    """From the middle of the gripper to the axis of a finger [m]."""
    return params.box_width / 2 + params.radius + params.clearance


def _box(params: PickParams) -> AbstractSdf:
    corner = jnp.stack([params.box_width, params.box_height]) / 2
    return Rectangle(-corner, corner, _ROUND)


def _marks(params: PickParams) -> Float[Array, "2 2"]:
    """The middle of the box and a mark on its upper edge, in its frame [m]."""
    return params.box_height * jnp.asarray([[0.0, 0.0], [0.0, 0.5]], params.length.dtype)


def _ground(params: PickParams) -> tuple[AbstractSdf, AbstractSdf]:
    """Floor and shelf."""
    top = jnp.stack([jnp.full_like(params.shelf_height, 1.0), params.shelf_height])
    return HalfPlane([0.0, 0.0], [0.0, 1.0]), Rectangle([_EDGE, -1.0], top, 1 * mm)


def _gripper(params: PickParams) -> tuple[Assembly, Rod]:
    """Gantry, fingers and box, and one of the fingers."""
    finger = rod(
        SE2(),
        chebyshev(kappa_z=3),
        circle(params.radius),
        length=params.length,
        young_modulus=params.young_modulus,
        poisson_ratio=POISSON,
        density=params.density,
        nodes=6,
    )
    dtype = params.length.dtype
    axis = Link(params.servo_mass, params.servo_mass * (10 * mm) ** 2)
    drive = {"stiffness": params.servo_stiffness, "damping": params.servo_damping}
    level, up = jnp.eye(2, dtype=dtype), jnp.asarray([0.0, 1.0], dtype)
    hanging = jnp.asarray(_HANGING, dtype)
    out = _half(params) * jnp.asarray([1.0, 0.0], dtype)
    foot = homogeneous(level, params.foot_height * up)
    parts = {
        "across": Part(axis, Prismatic([1.0, 0.0], **drive), offset=foot),
        "up": Part(axis, Prismatic([0.0, 1.0], **drive), on="across"),
    }
    for name, side in zip(_FINGERS, _SIDES, strict=True):
        parts[name] = Part(finger, on="up", offset=homogeneous(hanging, side * out))
    square = params.box_width**2 + params.box_height**2
    box = Link(params.mass, params.mass * square / 12)
    parts["box"] = Part(box, Free(), offset=homogeneous(level, params.box_height / 2 * up))
    return assembly(SE2(), **parts), finger


def _chamber(params: PickParams, finger: Rod, side: float) -> AbstractPressureMap:
    """That of the finger on a side, away from the other one."""
    place = side * params.chamber_offset * jnp.asarray([1.0, 0.0], params.length.dtype)
    areas = jnp.broadcast_to(params.chamber_area, (1,))
    return thread_chambers(finger, (Straight(place, nodes=6),), areas)


def _forces(params: PickParams, finger: Rod, delivery, period: float) -> tuple[Any, ...]:
    """Servos, pressure, contacts, weights and the damping of the rubber; the gantry carries
    its own weight."""
    dtype = params.length.dtype
    aim = params.servo_stiffness * delivery(jnp.asarray(period, dtype))
    law, radius = soft(params), params.radius
    weight = Gravity(params.gravity * jnp.asarray([0.0, -1.0], dtype))
    w, h = params.box_width / 2, params.box_height / 2
    foot = jnp.asarray([[x, -1.0] for x in np.linspace(-1, 1, 5)], dtype)
    others = jnp.asarray([[-1.0, 0.0], [1.0, 0.0], [-1.0, 1.0], [1.0, 1.0]], dtype)
    points = jnp.concatenate([foot, others]) * jnp.stack([w, h])[None]
    lengths = jnp.broadcast_to(params.box_width / 5, (len(points),))
    firm = hard(params, params.box_width / 5)
    forces: list[Any] = [JointEffort("across", aim[:1]), JointEffort("up", aim[1:2])]
    for name, side in zip(_FINGERS, _SIDES, strict=True):
        air = Inflated(_chamber(params, finger, side), Share(delivery, 2, 3))
        own = (
            air,
            weight,
            *(ObstacleContact(x, radius, law, points=12) for x in _ground(params)),
        )
        forces += [PartForce(name, force) for force in own]
        forces.append(PairForce(name, "box", LinkContact(_box(params), radius, law, POINTS)))
    stands = [LinkObstacle(x, points, lengths, firm) for x in _ground(params)]
    forces += [PartForce("box", force) for force in (*stands, weight)]
    meet = RodContact(jnp.stack([radius, radius]), law, points=12)
    return *forces, PairForce(*_FINGERS, meet), Damping(params.damping)
