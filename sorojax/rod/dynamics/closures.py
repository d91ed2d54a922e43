"""What closures ask of an assembly in motion, and the forces by which they get it.

A closure compares the frame that it holds with the joint frame that carries it: the rotation
and position of the first in the second, whose rate is the relative twist along the axes of
the joint frame, at the origin of the frame held. Its equations g(q, t) = 0 are those of the
joint; a reaction lambda does work on dg/dt, so that it is a wrench on the part held and the
opposite one on what holds it, and the generalised force is G' lambda with G = dg/dq.

Reference:
    Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 8.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.math.lie import homogeneous
from sorojax.math.ode.held import Held, accelerate
from sorojax.rod.dynamics.moving import spin_cross, turned_pose, turned_twists
from sorojax.rod.dynamics.points import moment_of
from sorojax.rod.dynamics.tree import (
    AssemblyState,
    Frame,
    Section,
    bias_accelerations,
    bias_rates,
    each,
    gather,
    in_own_frames,
)
from sorojax.rod.model.assembly import closure_ends, slices
from sorojax.rod.model.closure import equations
from sorojax.rod.model.joint import AbstractJoint, Group


class _Place(NamedTuple):
    """What a frame of a closure is fixed to, and where on it.

    Attributes:
        frame: Of the part, in the world; None of the ground.
        section: Of a rod or the frame of a link, in the frame of the part.
        rows: Integrals from the base of a rod to the section [m]; None of a link.
        pose: Of the frame in the section; None where they are one.
    """

    frame: Frame | None
    section: Section
    rows: Float[Array, "1 quad"] | None
    pose: Float[Array, "h h"] | None


class _Ends(NamedTuple):
    """Both ends of a closure, its joint, and how that is driven."""

    joint: AbstractJoint
    motion: Callable[[Array], Array] | None
    held: _Place
    holder: _Place


class _End(NamedTuple):
    """A frame of a closure in the world, and the section or link that it is fixed to.

    Attributes:
        rotation, position: Of the frame.
        centre: Of the section or link frame [m].
        jacobian: Its twist, world axes, per twist and coordinate of its part; None of the
            ground.
    """

    rotation: Float[Array, "dim dim"]
    position: Float[Array, " dim"]
    centre: Float[Array, " dim"]
    jacobian: Float[Array, "twist own"] | None


class _Seen(NamedTuple):
    """The two ends of a closure, and the frame held as the joint frame sees it."""

    joint: AbstractJoint
    held: _End
    holder: _End
    rotation: Float[Array, "dim dim"]
    position: Float[Array, " dim"]


class Change(NamedTuple):
    """How the violations change with time: themselves, their rates, and their second
    derivatives where no coordinate accelerates."""

    value: Float[Array, " equations"]
    rate: Float[Array, " equations"]
    bias: Float[Array, " equations"]


def violations(moment: AssemblyState, t: Float[Array, ""]) -> Float[Array, " equations"]:
    """g(q, t) of all closures [rad], [m]: zero where the loops are closed."""
    group, rows = moment.assembly.group, [(ends,) for ends in _ends(moment)]
    one = lambda ends: _violation(group, _seen(ends, t))  # noqa: E731
    return jnp.concatenate(each(one, rows, at_once=True))


def violations_and_drift(
    moment: AssemblyState, t: Float[Array, ""]
) -> tuple[Float[Array, " equations"], Float[Array, " equations"]]:
    """g(q, t), and its rate by time alone, which driven ends have."""
    if all(closure.motion is None for closure in moment.assembly.closures):
        value = violations(moment, t)
        return value, jnp.zeros_like(value)
    return jax.jvp(lambda t: violations(moment, t), (t,), (jnp.ones_like(t),))


def closure_force(
    moment: AssemblyState, t: Float[Array, ""], reactions: Float[Array, " equations"]
) -> Float[Array, " dof"]:
    """Generalised force G' lambda of the closures."""
    return gather(moment, closure_loads(moment, t, reactions))


def closure_loads(
    moment: AssemblyState, t: Float[Array, ""], reactions: Float[Array, " equations"]
) -> list[Float[Array, " own"] | None]:
    """The same on each part, in its own columns; None without a closure."""
    group, places = moment.assembly.group, equations(moment.assembly)

    def one(ends: _Ends, reaction: Array) -> tuple[Array | None, Array | None]:
        seen = _seen(ends, t)
        return _pulled(seen, (reaction @ _slopes(group, seen))[None])

    rows = [(ends, reactions[at]) for ends, at in zip(_ends(moment), places, strict=True)]
    loads: list[Array | None] = [None] * len(moment.frames)
    for _, index, load in _on_parts(moment, each(one, rows, at_once=True)):
        before = loads[index]
        loads[index] = load[0] if before is None else before + load[0]
    return loads


def closure_jacobian(
    moment: AssemblyState, t: Float[Array, ""]
) -> Float[Array, "equations dof"]:
    """G: rates of the violations per rate of the assembly."""
    return _violations_and_jacobian(moment, t)[1]


def _violations_and_jacobian(
    moment: AssemblyState, t: Float[Array, ""]
) -> tuple[Float[Array, " equations"], Float[Array, "equations dof"]]:
    group = moment.assembly.group

    def one(ends: _Ends) -> tuple[Array, Any]:
        seen = _seen(ends, t)
        return _violation(group, seen), _pulled(seen, _slopes(group, seen))

    found = each(one, [(ends,) for ends in _ends(moment)], at_once=True)
    values = [value for value, _ in found]
    pieces: list[dict[int, Array]] = [{} for _ in moment.frames]
    for k, index, load in _on_parts(moment, [loads for _, loads in found]):
        pieces[index][k] = pieces[index][k] + load if k in pieces[index] else load
    return jnp.concatenate(values), gather(moment, [_stacked(x, values) for x in pieces])


def _stacked(piece: dict[int, Array], values: list[Array]) -> Array | None:
    """Rows of all closures in the columns of one part: zero of those that are not on it."""
    if not piece:
        return None
    own, dtype = next((x.shape[1], x.dtype) for x in piece.values())
    rows = [piece.get(k, jnp.zeros((x.shape[0], own), dtype)) for k, x in enumerate(values)]
    return jnp.concatenate(rows)


def _on_parts(
    moment: AssemblyState, loads: list[tuple[Array | None, Array | None]]
) -> Iterator[tuple[int, int, Array]]:
    """Number of the closure, index of the part, and load, of every end that is not on the
    ground."""
    on = iter(closure_ends(moment.assembly))
    for k, both in enumerate(loads):
        for load in both:
            index = next(on)
            if index is not None and load is not None:
                yield k, index, load


def closure_wrenches(
    moment: AssemblyState, t: Float[Array, ""], reactions: Float[Array, " equations"]
) -> dict[str, Float[Array, " twist"]]:
    """Wrench [N m], [N] of each closure on the part that it holds, world axes, the moment
    about the origin of the frame that is held."""
    group, model = moment.assembly.group, moment.assembly
    one = lambda ends, reaction: reaction @ _slopes(group, _seen(ends, t))  # noqa: E731
    places = zip(_ends(moment), equations(model), strict=True)
    found = each(one, [(ends, reactions[at]) for ends, at in places], at_once=True)
    return dict(zip(model.loops, found, strict=True))


def closure_change(moment: AssemblyState, t: Float[Array, ""]) -> Change:
    """The violations g, dg/dt = G v + g_t, and d^2 g/dt^2 - G dv/dt, by the second order in
    time of the poses of both ends."""
    group, moves = moment.assembly.group, _moves(moment)

    def one(ends: _Ends, held: _Move, holder: _Move | None) -> Change:
        seen = _seen(ends, t)
        rates = _rates(ends.held, seen.held, held), _rates(ends.holder, seen.holder, holder)
        return _second_order(group, seen, ends.motion, *rates, t)

    rows = list(zip(_ends(moment), moves[::2], moves[1::2], strict=True))
    parts = each(one, rows, at_once=True)
    return Change(*(jnp.concatenate(column) for column in zip(*parts, strict=True)))


def held(moment: AssemblyState, t: Float[Array, ""], pull: float = 0.0) -> Held:
    """What the closures ask of accelerations: d^2 g/dt^2 = 0, or with a `pull` [1/s] what
    brings back a violation as a critically damped spring does.

    Reference:
        Baumgarte, Comput. Methods Appl. Mech. Engrg. 1, 1972, for the pull.
    """
    change, rows = closure_change(moment, t), closure_jacobian(moment, t)
    if pull == 0:
        return Held(rows, -change.bias)
    return Held(rows, -change.bias - 2 * pull * change.rate - pull**2 * change.value)


def divided(
    moment: AssemblyState, t: Float[Array, ""], mass: Array, force: Float[Array, " dof"]
) -> tuple[Float[Array, " dof"], Float[Array, " equations"]]:
    """A generalised force as the least effort, in the metric of the inverse mass, and the
    reactions of closures beside it."""
    rows = closure_jacobian(moment, t)
    found = accelerate(mass, force, Held(rows, jnp.zeros(rows.shape[0], rows.dtype)))
    return mass @ found.x, -found.reactions


def held_rates(
    moment: AssemblyState, t: Float[Array, ""]
) -> tuple[Float[Array, " equations"], Held]:
    """The violations, and what the closures ask of rates: G v = - g_t."""
    value, rows = _violations_and_jacobian(moment, t)
    if all(closure.motion is None for closure in moment.assembly.closures):
        return value, Held(rows, jnp.zeros_like(value))
    return value, Held(rows, -violations_and_drift(moment, t)[1])


class _Move(NamedTuple):
    """How a part moves where no coordinate accelerates.

    Attributes:
        rates: Twist of its frame, own axes, and rates of its coordinates.
        start: Acceleration of its frame, own axes; None where it has none.
        along: How that of its sections grows along it, at the nodes.
    """

    rates: Float[Array, " own"]
    start: Float[Array, " twist"] | None
    along: Any


class _Rates(NamedTuple):
    """How a frame moves, along world axes: spin and velocity, and their rates."""

    spin: Float[Array, " rot"]
    velocity: Float[Array, " dim"]
    turning: Float[Array, " rot"]
    acceleration: Float[Array, " dim"]


def _rates(place: _Place, end: _End, move: _Move | None) -> _Rates | None:
    """Of a frame where no coordinate accelerates; None of the ground."""
    if place.frame is None or end.jacobian is None or move is None:
        return None
    frame, rot = place.frame, end.jacobian.shape[0] - end.centre.shape[0]
    twist = end.jacobian @ move.rates
    bias = jnp.zeros_like(twist) if move.start is None else move.start
    if place.rows is not None:
        bias = bias + jnp.concatenate([(place.rows @ rate)[0] for rate in move.along])
    bias = turned_twists(frame.rotation, bias[:, None], rot)[:, 0]
    if move.start is not None and place.rows is not None:
        turning = turned_twists(frame.rotation, move.start[:, None], rot)[:rot, 0]
        bias = bias.at[rot:].add(_cross(turning, end.centre - frame.position))
    at_centre = _Rates(twist[:rot], twist[rot:], bias[:rot], bias[rot:])
    if place.pose is None:
        return at_centre
    return _on_arm(at_centre, end.position - end.centre)


def _on_arm(rates: _Rates, arm: Float[Array, " dim"]) -> _Rates:
    """Of a frame at the end of an arm on the same body."""
    swept = _cross(rates.spin, arm)
    fall = _cross(rates.turning, arm) + _cross(rates.spin, swept)
    return rates._replace(
        velocity=rates.velocity + swept, acceleration=rates.acceleration + fall
    )


def _moves(moment: AssemblyState) -> list[_Move | None]:
    """Of the part at each end of each closure; None of the ground."""
    on = closure_ends(moment.assembly)
    along = in_own_frames(moment, bias_rates, among={k for k in on if k is not None})
    starts, at = bias_accelerations(moment), slices(moment.assembly)

    def move(index: int) -> _Move:
        own = moment.v[at[index].rod_v]
        rates = jnp.concatenate([moment.frames[index].twist, own])
        return _Move(rates, starts[index], along[index])

    return [None if index is None else move(index) for index in on]


def _relative(seen: _Seen, held: _Rates, holder: _Rates | None) -> Any:
    """The frame that is held, seen by the joint frame after a short time, exact to the second
    order."""
    rotation, position = seen.rotation, seen.position
    turn, spin, turning = seen.holder.rotation.T, held.spin, held.turning
    apart = seen.held.position - seen.holder.position
    velocity, acceleration = held.velocity, held.acceleration
    if holder is not None:
        # seen from a frame that turns itself
        velocity, acceleration = velocity - holder.velocity, acceleration - holder.acceleration
        spin = spin - holder.spin
        swept = _cross(holder.spin, apart)
        acceleration = acceleration - _cross(holder.turning, apart)
        acceleration = acceleration + _cross(holder.spin, swept - 2 * velocity)
        velocity = velocity - swept
        turning = turning - holder.turning
        if spin.shape[0] == 3:
            turning = turning - jnp.cross(holder.spin, spin)
    rot = spin.shape[0]
    both = jnp.stack([jnp.concatenate(x) for x in ((spin, velocity), (turning, acceleration))])
    first, second = turned_twists(turn, both.T, rot).T
    turned = _spun(first[:rot], rotation)
    bent = _spun(second[:rot], rotation) + _spun(first[:rot], turned)

    def later(x):
        half = x**2 / 2
        return rotation + x * turned + half * bent, position + x * first[rot:] + half * second[
            rot:
        ]

    return later


def _second_order(
    group: Group, seen: _Seen, motion: Any, held: Any, holder: _Rates | None, t: Array
) -> Change:
    later, dtype = _relative(seen, held, holder), seen.position.dtype

    def violation(x):
        rotation, position = later(x)
        if motion is not None:
            # `later` sees the joint frame as it stands at t
            now, moved = (_pose(motion, at, dtype) for at in (t, t + x))
            turn = moved[:-1, :-1].T @ now[:-1, :-1]
            position = turn @ position + moved[:-1, :-1].T @ (now[:-1, -1] - moved[:-1, -1])
            rotation = turn @ rotation
        return seen.joint.violation(group, rotation, position)

    def rate(x):
        return jax.jvp(violation, (x,), (jnp.ones_like(x),))

    zero = jnp.zeros((), dtype)
    (value, first), (_, second) = jax.jvp(rate, (zero,), (jnp.ones_like(zero),))
    return Change(value, first, second)


def _cross(spin: Float[Array, " rot"], arm: Float[Array, " dim"]) -> Float[Array, " dim"]:
    return spin_cross(spin[None], arm[None])[0]


def _spun(spin: Float[Array, " rot"], axes: Float[Array, "dim dim"]) -> Array:
    """spin x each column."""
    return spin_cross(spin[None], axes.T).T


def _ends(moment: AssemblyState) -> list[_Ends]:
    """Where both ends of every closure are."""
    model, dtype = moment.assembly, moment.q.dtype
    poses = [x for closure in model.closures for x in (closure.frame, closure.offset)]
    on, rows = closure_ends(model), moment.operators.ends
    frames = [None if index is None else moment.frames[index] for index in on]
    poses = [None if pose is None else pose.astype(dtype) for pose in poses]
    places = [_Place(*x) for x in zip(frames, moment.ends, rows, poses, strict=True)]
    both = zip(model.closures, places[::2], places[1::2], strict=True)
    return [_Ends(closure.joint, closure.motion, *ends) for closure, *ends in both]


def _seen(ends: _Ends, t: Float[Array, ""]) -> _Seen:
    """A closure at `t`."""
    held, holder = _in_world(ends.held), _in_world(ends.holder)
    if ends.motion is not None:
        holder = _beyond(holder, _pose(ends.motion, t, holder.position.dtype))
    apart = held.position - holder.position
    pose = turned_pose(holder.rotation.T, held.rotation, apart)
    return _Seen(ends.joint, held, holder, *pose)


def _in_world(place: _Place) -> _End:
    rotation, centre, angular, linear = place.section
    jacobian = None
    if place.frame is not None:
        frame = place.frame
        rotation, arm = turned_pose(frame.rotation, rotation, centre)
        centre, jacobian = frame.position + arm, jnp.concatenate([angular, linear])
        jacobian = turned_twists(frame.rotation, jacobian, angular.shape[0])
    end = _End(rotation, centre, centre, jacobian)
    return end if place.pose is None else _beyond(end, place.pose)


def _pose(motion: Callable[[Array], Array], t: Array, dtype: Any) -> Float[Array, "h h"]:
    """Where the motion of a closure has its joint."""
    moved = motion(t).astype(dtype)
    if moved.ndim == 2:
        return moved
    return homogeneous(jnp.asarray(np.eye(moved.shape[0]), dtype), moved)


def _beyond(end: _End, pose: Float[Array, "h h"]) -> _End:
    """A frame at a pose in the frame of an end."""
    rotation, arm = turned_pose(end.rotation, pose[:-1, :-1], pose[:-1, -1])
    return end._replace(rotation=rotation, position=end.position + arm)


def _violation(group: Group, seen: _Seen) -> Float[Array, " held"]:
    return seen.joint.violation(group, seen.rotation, seen.position)


def _slopes(group: Group, seen: _Seen) -> Float[Array, "held twist"]:
    """Wrenches of reactions of one on the frame that is held, along world axes."""
    wrenches = seen.joint.slopes(group, seen.rotation, seen.position)
    return turned_twists(seen.holder.rotation, wrenches.T, group.rotation_dim).T


def _pulled(
    seen: _Seen, wrenches: Float[Array, "n twist"]
) -> tuple[Float[Array, "n own"] | None, Float[Array, "n own"] | None]:
    """Generalised forces on the parts at both ends, in their own columns, of wrenches on the
    frame that is held, along world axes, and of their opposites; None on the ground."""

    def force(end: _End, push: Array) -> Array | None:
        if end.jacobian is None:
            return None
        arm = seen.held.position - end.centre
        moment, force = push[:, : -arm.shape[0]], push[:, -arm.shape[0] :]
        turning = moment + moment_of(arm[None], force)
        return jnp.concatenate([turning, force], axis=1) @ end.jacobian

    return force(seen.held, wrenches), force(seen.holder, -wrenches)
