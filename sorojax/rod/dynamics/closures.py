"""What closures ask of an assembly in motion, and the forces by which they get it.

A closure compares the frame that it holds with the joint frame that carries it: the rotation
and position of the first in the second, whose rate is the relative twist along the axes of
the joint frame, at the origin of the frame held. Its equations g(q, t) = 0 are those of the
joint; a reaction lambda does work on dg/dt, so that it is a wrench on the part held and the
opposite one on what holds it, and the generalised force is G' lambda with G = dg/dq.

Reference:
    Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 8.
"""

import functools
import itertools
from collections.abc import Callable
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
    Section,
    bias_accelerations,
    bias_rates,
    each,
    gather,
    in_own_frames,
)
from sorojax.rod.model.assembly import closure_ends, slices
from sorojax.rod.model.closure import Closure, equations
from sorojax.rod.model.joint import AbstractJoint, Group


class _End(NamedTuple):
    """A frame of a closure in the world, and the section or link that it is fixed to.

    Attributes:
        rotation, position: Of the frame.
        index: Of the part; None of the ground.
        directors, centre: Of the section or link frame [m].
        jacobian: Its twist, world axes, per twist and coordinate of its part.
        rows: Integrals from the base of a rod to the section [m]; None of a link.
    """

    rotation: Float[Array, "dim dim"]
    position: Float[Array, " dim"]
    index: int | None
    directors: Float[Array, "dim dim"]
    centre: Float[Array, " dim"]
    jacobian: Float[Array, "twist own"] | None = None
    rows: Float[Array, "1 quad"] | None = None


class _Seen(NamedTuple):
    """The frame that a closure holds as its joint frame sees it, and how that is turned."""

    joint: AbstractJoint
    rotation: Float[Array, "dim dim"]
    position: Float[Array, " dim"]
    turn: Float[Array, "dim dim"]


class _Pair(NamedTuple):
    """The two ends of a closure, and the one as the other sees it."""

    closure: Closure
    held: _End
    holder: _End
    seen: _Seen


class Change(NamedTuple):
    """How the violations change with time: themselves, their rates, and their second
    derivatives where no coordinate accelerates."""

    value: Float[Array, " equations"]
    rate: Float[Array, " equations"]
    bias: Float[Array, " equations"]


def violations(moment: AssemblyState, t: Float[Array, ""]) -> Float[Array, " equations"]:
    """g(q, t) of all closures [rad], [m]: zero where the loops are closed."""
    group, pairs = moment.assembly.group, _pairs(moment, t)
    return jnp.concatenate(
        [p.seen.joint.violation(group, p.seen.rotation, p.seen.position) for p in pairs]
    )


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
    loads: list[Array | None] = [None] * len(moment.frames)
    pairs = _pairs(moment, t)
    wrenches = [wrench[None] for wrench in _wrenches(moment, pairs, reactions)]
    for index, load in itertools.chain(*_pulled(pairs, wrenches)):
        before = loads[index]
        loads[index] = load[0] if before is None else before + load[0]
    return loads


def closure_jacobian(
    moment: AssemblyState, t: Float[Array, ""]
) -> Float[Array, "equations dof"]:
    """G: rates of the violations per rate of the assembly."""
    pairs = _pairs(moment, t)
    group = moment.assembly.group
    units = each(
        functools.partial(_unit_wrenches, group), [p.seen for p in pairs], at_once=True
    )
    pieces: list[dict[int, Array]] = [{} for _ in moment.frames]
    for k, loads in enumerate(_pulled(pairs, units)):
        for index, load in loads:
            pieces[index][k] = pieces[index][k] + load if k in pieces[index] else load
    return gather(moment, [_stacked(piece, units) for piece in pieces])


def _stacked(piece: dict[int, Array], units: list[Array]) -> Array | None:
    """Rows of all closures in the columns of one part: zero of those that are not on it."""
    if not piece:
        return None
    own, dtype = next((x.shape[1], x.dtype) for x in piece.values())
    rows = [piece.get(k, jnp.zeros((x.shape[0], own), dtype)) for k, x in enumerate(units)]
    return jnp.concatenate(rows)


def closure_wrenches(
    moment: AssemblyState, t: Float[Array, ""], reactions: Float[Array, " equations"]
) -> dict[str, Float[Array, " twist"]]:
    """Wrench [N m], [N] of each closure on the part that it holds, world axes, the moment
    about the origin of the frame that is held."""
    pairs = _pairs(moment, t)
    names = moment.assembly.loops
    return dict(zip(names, _wrenches(moment, pairs, reactions), strict=True))


def closure_change(moment: AssemblyState, t: Float[Array, ""]) -> Change:
    """The violations g, dg/dt = G v + g_t, and d^2 g/dt^2 - G dv/dt, by the second order in
    time of the poses of both ends."""
    biases, rows = _section_biases(moment), []
    for pair in _pairs(moment, t):
        rates = [_rates(moment, end, biases) for end in (pair.held, pair.holder)]
        apart = pair.held.position - pair.holder.position
        rows.append((pair.seen, pair.closure.motion, apart, *rates, t))
    parts = each(functools.partial(_second_order, moment.assembly.group), rows, at_once=True)
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
    value, drift = violations_and_drift(moment, t)
    return value, Held(closure_jacobian(moment, t), -drift)


class _Rates(NamedTuple):
    """How a frame moves, along world axes: spin and velocity, and their rates."""

    spin: Float[Array, " rot"]
    velocity: Float[Array, " dim"]
    turning: Float[Array, " rot"]
    acceleration: Float[Array, " dim"]


def _rates(moment: AssemblyState, end: _End, biases: list) -> _Rates | None:
    """Of a frame where no coordinate accelerates; None of the ground."""
    if end.index is None or end.jacobian is None:
        return None
    group, frame = moment.assembly.group, moment.frames[end.index]
    rot = group.rotation_dim
    own = moment.v[slices(moment.assembly)[end.index].rod_v]
    twist = end.jacobian @ jnp.concatenate([frame.twist, own])
    start, along = biases[end.index]
    bias = jnp.zeros_like(frame.twist) if start is None else start
    if end.rows is not None:
        bias = bias + jnp.concatenate([(end.rows @ rate)[0] for rate in along])
    bias = turned_twists(frame.rotation, bias[:, None], rot)[:, 0]
    if start is not None and end.rows is not None:
        turning = turned_twists(frame.rotation, start[:, None], rot)[:rot, 0]
        bias = bias.at[rot:].add(_cross(turning, end.centre - frame.position))
    at_centre = _Rates(twist[:rot], twist[rot:], bias[:rot], bias[rot:])
    if end.position is end.centre:
        return at_centre
    return _on_arm(at_centre, end.position - end.centre)


def _on_arm(rates: _Rates, arm: Float[Array, " dim"]) -> _Rates:
    """Of a frame at the end of an arm on the same body."""
    swept = _cross(rates.spin, arm)
    fall = _cross(rates.turning, arm) + _cross(rates.spin, swept)
    return rates._replace(
        velocity=rates.velocity + swept, acceleration=rates.acceleration + fall
    )


def _section_biases(moment: AssemblyState) -> list:
    """Of each part that a closure is on: the acceleration of its frame along its own axes, and
    how those of its sections grow along it, where no coordinate accelerates."""
    among = {index for index in closure_ends(moment.assembly) if index is not None}
    along = in_own_frames(moment, bias_rates, among=among)
    return list(zip(bias_accelerations(moment), along, strict=True))


def _relative(seen: _Seen, apart: Array, held: _Rates, holder: _Rates | None) -> Any:
    """The frame that is held, seen by the joint frame after a short time, exact to the second
    order."""
    rotation, position = seen.rotation, seen.position
    turn, spin, turning = seen.turn.T, held.spin, held.turning
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
    group: Group, seen: _Seen, motion: Any, apart: Array, held: _Rates, holder: Any, t: Array
) -> Change:
    later, dtype = _relative(seen, apart, held, holder), seen.position.dtype

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


def _pairs(moment: AssemblyState, t: Float[Array, ""]) -> list[_Pair]:
    """The ends of every closure."""
    found, ends = [], iter(_ends(moment))
    for closure in moment.assembly.closures:
        held, holder = next(ends), next(ends)
        if closure.motion is not None:
            holder = _beyond(holder, _pose(closure.motion, t, moment.q.dtype))
        apart = held.position - holder.position
        seen = turned_pose(holder.rotation.T, held.rotation, apart)
        found.append(_Pair(closure, held, holder, _Seen(closure.joint, *seen, holder.rotation)))
    return found


def _ends(moment: AssemblyState) -> list[_End]:
    """The frame that is held and the one that holds it, of every closure in turn."""
    model, dtype = moment.assembly, moment.q.dtype
    poses = [x for closure in model.closures for x in (closure.frame, closure.offset)]
    places = closure_ends(model), moment.ends, moment.operators.ends, poses
    found = []
    for index, section, rows, pose in zip(*places, strict=True):
        end = _in_world(moment, index, section)._replace(rows=rows)
        found.append(end if pose is None else _beyond(end, pose.astype(dtype)))
    return found


def _in_world(moment: AssemblyState, index: int | None, section: Section) -> _End:
    rotation, centre, angular, linear = section
    if index is None:
        return _End(rotation, centre, None, rotation, centre)
    frame = moment.frames[index]
    rotation, arm = turned_pose(frame.rotation, rotation, centre)
    centre, jacobian = frame.position + arm, jnp.concatenate([angular, linear])
    jacobian = turned_twists(frame.rotation, jacobian, moment.assembly.group.rotation_dim)
    return _End(rotation, centre, index, rotation, centre, jacobian)


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


def _wrenches(moment: AssemblyState, pairs: list[_Pair], reactions: Array) -> list[Array]:
    """Of each closure on the frame that is held, along world axes."""
    group = moment.assembly.group

    def one(seen: _Seen, reaction: Array) -> Array:
        _, pull = jax.vjp(_violation_after(group, seen), _still(group, reaction.dtype))
        return _along_world(seen, pull(reaction)[0][None])[0]

    ends = zip(pairs, equations(moment.assembly), strict=True)
    return each(one, [(pair.seen, reactions[at]) for pair, at in ends], at_once=True)


def _unit_wrenches(group: Group, *seen: Any) -> Float[Array, "held twist"]:
    """Those of reactions of one, along world axes."""
    at = _Seen(*seen)
    still = _still(group, at.position.dtype)
    return _along_world(at, jax.jacrev(_violation_after(group, at))(still))


def _along_world(seen: _Seen, wrenches: Float[Array, "n twist"]) -> Float[Array, "n twist"]:
    return turned_twists(seen.turn, wrenches.T, wrenches.shape[1] - seen.turn.shape[0]).T


def _still(group: Group, dtype: Any) -> Float[Array, " twist"]:
    return jnp.zeros(group.algebra_dim, dtype)


def _violation_after(group: Group, seen: _Seen):
    """The violation as a function of a small relative twist."""
    rot = group.rotation_dim

    def after(twist):
        turned = seen.rotation + _spun(twist[:rot], seen.rotation)
        return seen.joint.violation(group, turned, seen.position + twist[rot:])

    return after


def _pulled(
    pairs: list[_Pair], wrenches: list[Float[Array, "n twist"]]
) -> list[list[tuple[int, Float[Array, "n own"]]]]:
    """Generalised forces, in the columns of its part, on each end that is not on the ground,
    of each closure: of wrenches on the frame that is held, along world axes, and their
    opposites."""
    places, rows = [], []
    for k, (pair, wrench) in enumerate(zip(pairs, wrenches, strict=True)):
        for end, push in ((pair.held, wrench), (pair.holder, -wrench)):
            if end.index is not None and end.jacobian is not None:
                places.append((k, end.index))
                rows.append((push, pair.held.position - end.centre, end.jacobian))

    def force(wrench: Array, arm: Array, jacobian: Array) -> Array:
        moment, force = wrench[:, : -arm.shape[0]], wrench[:, -arm.shape[0] :]
        return jnp.concatenate([moment + moment_of(arm[None], force), force], 1) @ jacobian

    found: list[list[tuple[int, Array]]] = [[] for _ in pairs]
    for (k, index), load in zip(places, each(force, rows, at_once=True), strict=True):
        found[k].append((index, load))
    return found
