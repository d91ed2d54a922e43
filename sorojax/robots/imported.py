"""Robots read from a file: joints, limits, actuators, named frames, and soft parts on them."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import Numbers, real
from sorojax.rod import (
    Assembly,
    Gravity,
    JointEffort,
    Part,
    inverse_dynamics,
    num_coordinates,
    num_dof,
    slices,
)
from sorojax.sdf import Surface


class BodyFrame(NamedTuple):
    """Where a named body or site of a robot is.

    Attributes:
        part: Name of the part that carries it; None of what stands on the ground.
        pose: In the frame of that part, homogeneous, position [m].
    """

    part: str | None
    pose: Float[np.ndarray, "4 4"]


@displayed
class ImportedRobot(eqx.Module):
    """A robot of rigid links, as `io.import_robot` reads it.

    Attributes:
        assembly: A part for every joint: a link holds all bodies that are welded together.
        joints: The part that each joint moves, by the name of the joint.
        limits: Lowest and highest of each coordinate [rad or m]; infinite without one. They
            are told and not enforced.
        effort_limits: The same of the effort of each joint [N m or N].
        actuators: Names of the actuators.
        gears: Effort per unit of control: gear times gain.
        preload: Effort without control, of springs and servos that rest elsewhere than at 0.
        control_range: Lowest and highest control of each actuator; infinite without one.
        rest: Coordinates in which the file is drawn.
        keyframes: Coordinates of named poses.
        gravity: [m/s^2].
        frames: Bodies and sites by name.
        shapes: What each part looks like, in its frame: for `view.show(..., shapes=...)`.
        unmapped: What the file has and the assembly has not, each with its name.
    """

    assembly: Assembly
    joints: dict[str, str] = eqx.field(static=True)
    limits: Float[Array, "coordinates 2"]
    effort_limits: Float[Array, "dof 2"]
    actuators: tuple[str, ...] = eqx.field(static=True)
    gears: Float[Array, "dof actuators"]
    preload: Float[Array, " dof"]
    control_range: Float[Array, "actuators 2"]
    rest: Float[Array, " coordinates"]
    keyframes: dict[str, Float[Array, " coordinates"]]
    gravity: Float[Array, "3"]
    frames: dict[str, BodyFrame]
    shapes: dict[str, Surface]
    unmapped: tuple[str, ...] = eqx.field(static=True)

    def _text(self) -> str:
        rows = [
            f"ImportedRobot: {len(self.joints)} joints, {len(self.actuators)} actuators, "
            f"{len(self.frames)} named frames, {len(self.unmapped)} entries not mapped"
        ]
        return "\n".join(rows + [f"  {name}" for name in self.unmapped])


def actuator_forces(robot: ImportedRobot, control: Numbers) -> tuple[JointEffort, ...]:
    """The forces that a robot's actuators and preloaded springs put on its joints.

    Efforts are gears @ control + preload. The part of a servo's force that grows with
    position and speed is in the spring and damper of its joint.

    Args:
        robot: As `io.import_robot` reads it.
        control: One number per actuator: of a motor its torque [N m] or force [N] before the
            gear, of a servo the position that it is asked for [rad or m].

    Returns:
        One `rod.JointEffort` for each part that moves: forces for any verb of `rod`, on the
        robot's own assembly and on one that carries more parts.

    Raises:
        ValueError: If there is not one number per actuator.

    Example:
        >>> iiwa = sj.io.import_robot(robots.arm_mjcf("iiwa7"))
        >>> forces = robots.actuator_forces(iiwa, jnp.full(7, 2.0))
        >>> forces[0].part, forces[0].effort.tolist()
        ('link_1', [2.0])
    """
    control = real(control)
    count = len(robot.actuators)
    do = f"The actuators are {', '.join(robot.actuators) or 'none'}."
    _check.shape("actuator_forces", "control", control, (count,), do)
    efforts = robot.gears @ control + robot.preload
    return _on_joints(robot.assembly, efforts)


def computed_torque(
    robot: ImportedRobot,
    plan: Callable[[Float[Array, ""]], Float[Array, " coordinates"]],
    t: Float[Array, ""],
    q: Float[Array, " coordinates"],
    v: Float[Array, " dof"],
    *,
    frequency: Numbers = 20.0,
) -> tuple[JointEffort, ...]:
    """Efforts in the joints of a robot that take it along a plan.

    Inverse dynamics of the robot alone, with its weight, dampers and springs, at the
    acceleration of the plan and what the error needs to die out, critically damped. What the
    robot carries acts as a disturbance.

    Args:
        robot: As `io.import_robot` reads it, without a free base or a ball joint.
        plan: Coordinates [rad or m] as a function of time [s] that is two times
            differentiable, e.g. `systems.Waypoints(..., smooth=True)`.
        t: Time [s].
        q: Coordinates of the robot, or of an assembly that begins with it.
        v: Their rates.
        frequency: Of the error, in radians per second.

    Returns:
        One `rod.JointEffort` for each part that moves.

    Raises:
        ValueError: If the robot has a free base or a ball joint.

    Example:
        >>> iiwa = sj.io.import_robot(robots.arm_mjcf("iiwa7"))
        >>> torques = robots.computed_torque(iiwa, lambda t: iiwa.rest, 0.0, iiwa.rest + 0.1,
        ...                                  jnp.zeros(7))
        >>> a = rod.forward_dynamics(iiwa.assembly, iiwa.rest + 0.1, jnp.zeros(7),
        ...                          (rod.Gravity(), *torques))
        >>> a.round(6).tolist()[:2]  # -0.1 times the square of the frequency
        [-40.0, -40.0]

    Reference:
        Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 8.5.2.
    """
    assembly, frequency, t = robot.assembly, real(frequency), real(t)
    if num_coordinates(assembly) != num_dof(assembly):
        raise ValueError(
            "computed_torque: the robot has a free base or a ball joint, need hinges and "
            "slides on the ground: a quaternion has no error by difference. Weld the base, or "
            "write a controller of your own."
        )
    here, speed = q[: num_dof(assembly)], v[: num_dof(assembly)]

    def rate(of):
        return lambda t: jax.jvp(of, (t,), (jnp.ones_like(t),))[1]

    wanted = rate(rate(plan))(t) + 2 * frequency * (rate(plan)(t) - speed)
    wanted = wanted + frequency**2 * (plan(t) - here)
    efforts = inverse_dynamics(assembly, here, speed, wanted, (Gravity(robot.gravity),))
    return _on_joints(assembly, efforts)


def _on_joints(assembly: Assembly, efforts: Float[Array, " dof"]) -> tuple[JointEffort, ...]:
    return tuple(
        JointEffort(name, efforts[at.joint_v])
        for name, at in zip(assembly.names, slices(assembly), strict=True)
        if at.joint_v.stop > at.joint_v.start
    )


def mount(robot: ImportedRobot, **parts: Part) -> Assembly:
    """The assembly of a robot with more parts on its named bodies and sites.

    The new coordinates come after those of the robot.

    Args:
        robot: As `io.import_robot` reads it.
        **parts: Rods or links by name. `on` is a body or site of the robot, in whose frame
            `offset` is given, or one of the parts before it.

    Returns:
        The assembly of both.

    Raises:
        ValueError: If there is nothing of the name to mount on, or two parts have one name.

    Example:
        >>> iiwa = sj.io.import_robot(robots.arm_mjcf("iiwa7"))
        >>> finger = rod.rod(sj.SE3(), rod.chebyshev(kappa_y=2), rod.circle(8 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> whole = robots.mount(iiwa, finger=rod.Part(finger, on="flange"))
        >>> whole["finger"].on, rod.num_coordinates(whole)
        ('link_7', 9)
    """
    names, placed = list(robot.assembly.names), list(robot.assembly.parts)
    for name, part in parts.items():
        if name in names:
            raise ValueError(
                f"mount: the robot has a part `{name}`, need another name for this."
            )
        placed.append(part if part.on in parts else _on_frame(robot, name, part))
        names.append(name)
    return Assembly(robot.assembly.group, tuple(names), tuple(placed))


def _on_frame(robot: ImportedRobot, name: str, part: Part) -> Part:
    """A part whose offset is given in a named frame of the robot."""
    if part.on is None:
        return part
    if part.on not in robot.frames:
        raise ValueError(
            f"mount: `{name}` is on `{part.on}`, need one of {', '.join(robot.frames)}."
        )
    carrier, pose = robot.frames[part.on]
    offset = jnp.asarray(pose) if part.offset is None else jnp.asarray(pose) @ part.offset
    return dataclasses.replace(part, on=carrier, offset=offset)
