"""A hand of three fluidic fingers turns a ball about the upright axis."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.contact import LinePenalty
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
    hard,
    lines,
    of_thing,
    soft,
    within,
)
from sorojax.math.lie import SE3, homogeneous
from sorojax.math.ode.linearly_implicit import LinearlyImplicit
from sorojax.rod import (
    Assembly,
    Damping,
    Free,
    Gravity,
    Link,
    LinkContact,
    PairForce,
    Part,
    PartForce,
    Pressurised,
    Rod,
    Straight,
    assembly,
    chebyshev,
    circle,
    rod,
    thread_chambers,
)
from sorojax.rod.contact.links import LinkPoints
from sorojax.rod.contact.obstacle import AbstractContact, Side, Touch
from sorojax.sdf import Box, Cylinder, Sphere, translate
from sorojax.units import deg, mm

_FINGERS, _BALL = ("finger_0", "finger_1", "finger_2"), "ball"
_ANGLES = 2 * np.pi / 3 * np.arange(3)  # of the fingers round the axis
_ASIDE = 50 * deg  # of a chamber, from the outer side of its finger
_KNOB, _SPREAD = 3 * mm, 50 * deg  # radius of a knob, and its direction seen from the ball
_SEEN = np.array([0.5, 1.0])  # markers along a finger
_LEAST = 0.25  # of the greatest turn that is asked for
_EVEN = 0.1 * deg  # below which a turn is smooth


def _around(angles: np.ndarray, height: float) -> Float[np.ndarray, "points 3"]:
    """Unit vectors at some angles round the upright axis, so high."""
    flat = np.sqrt(1 - height**2)
    return np.stack(
        [flat * np.cos(angles), flat * np.sin(angles), np.full(len(angles), height)], axis=1
    )


_KNOBS = _around(_ANGLES + np.pi / 3, -float(np.cos(_SPREAD)))
_MARKS = np.concatenate([np.zeros((1, 3)), _around(np.pi / 3 * np.array([-1, 1]), 0.6)])


class BallParams(GraspParams):
    """Numbers of the hand and its ball, beside those of all grippers.

    Attributes:
        ball_radius: [m].
        clearance: Between the ball and a straight finger [m].
        height: Of the middle of the ball above the palm [m].
        max_turn: That is asked for, to either side [rad].
    """

    ball_radius: Float[Array, ""] = eqx.field(converter=real, default=25 * mm)
    clearance: Float[Array, ""] = eqx.field(converter=real, default=7 * mm)
    height: Float[Array, ""] = eqx.field(converter=real, default=45 * mm)
    max_turn: Float[Array, ""] = eqx.field(converter=real, default=120 * deg)


class TurnGoal(NamedTuple):
    """How far the ball should be turned [rad], and the supply of the episode."""

    turn: Float[Array, ""]
    supply: SupplyLine


class BallTurn(AbstractGrasp):
    """Turn a ball about the upright axis by an angle, with three fingers round it.

    The hand lies on its back. Three fingers stand upright round the ball, Cosserat rods with
    two modes of bending in each plane. Each has two chambers, 50 degrees to both sides of its
    outer side: both bend it inwards, one of them to a side as well. The ball is free. It lies
    on three knobs of the palm, and fingers, knobs and palm push and rub it. A finger sweeps a
    part of the way at most, so the fingers have to let go, go back and take hold again.

    The angle is drawn evenly, to either side, from a quarter of `max_turn` to all of it, and
    dead time and lag of the supply evenly between `fastest` and `supply`; the supply is not
    observed.

    Actions, 6 in [-1, 1]: the commanded pressures from 0 to the greatest, for each finger of
    the chamber that bends it counter-clockwise, from above, and of the other one. They arrive
    by the supply.

    Observations, 72: the pressures and the commands, in shares of the greatest from -1 to 1;
    where two marks on the ball should be less where they are, in radii of the ball; the middle
    and the tip of each finger, the middle of the ball and its two marks, now and a step
    before, in lengths of a finger, relative to where they are at the start.

    Reward: 1 - e / a - 0.05 |c|^2, with the angle e between the ball as it is and as it should
    be, the angle a that is asked for, and the change c of the commands since the step before,
    in shares; 1 at best. An episode ends where the ball is dropped, out of the fingers, which
    takes 10; it diverges where a finger is inside the ball. `info` has `angle` e and `turned`,
    about the upright axis [rad], `dropped`, and `success`: e is below `tolerance`.

    Attributes:
        tolerance: Angle of success [rad].
    """

    max_steps: int = eqx.field(static=True, default=400)
    tolerance: float = eqx.field(static=True, default=5 * deg)
    num_actions: ClassVar[int] = 6
    num_observations: ClassVar[int] = 2 * 6 + 2 * 3 + 2 * 9 * 3

    def default_params(self) -> BallParams:
        return BallParams()

    def begin(self, key, params):
        draw = jax.random.uniform(key, (3,), params.length.dtype, -1.0)
        share = _LEAST + (1 - _LEAST) * jnp.abs(draw[0])
        turn = params.max_turn * jnp.copysign(share, draw[0])
        line = between(params.fastest, params.supply, (1 + draw[1:]) / 2)
        body = at_rest(_hand(params)[0])
        return body, jnp.zeros(6, turn.dtype), TurnGoal(turn, line)

    def commanded(self, command, action, params):
        return params.max_pressure * (1 + action) / 2

    def moved(self, body, delivery, goal, params):
        model, finger = _hand(params)
        after = rolled(
            model,
            body,
            _forces(params, finger, delivery),
            LinearlyImplicit(),
            time_step=self.time_step,
            steps=self.substeps,
        )
        axes = lines(model, after.q, _FINGERS, np.linspace(0.0, 1.0, POINTS))
        away = axes - _middle(after.q, params)[None, None]
        outside = jnp.all(jnp.sum(away**2, axis=-1) > params.ball_radius**2)
        return after, outside & within(axes, 2 * params.length)

    def markers(self, body, params):
        model, _ = _hand(params)
        fingers = lines(model, body.q, _FINGERS, _SEEN).reshape(-1, 3)
        return jnp.concatenate([fingers, of_thing(model, body.q, _BALL, _marks(params))])

    def observed(self, state, params):
        start = self.markers(at_rest(_hand(params)[0]), params)
        seen = state.seen[0, -2:] - state.seen[0, -3:-2]
        ahead = (_turned(_marks(params), state.goal.turn)[1:] - seen) / params.ball_radius
        moved = (state.seen - start[None]) / params.length
        supplied = jnp.stack([state.supply.value, state.supply.commands[0]])
        shares = in_shares(supplied, params.max_pressure)
        return jnp.concatenate([shares.ravel(), ahead.ravel(), moved.ravel()])

    def judged(self, before, action, after, params):
        w, x, y, z = jnp.unstack(after.body.q[-7:-3])
        half = after.goal.turn / 2
        c, s = jnp.cos(half), jnp.sin(half)
        # the turn that is left, as a quaternion: that of the goal turned back, times the ball's
        scalar = jnp.abs(c * w + s * z)
        vector = jnp.stack([c * x + s * y, c * y - s * x, c * z - s * w])
        angle = 2 * jnp.arctan2(jnp.sqrt(jnp.sum(vector**2) + _EVEN**2), scalar) - 2 * _EVEN
        middle = _middle(after.body.q, params)
        aside = jnp.sum(middle[:2] ** 2) > _ring(params) ** 2
        dropped = aside | (middle[2] > params.length + params.ball_radius)
        change = action - in_shares(before.supply.commands[0], params.max_pressure)
        reward = 1 - angle / jnp.abs(after.goal.turn) - 0.05 * jnp.sum(change**2) / 4
        news = {
            "angle": angle,
            "turned": 2 * jnp.arctan2(z, w),
            "dropped": dropped,
            "success": angle < self.tolerance,
        }
        return Verdict(jnp.where(dropped, reward - LOST, reward), dropped, news)

    def scene(self, state, params):
        from sorojax import view

        model, finger = _hand(params)
        chambers = _chambers(params, finger)
        inside = tuple(
            PartForce(name, Pressurised(chambers, state.supply.value[2 * k : 2 * k + 2]))
            for k, name in enumerate(_FINGERS)
        )
        ball = {_BALL: Sphere([0.0, 0.0, 0.0], float(params.ball_radius))}
        q = np.asarray(state.body.q)
        hand = view.scene_of(model, q, forces=inside, shapes=ball)
        wide = float(_ring(params) + params.radius)
        palm = view.scene_of(Box([-wide, -wide, -6 * mm], [wide, wide, 0.0]))
        pegs = [_peg(np.asarray(knob)) for knob in _knobs(params)]
        marks = of_thing(model, state.body.q, _BALL, 1.02 * _marks(params))[1:]
        wanted = _middle(state.body.q, params)[None] + 1.1 * _turned(
            _marks(params), state.goal.turn
        )
        dots = (
            view.Dots(np.asarray(marks), size=6.0),
            view.Dots(np.asarray(wanted)[1:], "#c0392b", 6.0, "wanted"),
        )
        return view.merge_scenes(palm, *pegs, hand, view.Scene(dots))


class Knobs(AbstractContact):
    """A ball, a link, on fixed knobs and on a palm in the plane z = 0.

    Attributes:
        knobs: Their middles [m].
        size: Radius of a knob [m].
        radius: Of the ball [m].
        law: Force per length; each contact stands for one radius of a knob.
    """

    knobs: Float[Array, "knobs 3"]
    size: Float[Array, ""] = eqx.field(converter=real)
    radius: Float[Array, ""]
    law: LinePenalty

    @property
    def narrowest(self):
        return self.size

    def is_near(self, motion, h):
        return jnp.ones((), bool)

    def passed(self, before, after):
        return jnp.zeros((), bool)

    def touch(self, motion):
        link: Any = motion
        middle = link.base.position
        away = middle[None] - self.knobs
        far = jnp.sqrt(jnp.sum(away**2, axis=1))
        up = jnp.asarray([[0.0, 0.0, 1.0]], middle.dtype)
        normal = jnp.concatenate([away / far[:, None], up])
        gap = jnp.append(far - self.size, middle[2]) - self.radius
        at: Any = LinkPoints(link, jnp.broadcast_to(middle, normal.shape))
        weights = jnp.broadcast_to(self.size, gap.shape)
        return Touch(gap, normal, weights, (Side(at, -self.radius * normal, 1.0),))


def _ring(params: BallParams) -> Float[Array, ""]:
    """Radius of the circle on which the fingers stand [m]."""
    return params.ball_radius + params.radius + params.clearance


def _knobs(params: BallParams) -> Float[Array, "3 3"]:
    """Middles of the knobs, so that they just touch the ball [m]."""
    apart = (params.ball_radius + _KNOB) * jnp.asarray(_KNOBS, params.length.dtype)
    return apart.at[:, 2].add(params.height)


def _peg(knob: Float[np.ndarray, "3"]):
    """A knob and the peg that carries it, as a scene."""
    from sorojax import view

    up = float(knob[2])
    peg = translate(Cylinder(0.6 * _KNOB, up), [float(knob[0]), float(knob[1]), up / 2])
    return view.scene_of(peg | Sphere(knob, _KNOB))


def _marks(params: BallParams) -> Float[Array, "3 3"]:
    """The middle of the ball and two marks on it, in its frame [m]."""
    return params.ball_radius * jnp.asarray(_MARKS, params.length.dtype)


def _turned(points: Float[Array, "points 3"], turn: Array) -> Float[Array, "points 3"]:
    """Points turned about the upright axis."""
    c, s = jnp.cos(turn), jnp.sin(turn)
    x, y, z = jnp.unstack(points, axis=1)
    return jnp.stack([c * x - s * y, s * x + c * y, z], axis=1)


def _middle(q: Float[Array, " coordinates"], params: BallParams) -> Float[Array, "3"]:
    """Of the ball [m]."""
    return q[-3:].at[2].add(params.height)


def _upright(angle: float, radius: Array) -> Float[Array, "4 4"]:
    """Pose of a finger on the ring: its axis up, its local y to the middle."""
    c, s = np.cos(angle), np.sin(angle)
    turn = jnp.asarray([[0.0, -c, s], [0.0, -s, -c], [1.0, 0.0, 0.0]], radius.dtype)
    return homogeneous(turn, radius * jnp.asarray([c, s, 0.0], radius.dtype))


def _hand(params: BallParams) -> tuple[Assembly, Rod]:
    """Three fingers and the ball, and one of the fingers."""
    finger = rod(
        SE3(),
        chebyshev(kappa_y=2, kappa_z=2),
        circle(params.radius),
        length=params.length,
        young_modulus=params.young_modulus,
        poisson_ratio=POISSON,
        density=params.density,
        nodes=6,
    )
    ring = _ring(params)
    parts = {
        name: Part(finger, offset=_upright(float(angle), ring))
        for name, angle in zip(_FINGERS, _ANGLES, strict=True)
    }
    inertia = jnp.broadcast_to(0.4 * params.mass * params.ball_radius**2, (3,))
    up = params.height * jnp.asarray([0.0, 0.0, 1.0], params.length.dtype)
    place = homogeneous(jnp.eye(3, dtype=up.dtype), up)
    parts[_BALL] = Part(Link(params.mass, inertia), Free(), offset=place)
    return assembly(SE3(), **parts), finger


def _chambers(params: BallParams, finger: Rod):
    """Both chambers of a finger, on its outer side."""
    back, side = -float(np.cos(_ASIDE)), float(np.sin(_ASIDE))
    places = (jnp.asarray([back, sign * side], params.length.dtype) for sign in (1.0, -1.0))
    routes = tuple(Straight(params.chamber_offset * place, nodes=6) for place in places)
    return thread_chambers(finger, routes, jnp.broadcast_to(params.chamber_area, (2,)))


def _forces(params: BallParams, finger: Rod, delivery) -> tuple[Any, ...]:
    """Pressures, grip, knobs, weight and the damping of the rubber."""
    chambers = _chambers(params, finger)
    grip = LinkContact(Sphere([0.0, 0.0, 0.0], params.ball_radius), params.radius,
                       soft(params), points=POINTS)  # fmt: skip
    ball = params.ball_radius
    knobs = Knobs(_knobs(params), _KNOB, ball, hard(params, real(_KNOB)))
    down = params.gravity * jnp.asarray([0.0, 0.0, -1.0], ball.dtype)
    inside = [
        PartForce(name, Inflated(chambers, Share(delivery, 2 * k, 2 * k + 2)))
        for k, name in enumerate(_FINGERS)
    ]
    grips = [PairForce(name, _BALL, grip) for name in _FINGERS]
    return (*inside, *grips, PartForce(_BALL, knobs), Gravity(down), Damping(params.damping))
