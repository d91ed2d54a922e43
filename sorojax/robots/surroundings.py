"""A robot among other bodies: its mounting, the contacts with things around it, and its motion
in them; and bodies to arrange and to hold.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._edit import replace
from sorojax._jax.jit import once
from sorojax._types import Numbers, real
from sorojax.contact import LinePenalty
from sorojax.math.compiled import Split, kernel
from sorojax.math.lie import homogeneous
from sorojax.math.ode.contact_midpoint import ContactMidpoint
from sorojax.math.ode.explicit import finite
from sorojax.math.ode.steppers import AbstractStepper
from sorojax.robots.models.supply import Model, check_moved, check_period
from sorojax.rod import Assembly, Free, Link, LinkObstacle, Part, Rod, assembly, tip_pose
from sorojax.rod.forces.loads import Load
from sorojax.rod.model.assembly import index_of
from sorojax.sdf import HalfSpace
from sorojax.systems import AssemblyBody, partitioned
from sorojax.systems.integrate.partitioned import PartitionedState


def ring(
    body: Rod | Link, count: int, radius: Float[Array, ""] | float, name: str = "finger"
) -> dict[str, Part]:
    """Copies of a body round the z axis, hanging from a circle in the plane z = 0.

    The local x axis of each points down and its y axis towards the axis of the ring, so that
    a positive curvature about z closes the ring like a hand.

    Args:
        body: A rod or a link in space.
        count: Number of copies.
        radius: Of the circle [m].
        name: The parts are called `name_0`, `name_1`, ...; the first is at x = `radius`.

    Returns:
        Parts for `rod.assembly(sj.SE3(), **parts)`.

    Raises:
        ValueError: If there is none, or the radius is not above zero.
    """
    if count < 1:
        raise ValueError(f"ring: got count={count}, need one or more. Give a whole number.")
    radius = real(radius)
    _check.positive("ring", "radius", radius, "m", "Lengths are in metres: write 30 * mm.")
    return {
        f"{name}_{k}": Part(body, offset=_hanging(2 * jnp.pi * k / count, radius))
        for k in range(count)
    }


def _hanging(angle: float, radius: Float[Array, ""]) -> Float[Array, "4 4"]:
    c, s = (f(jnp.asarray(angle, radius.dtype)) for f in (jnp.cos, jnp.sin))
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    rows = [zero, -c, -s], [zero, -s, c], [-one, zero, zero]
    turn = jnp.stack([jnp.stack(row) for row in rows])
    return homogeneous(turn, radius * jnp.stack([c, s, zero]))


def pose_below(depth: Float[Array, ""] | float) -> Float[Array, "4 4"]:
    """Pose of what hangs `depth` [m] below the middle of a ring, not turned.

    Args:
        depth: Distance [m].

    Returns:
        A homogeneous matrix.
    """
    depth = real(depth)
    zero = jnp.zeros_like(depth)
    return homogeneous(jnp.eye(3, dtype=depth.dtype), jnp.stack([zero, zero, -depth]))


def upside_down(height: Float[Array, ""] | float) -> Float[Array, "4 4"]:
    """Pose of what hangs from a beam at `height` [m], its z axis down, its x axis kept.

    Args:
        height: Of the beam [m].

    Returns:
        A homogeneous matrix.
    """
    height = real(height)
    zero = jnp.zeros_like(height)
    turn = jnp.diag(jnp.asarray([1.0, -1.0, -1.0], height.dtype))
    return homogeneous(turn, jnp.stack([zero, zero, height]))


def cylinder(
    mass: Float[Array, ""] | float,
    radius: Float[Array, ""] | float,
    length: Float[Array, ""] | float,
) -> Link:
    """A homogeneous round cylinder about z, its frame in its middle.

    Args:
        mass: [kg].
        radius: [m].
        length: [m].

    Returns:
        The rigid link.
    """
    mass, radius, length = real(mass), real(radius), real(length)
    across = mass * (3 * radius**2 + length**2) / 12
    return Link(mass, jnp.stack([across, across, mass * radius**2 / 2]))


def rim(
    radius: float, height: float, count: int = 24
) -> tuple[Float[np.ndarray, "count 3"], Float[np.ndarray, " count"]]:
    """Points on an edge of a cylinder about z, and the length that each stands for [m]: where
    it touches what it stands on, for `rod.LinkObstacle`.

    Args:
        radius: [m].
        height: Of the edge in the frame of the cylinder [m].
        count: Number of points, three or more.

    Returns:
        Points, and the length of each [m].
    """
    if count < 3 or not radius > 0:
        raise ValueError(
            f"rim: got {count} points on a radius of {radius} m, need three or more and a "
            "radius above zero. Give the radius of the cylinder in metres."
        )
    angle = 2 * np.pi * np.arange(count) / count
    ring = [radius * np.cos(angle), radius * np.sin(angle), np.full(count, float(height))]
    return np.stack(ring, axis=1), np.full(count, 2 * np.pi * radius / count)


# A robot among other bodies: where it is mounted, what it touches, and how it moves then


def with_contacts(
    model: Model,
    forces: tuple[Load, ...],
    *,
    mount: Float[Array, "h h"] | None = None,
    **parts: Part,
) -> Model:
    """`model` with further bodies, and with forces between them: contacts above all.

    Args:
        model: A robot, of `robots.model`.
        forces: `PartForce(part, force)` and `PairForce(first, second, contact)`, of old and
            new parts.
        mount: Pose of the robot, in which it was drawn if omitted; weight keeps its direction.
        **parts: The bodies by name, in the frame of the ground unless a part carries them.

    Returns:
        The robot among the bodies.

    Raises:
        ValueError: If a name is taken.
    """
    body = model.network.blocks["body"]
    own = dict(zip(model.assembly.names, model.assembly.parts, strict=True))
    if taken := sorted(own.keys() & parts.keys()):
        raise ValueError(
            f"surrounded: the robot has a part called `{taken[0]}` already, need other names. "
            "Rename the new one."
        )
    if mount is not None:
        own = {name: _mounted(part, jnp.asarray(mount)) for name, part in own.items()}
    whole = assembly(model.assembly.group, **own, **parts)
    assert isinstance(body, AssemblyBody)
    new = AssemblyBody(whole, (*body.forces, *forces), driven=body.driven)
    return replace(model, lambda made: made.network.blocks["body"], new)


def _mounted(part: Part, pose: Array) -> Part:
    if part.on is not None:
        return part
    own = pose if part.offset is None else pose @ part.offset
    return Part(part.body, part.joint, part.on, own, part.s)


def standing_cylinder(
    mass: float, radius: float, height: float, law: LinePenalty
) -> tuple[Part, LinkObstacle]:
    """A free cylinder that stands at the origin, and its contact with the floor z = 0.

    Args:
        mass: [kg].
        radius: [m].
        height: [m].
        law: Between its lower rim and the floor.

    Returns:
        The part, and its contact.
    """
    part = Part(cylinder(mass, radius, height), Free(), offset=pose_below(-height / 2))
    floor = HalfSpace([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    points, lengths = rim(radius, -height / 2)
    return part, LinkObstacle(obstacle=floor, points=points, lengths=lengths, law=law)


def standing_ball(
    mass: float, radius: float, law: LinePenalty, *, at: Numbers = (0.0, 0.0, 0.0)
) -> tuple[Part, LinkObstacle]:
    """A free ball that stands on a level floor, and its contact with it.

    The contact is that of 120 points spread over the ball: it rolls over their edges, and
    stops by itself.

    Args:
        mass: [kg].
        radius: [m].
        law: Between the points and the floor.
        at: Where it stands on the floor [m].

    Returns:
        The part, and its contact.
    """
    spot = real(at)
    _check.shape("standing_ball", "at", spot, (3,), "Give x, y and the height of the floor.")
    count = 120
    height, turn = 1 - np.arange(1, 2 * count, 2) / count, _GOLDEN * np.arange(count)
    flat = np.sqrt(1 - height**2)
    points = radius * np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    lengths = np.full(count, 2 * radius * np.sqrt(np.pi / count))  # squared, the share of each
    up = jnp.array([0.0, 0.0, 1.0])
    part = Part(
        Link(mass, jnp.full(3, 0.4 * mass * radius**2)),
        Free(),
        offset=homogeneous(jnp.eye(3, dtype=spot.dtype), spot + radius * up),
    )
    return part, LinkObstacle(HalfSpace(spot, up), points, lengths, law)


_GOLDEN = np.pi * (3 - np.sqrt(5))  # [rad] from point to point of an even spiral


def middle(
    model: Assembly, q: Float[Array, " coordinates"], names: Sequence[str]
) -> Float[Array, " dim"]:
    """Mean position of the tips or frames of some parts [m]: between fingers, for example.

    Args:
        model: The assembly.
        q: Coordinates.
        names: Of the parts.

    Returns:
        The position [m].
    """
    poses = tip_pose(model, q)
    return jnp.mean(jnp.stack([poses[name][:-1, -1] for name in names]), axis=0)


class InContact(NamedTuple):
    """A robot of `contact_stepper` at one moment: the state of its `network`."""

    network: PartitionedState

    @property
    def q(self) -> Float[Array, " coordinates"]:
        return self.network.state["body"]["q"]

    @property
    def v(self) -> Float[Array, " dof"]:
        return self.network.state["body"]["v"]


class Replay(NamedTuple):
    """Coordinates `q`, rates `v` and `poses` by part along a motion."""

    q: Float[Array, "moments coordinates"]
    v: Float[Array, "moments dof"]
    poses: dict[str, Float[np.ndarray, "moments h h"]]


def replay(
    model: Assembly, states: Sequence[InContact], parts: Sequence[str] | None = None
) -> Replay:
    """The states that a board kept, in a row.

    Args:
        model: The robot with what is around it.
        states: In the order of time.
        parts: Those whose poses are asked for; all if omitted. Few compile faster.

    Returns:
        Coordinates, rates, and poses by part.

    Raises:
        ValueError: If the model has no part of such a name.
    """
    parts = model.names if parts is None else tuple(parts)
    for name in parts:
        index_of(model, name)
    # on the host: each number of states would be a program of its own
    q, v = (
        jnp.asarray(np.stack([np.asarray(getattr(state, name)) for state in states]))
        for name in ("q", "v")
    )
    poses = _poses(model, q, parts)
    return Replay(q, v, {name: np.asarray(rows) for name, rows in poses.items()})


@once
def _poses(model: Assembly, q, parts: tuple[str, ...]):
    def at(row):
        poses = tip_pose(model, row)
        return {name: poses[name] for name in parts}

    return jax.lax.map(at, q)


def contact_stepper(
    model: Model, period: float, *, substeps: int = 2, stepper: AbstractStepper | None = None
) -> tuple[Callable[..., tuple[InContact, Array]], InContact]:
    """`robots.stepper` of a robot that touches things, by `systems.partitioned`.

    Args:
        model: The robot, of `with_contacts` for example.
        period: Of every call [s].
        substeps: Steps in one.
        stepper: Of the body; one for grasps if omitted: a `ContactMidpoint` that keeps
            contacts from step to step and finds their forces in one pass.

    Returns:
        `advance(state, setpoint [Pa], dt [s]) -> (state, pressure [Pa])`, and the state to
        start from.

    Raises:
        RuntimeError: By `advance`, if a step does not converge, or if contact cannot hold
            what moves into it.
    """
    if stepper is None:
        stepper = ContactMidpoint(passes=1, lasting=True, theta=1.0, tolerance=1e-4)
    move, start = partitioned(model.network, period, substeps=substeps, stepper=stepper)

    # to take a method of a module costs as much as to take it apart
    inputs, fixed = model.inputs, (Split(model),)

    @kernel
    def observed(model, state, resolved):
        return model.pressure(state), finite(state) & resolved

    def advance(now: InContact, setpoint: Any, dt: float):
        check_period("contact_stepper", dt, period)
        moved = move(now.network, inputs(np.asarray(setpoint)))
        pressure, good = observed(fixed, moved.state, moved.resolved)
        check_moved("contact_stepper", good, period, setpoint)
        return InContact(moved), pressure

    return advance, InContact(start)
