"""Three arms by public numbers, as MJCF.

The numbers are those of the models of robosuite 1.5.2 (MIT licence; Zhu et al., robosuite: a
modular simulation framework and benchmark for robot learning, arXiv:2009.12293), where they
come from the makers' descriptions: KUKA LBR iiwa 7, Universal Robots UR5e, Kinova Gen3.
"""

from typing import Literal, NamedTuple

import numpy as np

ArmName = Literal["iiwa7", "ur5e", "gen3"]


class _Body(NamedTuple):
    """A moving body: its frame on the one before, its joint, and its inertia.

    Attributes:
        name: Of the body.
        position, quaternion: Of its frame [m], scalar first.
        joint, axis: Name and axis of its hinge, in its frame.
        limit: Lowest and highest angle [rad]; None of a joint that turns on.
        torque: Greatest [N m].
        damping: [N m s/rad].
        mass: [kg].
        center, turn: Pose of the principal axes [m], scalar first.
        moments: Principal moments [kg m^2].
    """

    name: str
    position: tuple[float, ...]
    quaternion: tuple[float, ...]
    joint: str
    axis: tuple[float, ...]
    limit: tuple[float, float] | None
    torque: float
    damping: float
    mass: float
    center: tuple[float, ...]
    turn: tuple[float, ...]
    moments: tuple[float, ...]


# fmt: off
_ARMS: dict[str, tuple[_Body, ...]] = {
    "iiwa7": (
        _Body("link_1", (0, 0, 0.15), (1, 0, 0, 0), "joint_1", (0, 0, 1), (-2.96706, 2.96706),
            176, 0.1, 3.4525, (0, -0.03, 0.12), (0.428904, 0.562175, -0.562175, 0.428904),
            (0.0218946, 0.02183, 0.00663837)),
        _Body("link_2", (0, 0, 0.19), (0, 0, 0.707107, 0.707107), "joint_2", (0, 0, 1),
            (-2.0944, 2.0944), 176, 0.1, 3.4821, (0.0003, 0.059, 0.042), (0.701371, 0.0898824,
            0.0898824, 0.701371), (0.02179, 0.0217049, 0.00684512)),
        _Body("link_3", (0, 0.21, 0), (0, 0, 0.707107, 0.707107), "joint_3", (0, 0, 1),
            (-2.96706, 2.96706), 110, 0.1, 4.05623, (0, 0.03, 0.13), (0.56292, 0.427927,
            -0.427927, 0.56292), (0.0321488, 0.03204, 0.00799117)),
        _Body("link_4", (0, 0, 0.19), (0.707107, 0.707107, 0, 0), "joint_4", (0, 0, 1),
            (-2.0944, 2.0944), 110, 0.1, 3.4822, (0, 0.067, 0.034), (0.991887, -0.127124, 0,
            0), (0.02178, 0.0216947, 0.00684029)),
        _Body("link_5", (0, 0.21, 0), (0, 0, 0.707107, 0.707107), "joint_5", (0, 0, 1),
            (-2.96706, 2.96706), 110, 0.1, 2.1633, (0.0001, 0.021, 0.076), (0.365352, 0.605407,
            -0.605407, 0.365352), (0.0131987, 0.01287, 0.0036293)),
        _Body("link_6", (0, 0.0607, 0.19), (0.707107, 0.707107, 0, 0), "joint_6", (0, 0, 1),
            (-2.0944, 2.0944), 40, 0.1, 2.3466, (0, 0.0006, 0.0004), (0.996112, 0.088097, 0,
            0), (0.006509, 0.00631585, 0.00447015)),
        _Body("link_7", (0, 0.081, 0.0607), (0, 0, 0.707107, 0.707107), "joint_7", (0, 0, 1),
            (-3.05433, 3.05433), 40, 0.1, 3.129, (0, 0, 0.02), (0.923068, 0, 0, 0.384636),
            (0.0152362, 0.0140538, 0.002872)),
    ),
    "ur5e": (
        _Body("shoulder_link", (0, 0, 0.163), (1, 0, 0, 0), "shoulder_pan_joint", (0, 0, 1),
            (-6.28319, 6.28319), 150, 0.001, 3.7, (0, 0, 0), (1, 0, 0, 0), (0.0102675,
            0.0102675, 0.00666)),
        _Body("upper_arm_link", (0, 0.138, 0), (0.707107, 0, 0.707107, 0),
            "shoulder_lift_joint", (0, 1, 0), (-6.28319, 6.28319), 150, 0.001, 8.393, (0, 0,
            0.2125), (1, 0, 0, 0), (0.133886, 0.133886, 0.0151074)),
        _Body("forearm_link", (0, -0.131, 0.425), (1, 0, 0, 0), "elbow_joint", (0, 1, 0),
            (-3.14159, 3.14159), 150, 0.001, 2.275, (0, 0, 0.196), (1, 0, 0, 0), (0.0311796,
            0.0311796, 0.004095)),
        _Body("wrist_1_link", (0, 0, 0.392), (0.707107, 0, 0.707107, 0), "wrist_1_joint", (0,
            1, 0), (-6.28319, 6.28319), 28, 0.001, 1.219, (0, 0.127, 0), (1, 0, 0, 0),
            (0.0025599, 0.0025599, 0.0021942)),
        _Body("wrist_2_link", (0, 0.127, 0), (1, 0, 0, 0), "wrist_2_joint", (0, 0, 1),
            (-6.28319, 6.28319), 28, 0.001, 1.219, (0, 0, 0.1), (1, 0, 0, 0), (0.0025599,
            0.0025599, 0.0021942)),
        _Body("wrist_3_link", (0, 0, 0.1), (1, 0, 0, 0), "wrist_3_joint", (0, 1, 0), (-6.28319,
            6.28319), 28, 0.001, 0.1889, (0, 0.0771683, 0), (0.707107, 0, 0, 0.707107),
            (0.000132134, 9.90863e-05, 9.90863e-05)),
    ),
    "gen3": (
        _Body("shoulder_link", (0, 0, 0.15643), (-3.67321e-06, 1, 0, 0), "Actuator1", (0, 0,
            1), None, 32, 0.1, 1.3773, (-2.3e-05, -0.010364, -0.07336), (0.707051, 0.0451246,
            -0.0453544, 0.704263), (0.00488868, 0.00457, 0.00135132)),
        _Body("HalfArm1_Link", (0, 0.005375, -0.12838), (0.707105, 0.707108, 0, 0),
            "Actuator2", (0, 0, 1), (-2.41, 2.41), 32, 0.1, 1.1636, (-4.4e-05, -0.09958,
            -0.013278), (0.482348, 0.516286, -0.516862, 0.483366), (0.0113017, 0.011088,
            0.00102532)),
        _Body("HalfArm2_Link", (0, -0.21038, -0.006375), (0.707105, -0.707108, 0, 0),
            "Actuator3", (0, 0, 1), None, 32, 0.1, 1.1636, (-4.4e-05, -0.006641, -0.117892),
            (0.706144, 0.0213722, -0.0209128, 0.707437), (0.0111633, 0.010932, 0.00100671)),
        _Body("forearm_link", (0, 0.006375, -0.21038), (0.707105, 0.707108, 0, 0), "Actuator4",
            (0, 0, 1), (-2.66, 2.66), 32, 0.1, 0.9302, (-1.8e-05, -0.075478, -0.015006),
            (0.483678, 0.515961, -0.515859, 0.483455), (0.00834839, 0.008147, 0.000598606)),
        _Body("SphericalWrist1_Link", (0, -0.20843, -0.006375), (0.707105, -0.707108, 0, 0),
            "Actuator5", (0, 0, 1), None, 32, 0.1, 0.6781, (1e-06, -0.009432, -0.063883),
            (0.703558, 0.0707492, -0.0707492, 0.703558), (0.00165901, 0.001596, 0.000346988)),
        _Body("SphericalWrist2_Link", (0, 0.00017505, -0.10593), (0.707105, 0.707108, 0, 0),
            "Actuator6", (0, 0, 1), (-2.23, 2.23), 13, 0.01, 0.6781, (1e-06, -0.045483,
            -0.00965), (0.44426, 0.550121, -0.550121, 0.44426), (0.00170087, 0.001641,
            0.00035013)),
        _Body("Bracelet_Link", (0, -0.10593, -0.00017505), (0.707105, -0.707108, 0, 0),
            "Actuator7", (0, 0, 1), None, 13, 0.01, 0.5006, (-0.000281, -0.011402, -0.029798),
            (0.601961, 0.40663, -0.381169, 0.571843), (0.000657515, 0.000586793,
            0.000320693)),
    ),
}
_FLANGES = {
    "iiwa7": ((0, 0, 0.044), (0, 0, 0, 1)),
    "ur5e": ((0, 0.098, 0), (0.707, -0.707, 0, 0)),
    "gen3": ((0, 0, -0.0615), (0, 0.707105, -0.707108, 0)),
}
# fmt: on


def arm_mjcf(name: ArmName) -> str:
    """An arm by public numbers, as a text in MJCF: seven joints, six of the UR5e.

    Bodies, hinges with limits and dampers, a motor for each, and a body `flange` at the end of
    the last; spheres and cylinders between the joints for pictures, of no mass.

    Args:
        name: "iiwa7" (KUKA LBR iiwa 7), "ur5e" (Universal Robots) or "gen3" (Kinova).

    Returns:
        The text, for `io.import_robot` and for MuJoCo itself.

    Raises:
        ValueError: If there is no arm of the name.

    Example:
        >>> iiwa = sj.io.import_robot(robots.arm_mjcf("iiwa7"))
        >>> f"{float(sum(part.body.mass for part in iiwa.assembly.parts)):.2f} kg"
        '22.11 kg'

    Reference:
        Zhu et al., robosuite: a modular simulation framework and benchmark for robot learning,
        2020, for the numbers; they are its robots `iiwa`, `ur5e` and `kinova3`.
    """
    bodies = _ARMS[name]
    place, turn = _FLANGES[name]
    inner = f'<body name="flange" pos="{_row(place)}" quat="{_row(turn)}"/>'
    below = place
    for body in reversed(bodies):
        inner = _body(body, below, inner)
        below = body.position
    motors = "".join(
        f'<motor name="motor_{k + 1}" joint="{body.joint}" '
        f'ctrlrange="{-body.torque} {body.torque}"/>'
        for k, body in enumerate(bodies)
    )
    return (
        f'<mujoco model="{name}"><compiler angle="radian" autolimits="true"/>'
        f'<default><geom mass="0" contype="0" conaffinity="0"/></default>'
        f'<worldbody><body name="base"><geom type="cylinder" size="{_THICK * 1.3} '
        f'{bodies[0].position[2] / 4}" pos="0 0 {bodies[0].position[2] / 4}"/>{inner}</body>'
        f"</worldbody><actuator>{motors}</actuator></mujoco>"
    )


_THICK = 0.055  # m, of what is drawn


def _body(body: _Body, below: tuple[float, ...], inner: str) -> str:
    """A body with its joint, and a capsule to the next one."""
    limit = "" if body.limit is None else f' range="{_row(body.limit)}"'
    end = np.array(below)
    bone = ""
    if np.linalg.norm(end) > 0.02:
        bone = f'<geom type="capsule" size="{0.8 * _THICK}" fromto="0 0 0 {_row(below)}"/>'
    return (
        f'<body name="{body.name}" pos="{_row(body.position)}" quat="{_row(body.quaternion)}">'
        f'<inertial mass="{body.mass}" pos="{_row(body.center)}" quat="{_row(body.turn)}" '
        f'diaginertia="{_row(body.moments)}"/>'
        f'<joint name="{body.joint}" axis="{_row(body.axis)}" damping="{body.damping}"{limit}/>'
        f'<geom size="{_THICK}"/>{bone}{inner}</body>'
    )


def _row(numbers: tuple[float, ...]) -> str:
    return " ".join(repr(float(x)) for x in numbers)
