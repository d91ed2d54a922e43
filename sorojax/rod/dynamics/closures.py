"""What closures ask of an assembly in motion, and the forces by which they get it.

A closure compares the frame that it holds with the joint frame that carries it: the rotation
and position of the first in the second, whose rate is the relative twist along the axes of
the joint frame, at the origin of the frame held. Its equations g(q, t) = 0 are those of the
joint; a reaction lambda does work on dg/dt, so that it is a wrench on the part held and the
opposite one on what holds it, and the generalised force is G' lambda with G = dg/dq.

Reference:
    Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 8.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.moving import spin_cross, swept, turned_pose
from sorojax.rod.dynamics.points import Points, from_base, moment_of
from sorojax.rod.dynamics.tree import AssemblyState, gather, part_columns, part_motion
from sorojax.rod.model.assembly import index_of
from sorojax.rod.model.closure import Closure, equations
from sorojax.rod.model.link import LinkState


class _End(NamedTuple):
    """A frame of a closure in the world, and the section or link that it is fixed to.

    Attributes:
        rotation, position: Of the frame.
        centre: Of the section or link frame [m].
        index: Of the part; None of the ground.
        body: The section at which loads act; None of the ground.
    """

    rotation: Float[Array, "dim dim"]
    position: Float[Array, " dim"]
    centre: Float[Array, " dim"]
    index: int | None
    body: Points | LinkState | None


class _Pair(NamedTuple):
    """The two ends of a closure, and the frame that is held as the joint frame sees it."""

    closure: Closure
    held: _End
    holder: _End
    rotation: Float[Array, "dim dim"]
    position: Float[Array, " dim"]


def violations(moment: AssemblyState, t: Float[Array, ""]) -> Float[Array, " equations"]:
    """g(q, t) of all closures [rad], [m]: zero where the loops are closed."""
    group, pairs = moment.assembly.group, _pairs(moment, t)
    return jnp.concatenate(
        [p.closure.joint.violation(group, p.rotation, p.position) for p in pairs]
    )


def closure_force(
    moment: AssemblyState, t: Float[Array, ""], reactions: Float[Array, " equations"]
) -> Float[Array, " dof"]:
    """Generalised force G' lambda of the closures."""
    loads: list[Any] = [None] * len(moment.frames)
    pairs = _pairs(moment, t)
    for pair, wrench in zip(pairs, _wrenches(moment, pairs, reactions), strict=True):
        for end, sign in ((pair.held, 1), (pair.holder, -1)):
            if end.index is not None:
                load = _load(end, pair.held.position, sign * wrench)
                before = loads[end.index]
                loads[end.index] = load if before is None else before + load
    return gather(moment, loads)


def closure_jacobian(
    moment: AssemblyState, t: Float[Array, ""]
) -> Float[Array, "equations dof"]:
    """G: rates of the violations per rate of the assembly."""
    columns, rows = part_columns(moment), []
    for pair in _pairs(moment, t):
        twist = _moved(pair.held, pair.held.position, columns)
        if pair.holder.index is not None:
            twist = twist - _moved(pair.holder, pair.held.position, columns)
        rows.append(_slopes(moment, pair) @ _seen_from(pair.holder.rotation, twist))
    return jnp.concatenate(rows)


def closure_wrenches(
    moment: AssemblyState, t: Float[Array, ""], reactions: Float[Array, " equations"]
) -> dict[str, Float[Array, " twist"]]:
    """Wrench [N m], [N] of each closure on the part that it holds, world axes, the moment
    about the origin of the frame that is held."""
    pairs = _pairs(moment, t)
    names = moment.assembly.loops
    return dict(zip(names, _wrenches(moment, pairs, reactions), strict=True))


def _pairs(moment: AssemblyState, t: Float[Array, ""]) -> list[_Pair]:
    """The ends of every closure."""
    places: dict[int, Any] = {}
    found = []
    for closure in moment.assembly.closures:
        held = _end(moment, places, closure.part, closure.at, closure.frame)
        holder = _end(moment, places, closure.on, closure.s, closure.offset)
        if closure.motion is not None:
            moved = closure.motion(t).astype(moment.q.dtype)
            holder = _beyond(holder, moved)
        turn = holder.rotation.T
        rotation, position = turned_pose(turn, held.rotation, held.position - holder.position)
        found.append(_Pair(closure, held, holder, rotation, position))
    return found


def _end(
    moment: AssemblyState, places: dict[int, Any], part: str | None, s: Array, pose: Any
) -> _End:
    dim, dtype = moment.assembly.group.space_dim, moment.q.dtype
    if part is None:
        origin = jnp.zeros(dim, dtype)
        end = _End(jnp.asarray(np.eye(dim), dtype), origin, origin, None, None)
    else:
        index = index_of(moment.assembly, part)
        if index not in places:
            places[index] = part_motion(moment, index)
        body = places[index]
        if isinstance(body, RodState):
            at = Points(body, from_base(body.rod, s[None].astype(dtype)))
            end = _End(at.directors[0], at.position[0], at.position[0], index, at)
        else:
            base = body.base
            end = _End(base.directors, base.position, base.position, index, body)
    return end if pose is None else _beyond(end, pose.astype(dtype))


def _beyond(end: _End, pose: Float[Array, "h h"]) -> _End:
    """A frame at a pose in the frame of an end."""
    rotation, arm = turned_pose(end.rotation, pose[:-1, :-1], pose[:-1, -1])
    return end._replace(rotation=rotation, position=end.position + arm)


def _wrenches(moment: AssemblyState, pairs: list[_Pair], reactions: Array) -> list[Array]:
    """Of each closure on the frame that is held, along world axes."""
    found = []
    for pair, at in zip(pairs, equations(moment.assembly), strict=True):
        _, pull = jax.vjp(_violation_after(moment, pair), _still(moment))
        (wrench,) = pull(reactions[at])
        rot = moment.assembly.group.rotation_dim
        turned = pair.holder.rotation @ wrench[rot:]
        spun = pair.holder.rotation @ wrench[:rot] if rot == 3 else wrench[:rot]
        found.append(jnp.concatenate([spun, turned]))
    return found


def _slopes(moment: AssemblyState, pair: _Pair) -> Float[Array, "held twist"]:
    """Rates of the violation per relative twist."""
    return jax.jacrev(_violation_after(moment, pair))(_still(moment))


def _still(moment: AssemblyState) -> Float[Array, " twist"]:
    return jnp.zeros(moment.assembly.group.algebra_dim, moment.q.dtype)


def _violation_after(moment: AssemblyState, pair: _Pair):
    """The violation as a function of a small relative twist."""
    group = moment.assembly.group
    rot = group.rotation_dim

    def after(twist):
        turned = pair.rotation + spin_cross(twist[None, :rot], pair.rotation.T).T
        return pair.closure.joint.violation(group, turned, pair.position + twist[rot:])

    return after


def _seen_from(rotation: Array, twists: Float[Array, "twist n"]) -> Float[Array, "twist n"]:
    """World twists along the axes of a frame."""
    rot = twists.shape[0] - rotation.shape[0]
    spins = rotation.T @ twists[:rot] if rot == 3 else twists[:rot]
    return jnp.concatenate([spins, rotation.T @ twists[rot:]])


def _load(end: _End, point: Array, wrench: Float[Array, " twist"]) -> Float[Array, " own"]:
    """Generalised force, in the columns of its part, of a wrench about a point."""
    dim = point.shape[0]
    force = wrench[-dim:]
    arm = (point - end.centre)[None]
    moment = wrench[:-dim] + moment_of(arm, force[None])[0]
    if isinstance(end.body, Points):
        return end.body.generalised(force[None], moment[None])
    assert end.body is not None
    return jnp.concatenate([moment, force]) @ end.body.tip_jacobian


def _moved(
    end: _End, point: Array, columns: tuple[Float[Array, "own dof"], ...]
) -> Float[Array, "twist dof"]:
    """Twist of the body of an end at a point, world axes, per rate of the assembly."""
    body = end.body
    assert end.index is not None and body is not None
    if isinstance(body, Points):
        angular, linear = body.angular_jacobian[0], body.linear_jacobian[0]
    else:
        angular, linear = body.base.angular_jacobian, body.base.linear_jacobian
    arm = (point - end.centre)[None]
    linear = linear + swept(angular[None], arm)[0]
    return jnp.concatenate([angular, linear]) @ columns[end.index]
