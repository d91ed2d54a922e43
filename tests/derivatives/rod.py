"""Slopes of rods and assemblies in their numbers, coordinates, rates and forces."""

import functools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from sorojax import material, mesh, rod as R, sdf
from sorojax.contact import LinePenalty
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.status import Status
from tests.derivatives.case import Case

NONE = {
    "modes, whose numbers are chosen on the host": (
        "bernstein bspline chebyshev constant fitted fourier functions legendre "
        "orthonormalise piecewise piecewise_constant piecewise_linear"
    ),
    "says that it has none": "arc_length_path",
    "names, counts and slices": "columns mobility num_coordinates num_dof slices strain_names",
    "zero at any numbers": "rest",
}

SOFT = dict(young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
DISC = replace(
    R.circle(6e-3), mass_offset_y=jnp.asarray(1e-3), mass_offset_z=jnp.asarray(-2e-3)
)
FINGER = R.rod(
    SE3(),
    R.chebyshev(kappa_y=1, kappa_z=2, sigma_x=1),
    DISC,
    length=0.08,
    nodes=8,
    rest_strain=[3.0, -5.0, 4.0, 1.05, 0.1, -0.05],
    **SOFT,
)
FLAT = R.rod(SE2(), R.chebyshev(kappa_z=4), R.circle(6e-3), length=0.08, nodes=10, **SOFT)
Q, V = jnp.array([5.0, -4.0, 3.0, 0.02]), jnp.array([1.0, 2.0, -3.0, 0.1])
BENT = jnp.array([9.0, -5.0, 3.0, 2.0])
T, DOWN = jnp.asarray(0.3), jnp.array([1.0, 2.0, -9.81])
AT = jnp.array([0.3, 1.0])


def tree():
    link = R.Link(0.02, jnp.diag(jnp.array([3e-6, 5e-6, 4e-6])), [0.005, 0.002, -0.003])
    here = homogeneous(jnp.eye(3), jnp.array([0.01, 0.02, 0.0]))
    hinge = R.Revolute([1.0, 2.0, 3.0], stiffness=0.1, damping=0.02)
    slide = R.Prismatic([0.0, 1.0, 1.0], stiffness=3.0)
    return R.assembly(
        SE3(),
        palm=R.Part(link, R.Screw(0.7, 2e-3)),
        finger=R.Part(FINGER, hinge, on="palm", offset=here),
        nail=R.Part(link, slide, on="finger", s=0.6, offset=here),
    )


TREE = tree()
W = jnp.array([0.4, 0.3, *Q, 0.01])
RATES = jnp.array([1.0, -0.5, *V, 0.2])
MODELS = {"a finger": (FINGER, Q, V), "a tree": (TREE, W, RATES)}

# What a model does at a moment, in one program


def moment(at):
    model, q, v = at
    here = R.motion(model, q, v)
    ends = R.jacobian_rate_product(model, q, v, AT), R.forward_kinematics(model, q, AT)
    return (
        R.mass_matrix(model, q),
        R.coriolis_force(model, q, v),
        R.coriolis_matrix(model, q, v),
        R.bias_force(model, q, v, DOWN),
        R.gravity_force(model, q, DOWN),
        R.elastic_force(model, q),
        R.kinetic_energy(model, q, v),
        R.potential_energy(model, q, DOWN),
        R.momentum(model, q, v),
        R.jacobian(model, q, AT),
        R.inertia(here),
        R.stiffness_matrix(model),
        R.tip_pose(model, q),
        R.damping_matrix(model, (R.Damping(0.02),)),
        ends,
    )


MOMENT = (
    "mass_matrix, coriolis_force, coriolis_matrix, bias_force, gravity_force, elastic_force, "
    "kinetic_energy, potential_energy, momentum, jacobian, inertia, stiffness_matrix, "
    "tip_pose, damping_matrix, jacobian_rate_product, forward_kinematics, motion"
)


def dynamics(at):
    model, q, v, wrench = at
    forces = (R.Gravity(DOWN), R.Damping(0.02), R.TipWrench(wrench))
    if not isinstance(model, R.Rod):
        forces = tuple(R.PartForce("finger", force) for force in forces)
    a = R.forward_dynamics(model, q, v, forces)
    field = R.vector_field(model, forces)
    return (
        a,
        R.inverse_dynamics(model, q, v, 2 * a, forces),
        field(T, (q, v), None),
        R.acceleration(model, R.operators(model), T, q, v, forces),
        R.second_order(model, q, forces).equations(T, q, v),
    )


DYNAMICS = "forward_dynamics, inverse_dynamics, vector_field, acceleration, second_order"
WRENCH = jnp.array([0.003, -0.001, 0.002, 0.1, 0.2, -0.3])


def carried(at):
    model, q, v, a, wrench = at
    forces = (R.Gravity(DOWN), R.PartForce("finger", R.TipWrench(wrench)))
    return R.joint_wrenches(model, q, v, a, forces), R.part_momenta(model, q, v)


# Forces, each by itself

ROUTES = (
    R.Straight([3e-3, 1e-3]),
    R.Converging([4e-3, 0.0], [1e-3, 1e-3], stop=0.7),
    R.Helical(3e-3, 1.5, 0.3),
)


def push(inputs):
    return jnp.stack([inputs, 2 * inputs])


FORCES = (
    R.Gravity(DOWN),
    R.TipWrench(WRENCH),
    R.PointWrench(WRENCH, 0.4, follower=True),
    R.LineWrench(WRENCH),
    R.Damping(0.02),
    R.Buoyancy(900.0, DOWN),
    R.Drag(1000.0, 0.012, flow=[0.1, 0.2, 0.0], viscous=0.3),
    R.Tendons(ROUTES, [3.0, 2.0, 1.0]),
    R.Tendons(ROUTES[:2], [3.0, 2.0], friction=0.2),
    R.LinearElastic(np.diag([1.0, 2.0, 2.0, 5.0])),
)


def each_force(at):
    forces, model, q, v = at
    here = R.motion(model, q, v)
    plain = R.total_force((), T, here)
    # All but the elastic law in place of the rod's own.
    return [R.total_force((force,), T, here) - plain for force in forces[:-1]] + [
        R.total_force(forces[-1:], T, here)
    ]


def threads(at):
    model, q, v, routes, areas, pressure = at
    here = R.motion(model, q, v)
    chambers = R.thread_chambers(model, routes, areas)
    push = R.Pressurised(chambers, pressure)
    return (
        R.thread_lengths(model, routes, q),
        R.thread_rates(model, routes, q, v),
        R.total_force((push,), T, here) - R.total_force((), T, here),
    )


def laws(at):
    model, q, stiffness, tension = at
    here = R.motion(model, q)

    def stress(strain, s):
        return stiffness * (strain + 3 * strain**3) * (1 + s)

    section = R.section_law(model, stress)
    varying = R.TimeVaryingForce(lambda x: R.TipWrench(x * WRENCH), lambda t: tension * t**2)
    push = R.Actuation(lambda q: jnp.stack([q, q**2], axis=1), jnp.stack([tension, -tension]))
    plain = R.total_force((), T, here)
    return (
        R.total_force((section,), T, here),
        R.total_force((varying,), T, here) - plain,
        R.total_force((push,), T, here) - plain,
        R.strain(model, q, AT),
        R.points(here, np.array([0.2, 0.9])).position,
    )


def branches(at):
    model, spectrum, times, q, memory = at
    forces = (R.Relaxation(spectrum),)
    return (
        R.branch_states(model, forces, times, jnp.stack([0 * q, q, 2 * q])),
        R.branch_force(model, forces, q, memory),
        R.branch_energy(model, forces, q, memory),
    )


SPECTRUM = material.Prony([0.3, 0.2], [0.01, 0.05])
REMEMBERED = jnp.stack([0.5 * Q, -0.2 * Q])

# Contact, where it presses

LAW = LinePenalty(5e5, 2e-5, friction=0.3, damping=0.1)
FLOOR = sdf.Rectangle([-1.0, -1.0], [1.0, -0.005])
PRESS = jnp.array([-4.0, 1.0, 0.5, 0.2])
COIL = R.rod(SE2(), R.chebyshev(kappa_z=2), R.circle(6e-3), length=0.25, nodes=16, **SOFT)


def obstacle(at):
    law, floor, radius, q, v = at
    contact = R.ObstacleContact(floor, radius, law, points=16)
    here = R.motion(FLAT, q, v)
    force = R.total_force((contact,), T, here) - R.total_force((), T, here)
    return force, R.contact_energy(contact, here), R.penetration(contact, here)


def itself(at):
    law, radius, q = at
    here = R.motion(COIL, q)
    contact = R.SelfContact(radius, law, points=48)
    return R.total_force((contact,), T, here) - R.total_force((), T, here)


def pair_of(other):
    here = homogeneous(jnp.eye(2), jnp.array([0.06, -0.0145]))
    return R.assembly(SE2(), rod=R.Part(FLAT), stone=R.Part(other, R.Free(), offset=here))


def stone(at):
    law, shape, q, v = at
    pair = pair_of(R.Link(0.05, 1e-5))
    contact = R.PairForce("rod", "stone", R.LinkContact(shape, 6e-3, law, points=16))
    here = R.motion(pair, q, v)
    return R.total_force((contact,), T, here) - R.total_force((), T, here)


def two_rods(at):
    law, radii, q, v = at
    pair = pair_of(COIL)
    contact = R.PairForce("rod", "stone", R.RodContact(radii, law, points=24))
    here = R.motion(pair, q, v)
    return R.total_force((contact,), T, here) - R.total_force((), T, here)


BLOCK = sdf.Rectangle([-0.02, -0.01], [0.02, 0.01])
TOUCH = jnp.array([0.5, -0.3, 0.2, 0.1, 0.05, 0.001, 0.02])
MEET = jnp.array([0.5, -0.3, 0.2, 0.1, 0.3, 0.001, 0.003, 2.0, 1.0])

# Searches


def held(at):
    model, wrench, gravity = at
    forces = (R.TipWrench(wrench), R.Gravity(gravity))
    return R.equilibrium(model, forces).q


def pinned(at):
    model, wrench, place, end = at
    pose = homogeneous(jnp.eye(2), place)
    held = R.with_closures(model, tip=R.Closure("rod", R.Revolute(), offset=pose, at=end))
    forces = (R.PartForce("rod", R.PointWrench(wrench, 0.5)),)
    found = R.equilibrium(held, forces, BENT)
    return found.q, found.reactions


HOOK = R.forward_kinematics(FLAT, BENT, np.array([0.9]))[0, :2, 2]


def pressed(at):
    wrench, floor = at
    contact = R.ObstacleContact(floor, 6e-3, LinePenalty(5e5, 2e-5), points=16)
    return R.equilibrium(FLAT, (R.TipWrench(wrench), contact)).q


def loaded(at):
    model, wrench = at
    return R.equilibrium_path(
        model, lambda k: (R.TipWrench(k * wrench),), jnp.array([0.5, 1.0])
    ).q


BAR = R.Link(0.1, 1e-5)
ARM = R.assembly(
    SE2(),
    first=R.Part(BAR, R.Revolute()),
    second=R.Part(BAR, R.Revolute(), on="first", offset=homogeneous(jnp.eye(2), 0.1 * AT)),
)
GROUND, END = (homogeneous(jnp.eye(2), jnp.array([x, 0.02])) for x in (0.12, 0.09))
TRIANGLE = R.with_closures(
    ARM, end=R.Closure("second", R.Spherical(), offset=GROUND, frame=END)
)
TWISTS = jnp.array([[0.1, 0.2, 0.3, 1, 2, 3], [1, -1, 0.5, 0, 1, 2], [0, 2, 1, 1, 0, -1]])
FLAT_WRENCH = jnp.array([1e-3, 0.01, 0.05])
BALL = sdf.Circle((0.05, 0.012), 8e-3)
EVERYWHERE = np.linspace(0.05, 1.0, 16)
GOAL = jnp.array([0.07, 0.02])


def reached(target, forces=None, **options):
    """The answer of a search, if it is one; least energy fills what is free."""

    def call(at):
        found = {name: make(at[name]) for name, make in options.items()}
        end = R.inverse_kinematics(at["model"], target(at["goal"]), forces=forces, **found)
        answered = (end.status == Status.successful) | (end.status == Status.out_of_reach)
        return jnp.where(answered, end.q, jnp.nan)

    return call


def goal(at=GOAL, model=FLAT, **numbers):
    return {"model": model, "goal": at, **numbers}


def clear(ball):
    return (R.ObstacleConstraint(ball, EVERYWHERE, 3e-3),)


def between(bound):
    return (-bound, bound)


IK = {
    "default arguments, redundant": (reached(R.Position), goal()),
    "least energy": (reached(R.Position, ()), goal()),
    "limits are active": (
        reached(R.Position, (), limits=between),
        goal(limits=jnp.array([15.0, 3.0, 20.0, 50.0])),
    ),
    "an obstacle is active": (reached(R.Position, (), obstacles=clear), goal(obstacles=BALL)),
    "under its weight": (reached(R.Position, (R.Gravity([3.0, -9.81]),)), goal()),
    "a pose": (reached(R.Pose, ()), goal(homogeneous(jnp.eye(2), jnp.array([0.07, 0.01])))),
    "a direction": (reached(R.Direction, ()), goal(jnp.array([0.6, 0.8]))),
    "on a surface": (
        reached(lambda ball: R.OnSurface(ball, 1.0), ()),
        goal(sdf.Circle((0.05, 0.05), 8e-3)),
    ),
}

# Motion


def thrown(stepper=None, forces=(), steps=6):
    def call(at):
        model, q, v, wrench, step = at
        pushed = (R.TipWrench(wrench), R.Damping(0.01), *forces)
        path = R.rollout(model, q, v, pushed, step=step, saves=steps, stepper=stepper)
        return path.q, path.v

    return Case(
        call, (FLAT, BENT, 10 * BENT, FLAT_WRENCH, jnp.asarray(1e-3)), rtol=1e-6, step=1e-4
    )


# Sections

SIZES = {
    "circle": (R.circle, (6e-3,)),
    "ellipse": (R.ellipse, (6e-3, 4e-3)),
    "rectangle": (R.rectangle, (6e-3, 4e-3)),
    "ring": (R.ring, (6e-3, 4e-3)),
    "squircle": (R.squircle, (6e-3, 3.0)),
}
OVAL = sdf.Ellipsoid([6e-3, 4e-3])


@functools.cache
def plate():
    return mesh.triangulate(OVAL, size=2.5e-3, order=2)


def drawn():
    made = plate()
    return Case(lambda shape: R.from_shape(shape, mesh=made), OVAL, step=1e-4, rtol=1e-6)


def meshed():
    made = plate()
    return Case(lambda x: R.from_mesh(replace(made, points=x)), made.points)


def sampled(at):
    section, factor = at
    tapered = R.taper(R.rectangle, (6e-3, factor * 4e-3), (3e-3, 2e-3))
    return R.scaled(section, factor), tapered(jnp.array([0.2, 0.7]))


def built(at):
    modulus, density, length, radius, rest = at
    made = R.rod(
        SE3(),
        R.chebyshev(kappa_z=2),
        R.circle(radius),
        length=length,
        nodes=6,
        young_modulus=modulus,
        poisson_ratio=0.3,
        density=density,
        rest_strain=rest,
    )
    two = R.serial(made, made)
    return R.operators(made), R.mass_matrix(two, jnp.array([3.0, -2.0, 1.0, 2.0]))


def elastic(at):
    return R.elastic(material.NeoHookean(*at, density=1e3))


SLOW = (f"{MOMENT}: a tree", "total_force: rod on a rod")
CASES = (
    {f"{MOMENT}: {name}": Case(moment, at, reverse=False) for name, at in MODELS.items()}
    | {
        f"{DYNAMICS}: {name}": Case(dynamics, (*at, WRENCH), step=1e-4, reverse=False)
        for name, at in MODELS.items()
    }
    | {
        f"inverse_kinematics: {name}": Case(*case, rtol=1e-4, step=1e-3)
        for name, case in IK.items()
    }
    | {
        name: Case(lambda at, make=make: make(*at), sizes)
        for name, (make, sizes) in SIZES.items()
    }
    | {
        "total_force: each force": Case(each_force, (FORCES, FINGER, Q, V), reverse=False),
        "thread_lengths, thread_rates, thread_chambers": Case(
            threads,
            (FINGER, Q, V, ROUTES, jnp.array([1e-5, 2e-5, 3e-5]), jnp.array([2e4, 1e4, 3e4])),
        ),
        "section_law, strain, points": Case(
            laws, (FINGER, Q, jnp.array([0.1, 0.2, 0.2, 30.0, 10.0, 10.0]), jnp.asarray(2.0))
        ),
        "branch_states, branch_force, branch_energy": Case(
            branches, (FINGER, SPECTRUM, jnp.array([0.0, 0.02, 0.03]), Q, REMEMBERED)
        ),
        "contact_energy, penetration: on a floor": Case(
            obstacle, (LAW, FLOOR, jnp.asarray(6e-3), PRESS, 0.1 * BENT), step=1e-6, rtol=1e-5
        ),
        "total_force: with itself": Case(
            itself, (LAW, jnp.asarray(6e-3), jnp.array([29.0, 1.0])), step=1e-6, rtol=1e-5
        ),
        "total_force: rod on a link": Case(
            stone, (LAW, BLOCK, TOUCH, 0.05 * TOUCH), step=1e-6, rtol=1e-5
        ),
        "total_force: rod on a rod": Case(
            two_rods, (LAW, jnp.array([6e-3, 6e-3]), MEET, 0.05 * MEET), step=1e-6, rtol=1e-5
        ),
        "equilibrium: a finger": Case(held, (FINGER, WRENCH, DOWN), rtol=1e-6),
        "with_closures: a finger held at both ends": Case(
            pinned,
            (FLAT, FLAT_WRENCH, 0.95 * HOOK, jnp.asarray(0.9)),
            rtol=1e-6,
        ),
        "equilibrium: pressed on a floor": Case(
            pressed, (-FLAT_WRENCH, FLOOR), rtol=1e-5, step=1e-5
        ),
        "equilibrium_path": Case(loaded, (FLAT, FLAT_WRENCH), rtol=1e-6),
        "rollout": thrown(),
        "from_shape": drawn,
        "from_mesh": meshed,
        "scaled, taper": Case(sampled, (DISC, jnp.asarray(1.3))),
        "rod, serial, operators, assembly": Case(
            built, (1e6, 2e3, 0.08, 6e-3, jnp.array([1.0, 2.0, 5.0, 1.05, 0.1, -0.05]))
        ),
        "elastic": Case(elastic, (3e5, 5e6)),
        "close_loops": Case(
            lambda model: R.close_loops(model, jnp.array([0.5, -1.0])).q, TRIANGLE, rtol=1e-6
        ),
        "motion_from_velocity": Case(
            lambda at: R.motion_from_velocity(*at, axes="moving")(jnp.asarray(0.7)),
            (jnp.array([0.0, 0.4, 1.0]), TWISTS, homogeneous(jnp.eye(3), jnp.ones(3))),
        ),
        "tip_angle": Case(lambda q: R.tip_angle(R.motion(FLAT, q)), BENT),
        "joint_wrenches, part_momenta": Case(
            carried, (TREE, W, RATES, 20 * RATES, WRENCH), step=1e-4, reverse=False
        ),
        "part_motion": Case(
            lambda at: R.part_motion(R.motion(*at), 1).tangent, (TREE, W, RATES)
        ),
    }
)
