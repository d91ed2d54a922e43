"""Slopes of what robots are put together from, and of what is read off them."""

import jax.numpy as jnp
import numpy as np

import sorojax as sj
from sorojax import mesh, robots, rod
from tests.derivatives.case import Case
from tests.derivatives.fem import drawn

NONE = {
    "bodies meshed from concrete dimensions: slopes are those of fem": (
        "bellows_problem crawler_problem walker_problem pneunet_mesh"
    ),
    "robots put together on the host, from cells solved there: slopes are those of systems": (
        "model unit_cell with_pneumatics with_contacts standing_ball standing_cylinder rim"
    ),
    "what a board drives, step by step on the host": (
        "bench stepper rod_stepper contact_stepper"
    ),
    "records as arrays of the host": "replay gait",
    "a text of given numbers": "arm_mjcf",
    "given materials": "printed_rubber crawler_rubbers walker_rubber",
}

TIMES = jnp.asarray([0.11, 0.17, 0.3, 0.55])
WALKER = robots.Walker()
FEET = mesh.rectangle([-0.02, 0.0], [0.08, 0.013], divisions=(4, 1))


def hand(radius):
    """Rods that hang from a circle."""
    finger = rod.rod(
        sj.SE3(),
        rod.chebyshev(kappa_z=1),
        rod.circle(0.005),
        length=0.1,
        young_modulus=1e5,
        poisson_ratio=0.4,
        density=1e3,
        nodes=4,
    )
    return rod.assembly(sj.SE3(), **robots.ring(finger, 2, radius))


def around(at):
    model, q = hand(at[0]), at[1]
    return robots.middle(model, q, ["finger_0", "finger_1"])


def hung(radius):
    link = robots.cylinder(0.3, 0.02, 0.05)
    return [part.offset for part in robots.ring(link, 3, radius).values()]


def pressures(numbers):
    return [port(t) for port in robots.crawler_gait(*numbers).values() for t in TIMES]


def driven(at):
    """An arm of two joints with a link on its tool, under its actuators and on a plan."""
    stiffness, gears, offset, control, q, v = at
    hinge = rod.Revolute([0.0, 1.0, 0.0], stiffness=stiffness, armature=0.01)
    link = rod.Link(0.5, [1e-3, 2e-3, 3e-3], [0.1, 0.0, 0.02])
    wide = jnp.array([[-jnp.inf, jnp.inf]] * 2)
    arm = robots.ImportedRobot(
        rod.assembly(sj.SE3(), a=rod.Part(link, hinge), b=rod.Part(link, hinge, on="a")),
        joints={"first": "a", "second": "b"}, limits=wide, effort_limits=wide,
        actuators=("motor", "servo"), gears=gears, preload=jnp.array([0.1, 0.2]),
        control_range=wide, rest=jnp.zeros(2), keyframes={}, gravity=jnp.array([0, 0, -9.81]),
        frames={"tool": robots.BodyFrame("b", np.eye(4))}, shapes={}, unmapped=(),
    )  # fmt: skip
    whole = robots.mount(arm, tip=rod.Part(link, on="tool", offset=offset))
    forces = robots.actuator_forces(arm, control)
    forces += robots.computed_torque(arm, lambda t: control * jnp.sin(t), 0.4, q, v)
    return rod.forward_dynamics(whole, q, v, forces)


CASES = {
    "actuator_forces, computed_torque, mount": Case(
        driven,
        (
            jnp.asarray(2.0),
            jnp.array([[3.0, 0.1], [0.0, 2.0]]),
            jnp.eye(4).at[:3, 3].set(jnp.array([0.1, 0.0, 0.05])),
            jnp.array([0.3, -0.2]),
            jnp.array([0.4, 0.7]),
            jnp.array([1.0, -0.5]),
        ),
        rtol=1e-6,
    ),
    "pose_below": Case(robots.pose_below, 0.3),
    "upside_down": Case(robots.upside_down, 0.3),
    "cylinder": Case(lambda at: robots.cylinder(*at), (0.3, 0.02, 0.05)),
    "ring": Case(hung, 0.04),
    "middle": lambda: Case(around, (jnp.asarray(0.04), jnp.asarray([8.0, 3.0])), forward=False),
    "crawler_gait": Case(pressures, (2.0, 2.5, 1.0), forward=False),
    "pair_angles": Case(
        lambda u: robots.pair_angles(WALKER, FEET, u),
        jnp.asarray(np.stack([drawn(0.002, FEET.points.shape, k) for k in (1, 2)])),
        forward=False, step=1e-4, jit=False,
    ),
}  # fmt: skip
