"""Closed loops and held ends at rest: closed forms, the literature, derivatives, freedoms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.cases import rod_closed
from sorojax import SE2, SE3, rod as R
from sorojax.math.lie import homogeneous, plane_rotation
from sorojax.math.quadrature import gauss_legendre
from sorojax.math.status import Status
from sorojax.rod.dynamics import closures
from sorojax.rod.dynamics.closures import closure_force, closure_jacobian, violations
from sorojax.rod.model.assembly import retract
from sorojax.rod.model.closure import equations
from sorojax.rod.model.joint import AbstractJoint

pytestmark = pytest.mark.quick

LENGTH, LOAD = 0.1, 9.81 * 1000 * np.pi * 0.005**2  # m, N/m
STIFFNESS = 1e6 * np.pi / 4 * 0.005**4
NONE = jnp.zeros(())


def beam(group, modes, **options):
    numbers = {"length": LENGTH, "young_modulus": 1e6, "poisson_ratio": 0.5, "density": 1000.0}
    return R.rod(group, R.chebyshev(**modes), R.circle(0.005), **(numbers | options))


PLANE = beam(SE2(), {"kappa_z": 4})
SPACE = beam(SE3(), {"kappa_x": 1, "kappa_y": 2, "kappa_z": 2})


def shift(*position):
    return homogeneous(jnp.eye(len(position)), jnp.array(position, float))


def turned(angle, *position):
    return homogeneous(plane_rotation(jnp.asarray(angle)), jnp.array(position, float))


def held(joint, **options):
    closure = R.Closure("rod", joint, offset=shift(LENGTH, 0.0), **options)
    return R.with_closures(PLANE, tip=closure)


@pytest.mark.parametrize("group", [SE2(), SE3()])
@pytest.mark.parametrize(
    "joint", [R.Fixed(), R.Revolute(), R.Prismatic(), R.Spherical(), R.Roller()]
)
def test_reactions_do_work_on_the_rates_of_violations(group, joint):
    dim = group.space_dim
    body = {2: PLANE, 3: SPACE}[dim]
    away = jnp.eye(dim + 1).at[:2, dim].set(jnp.array([0.05, 0.02]))
    link = R.Link(0.1, 1e-4 if dim == 2 else [1e-4, 2e-4, 3e-4])
    tree = R.assembly(
        group,
        a=R.Part(body, R.Revolute()),
        b=R.Part(link, R.Spherical(), on="a"),
        c=R.Part(body, R.Roller(), on="b", offset=away),
    )
    model = R.with_closures(
        tree,
        pair=R.Closure("c", joint, on="a", s=0.4, offset=away, at=0.7, frame=away),
        ground=R.Closure("b", joint, offset=away, frame=away),
    )
    rng, count = np.random.default_rng(0), R.num_dof(model)
    q = retract(model, R.rest(model), jnp.array(0.5 * rng.standard_normal(count)))

    @jax.jit
    def found(q, reactions):
        at = jax.jacfwd(lambda d: violations(R.motion(model, retract(model, q, d)), NONE))
        moment = R.motion(model, q)
        rows = closure_jacobian(moment, NONE)
        return rows, at(jnp.zeros(count)), closure_force(moment, NONE, reactions)

    reactions = jnp.array(rng.standard_normal(equations(model)[-1].stop))
    rows, slopes, force = found(q, reactions)
    # in space the Jacobian of a rod is that of its position up to the quadrature
    assert jnp.abs(rows - slopes).max() < (1e-14 if dim == 2 else 1e-4) * jnp.abs(rows).max()
    assert jnp.abs(force - rows.T @ reactions).max() < 1e-14


@pytest.mark.parametrize("group", [SE2(), SE3()])
def test_slopes_of_violations_are_those_of_differentiation(group):
    rng, dim = np.random.default_rng(0), group.space_dim
    pose = group.exp(jnp.array(rng.standard_normal(group.algebra_dim)))
    for joint in (R.Fixed(), R.Revolute(), R.Prismatic(), R.Spherical(), R.Roller()):
        slopes = joint.slopes(group, pose[:dim, :dim], pose[:dim, dim])
        want = AbstractJoint.slopes(joint, group, pose[:dim, :dim], pose[:dim, dim])
        np.testing.assert_allclose(slopes, want, atol=1e-15, err_msg=str(joint))


def test_no_violation_where_the_joint_moves():
    rng = np.random.default_rng(1)
    for group in (SE2(), SE3()):
        for joint in (R.Fixed(), R.Revolute(), R.Prismatic(), R.Spherical(), R.Roller()):
            count = joint.num_dof(group)
            move = jnp.array(rng.standard_normal(count))
            pose = joint.pose(group, joint.retract(group, joint.rest(group, float), move))
            assert jnp.abs(joint.violation(group, *pose)).max() < 1e-15
            held = joint.violation(group, *pose).shape[0]
            assert held == group.algebra_dim - count


@pytest.mark.parametrize(
    ("joint", "upward"),
    [(R.Roller(), 3 / 8), (R.Prismatic(), 1 / 2), (R.Revolute(), 3 / 8), (R.Fixed(), 1 / 2)],
)
def test_a_beam_held_at_its_end_bears_its_weight(joint, upward):
    # as light as it takes for small strains; between two pins a beam has to stretch
    body = beam(SE2(), {"kappa_z": 4, "sigma_x": 1})
    closure = R.Closure("rod", joint, offset=shift(LENGTH, 0.0))
    rest = R.equilibrium(R.with_closures(body, tip=closure), (R.Gravity([0.0, -0.01]),))
    weight = LOAD / 981 * LENGTH
    assert rest.status == Status.successful and rest.negative_eigenvalues == 0
    assert abs(float(rest.reactions["tip"][2]) / weight - upward) < 1e-5


def test_a_sunk_support_has_the_reaction_of_the_closed_form_and_its_derivative():
    def reaction(depth):
        closure = R.Closure("rod", R.Roller(), offset=shift(LENGTH, -depth))
        return R.equilibrium(R.with_closures(PLANE, tip=closure)).reactions["tip"][2]

    stiffness = 3 * STIFFNESS / LENGTH**3
    small = 1e-5
    assert abs(float(reaction(small)) / (-stiffness * small) - 1) < 1e-6
    at, step = 5e-3, 1e-5
    forward, back = jax.jacfwd(reaction)(at), jax.grad(reaction)(at)
    difference = (reaction(at + step) - reaction(at - step)) / (2 * step)
    assert abs(forward / difference - 1) < 1e-6 and abs(back / forward - 1) < 1e-12


def test_joints_bear_what_closures_do_not():
    body = beam(SE2(), {"kappa_z": 4, "sigma_x": 1})
    on_pin = R.Closure("rod", R.Roller(), offset=shift(LENGTH, 0.0))
    model, forces = R.with_closures(body, tip=on_pin), (R.Gravity(),)
    rest = R.equilibrium(model, forces)
    still = jnp.zeros(5)
    clamp = R.joint_wrenches(model, rest.q, still, still, forces)["rod"]
    tip, place = rest.reactions["tip"], R.tip_pose(model, rest.q)["rod"][:2, 2]
    assert abs(float(clamp[2] + tip[2]) / (LOAD * LENGTH) - 1) < 1e-9
    assert abs(float(clamp[1] + tip[1])) < 1e-9 * LOAD * LENGTH
    moved = jax.jit(lambda q: R.points(R.part_motion(R.motion(model, q), 0), NODES).position)
    weights = body.length * jnp.asarray(WEIGHTS)
    weight = LOAD * jnp.sum(weights * moved(rest.q)[:, 0])
    about = clamp[0] + place[0] * tip[2] - place[1] * tip[1]
    assert abs(float(about / weight) - 1) < 1e-9


NODES, WEIGHTS = gauss_legendre(10)


def test_a_ring_bears_one_moment():
    seam = R.with_closures(PLANE, seam=R.Closure("rod", on="rod", s=0.0))
    bend = 2 * np.pi / LENGTH
    rest = R.equilibrium(seam, (), jnp.array([1.1 * bend, 0.0, 5.0, 0.0]))
    assert rest.status == Status.successful
    assert jnp.abs(rest.q - jnp.array([bend, 0, 0, 0])).max() < 1e-9 * bend
    moment, *force = rest.reactions["seam"]
    assert abs(float(moment) / (STIFFNESS * bend) - 1) < 1e-9
    # what the quadrature leaves of a whole turn
    assert jnp.hypot(*force) < 1e-8 * moment / LENGTH


def test_a_ring_folds_to_a_third():
    """Goto, Watanabe, Kasugai, Obata, Int. J. Solids Structures 29, 1992."""
    path = rod_closed.fold(rod_closed.half_ring(5), steps=30)
    assert bool(jnp.all(path.status == Status.successful))
    across = R.tip_pose(rod_closed.half_ring(5), path.q[-1])["rod"][1, 3]
    assert abs(float(across) / (2 * rod_closed.RADIUS / 3) - 1) < 1e-6


def test_a_frame_on_two_pins_snaps_through():
    """Lee, Manuel, Rossow, J. Eng. Mech. Div. 94, 1968: first limit load 18.552."""
    path = rod_closed.snap(rod_closed.frame(4))
    assert bool(jnp.all(path.status == Status.successful))
    turn = int(jnp.argmax(path.factors))
    assert 0 < turn < len(path.factors) - 1
    assert abs(rod_closed.peak(path) / rod_closed.LIMIT - 1) < 5e-3
    assert jnp.all(path.negative_eigenvalues[:turn] == 0)
    assert path.negative_eigenvalues[turn + 1] == 1


def four_bar(**spring):
    """A parallelogram of links, its hinges along z of space."""
    link = R.Link(0.1, [1e-4] * 3, center=[0.5, 0, 0])
    along = shift(1.0, 0.0, 0.0)
    chain = R.assembly(
        SE3(),
        a=R.Part(link, R.Revolute(**spring)),
        b=R.Part(link, R.Revolute(), on="a", offset=along),
        c=R.Part(link, R.Revolute(), on="b", offset=along),
    )
    return R.with_closures(chain, pin=R.Closure("c", R.Revolute(), offset=along, frame=along))


UPRIGHT = jnp.array([1.0, -1.0, -1.0]) * np.pi / 2


def test_redundant_equations_are_named_and_singular_poses_flagged():
    found = R.mobility(four_bar(), UPRIGHT)
    assert (found.freedoms, found.redundant, found.singular) == (1, {"pin": 3}, False)
    flat = R.mobility(four_bar(), jnp.array([0.0, 0.0, -np.pi]))
    assert (flat.freedoms, flat.redundant, flat.singular) == (2, {"pin": 3}, True)
    assert R.mobility(PLANE).freedoms == 4
    with pytest.raises(ValueError, match="loops are open by 1 rad or m"):
        R.mobility(four_bar(), jnp.array([0.0, 0.0, 0.0]).at[2].set(-np.pi / 2))


def test_loops_with_redundant_equations_have_an_equilibrium_with_derivatives():
    """The spring of the crank against the weight: k a = (m / 2 + m + m / 2) g cos a."""

    def angle(gravity):
        forces = (R.Gravity(jnp.array([0.0, -1.0, 0.0]) * gravity),)
        found = R.equilibrium(four_bar(stiffness=5.0), forces, START)
        return found.q[0], found

    a, found = angle(9.81)
    assert found.status == Status.successful
    assert abs(-5.0 * float(a) - 0.2 * 9.81 * np.cos(float(a))) < 1e-10
    slope = jax.grad(lambda g: angle(g)[0])(9.81)
    closed = -0.2 * np.cos(float(a)) / (5.0 - 0.2 * 9.81 * np.sin(float(a)))
    assert abs(float(slope) / closed - 1) < 1e-6
    assert jnp.all(jnp.isfinite(found.reactions["pin"]))


START = jnp.array([-0.3, 0.3, -np.pi - 0.3])


def test_a_parallel_robot_takes_the_pose_that_it_is_asked():
    leg = R.rod(
        SE2(), R.chebyshev(kappa_z=3), R.circle(2e-3), length=0.2, young_modulus=1e6,
        poisson_ratio=0.5, density=1000.0,
    )  # fmt: skip
    rail = R.Prismatic([0.0, 1.0])
    robot = R.assembly(
        SE2(),
        left=R.Part(leg, rail, offset=turned(np.pi / 2, -0.05, 0.0)),
        top=R.Part(
            R.Link(0.01, 1e-6), R.Revolute(), on="left", offset=turned(-np.pi / 2, 0, 0)
        ),
        right=R.Part(leg, rail, offset=turned(np.pi / 2, 0.05, 0.0)),
    )
    robot = R.with_closures(
        robot, hinge=R.Closure("right", R.Revolute(), on="top", offset=shift(0.1, 0.0))
    )

    pose = turned(0.1, -0.04, 0.185)
    found = R.inverse_kinematics(robot, R.Pose(pose, part="top"))
    assert found.status == Status.successful
    assert jnp.abs(violations(R.motion(robot, found.q), NONE)).max() < 1e-6
    assert jnp.abs(R.tip_pose(robot, found.q)["top"] - pose).max() < 1e-5

    def least_energy(x):
        goal = R.Closure("top", offset=turned(0.1, x, 0.185))
        return R.equilibrium(R.with_closures(robot, goal=goal), (), found.q)

    same = least_energy(-0.04)
    assert same.status == Status.successful and same.iterations < 6
    assert jnp.abs(same.q - found.q).max() < 1e-2 * jnp.abs(found.q).max()
    slope = jax.jacfwd(lambda x: least_energy(x).q)(-0.04)
    step = 1e-5
    apart = (least_energy(-0.04 + step).q - least_energy(-0.04 - step).q) / (2 * step)
    assert jnp.abs(slope - apart).max() < 1e-6 * jnp.abs(apart).max()


@pytest.mark.parametrize(
    ("closure", "message"),
    [
        (lambda: R.Closure("arm"), "names `arm`, need one of rod"),
        (lambda: R.Closure("rod", on="arm"), "Leave `on` out"),
        (lambda: R.Closure("rod", R.Free()), "Free cannot close a loop"),
        (lambda: R.Closure("rod", R.Screw(1.0, 0.1)), "Screw cannot close a loop"),
        (lambda: R.Closure("rod", offset=np.eye(4)), "offset"),
        (lambda: R.Closure("rod", s=1.5), "s"),
    ],
)
def test_what_cannot_close_is_refused(closure, message):
    with pytest.raises(ValueError, match=message):
        R.with_closures(PLANE, tip=closure())


def test_names_of_closures_are_taken_once():
    with pytest.raises(ValueError, match="closure `tip` already"):
        R.with_closures(held(R.Fixed()), tip=R.Closure("rod"))


@pytest.mark.parametrize("verb", [R.equilibrium, R.rollout, R.forward_dynamics])
def test_a_model_without_closures_does_not_meet_them(verb, monkeypatch):
    def met(*_):
        raise RuntimeError("a closure is looked at")

    monkeypatch.setattr(closures, "_ends", met)
    zero = jnp.zeros(4)

    def traced(model):
        options = {} if verb is R.equilibrium else {"v": zero}
        if verb is R.rollout:
            options |= {"step": 1e-3, "saves": 8}

        def call(q):
            return verb(model, q=q, forces=(R.Gravity(),), **options)

        return jax.eval_shape(call, zero)

    traced(R.assembly(SE2(), rod=R.Part(PLANE)))
    with pytest.raises(RuntimeError, match="looked at"):
        traced(held(R.Roller()))
