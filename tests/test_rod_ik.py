"""Inverse kinematics: targets, bounds, null space, derivatives, grasp, bad input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import sorojax as sj
from sorojax import rod as R, sdf
from sorojax.math.lie import SE2, SE3, change_of_logarithm, logarithm
from sorojax.math.status import Status

FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
BODY = R.rod(SE3(), R.chebyshev(kappa_y=3, kappa_z=3), R.circle(6e-3), nodes=8, **FINGER)
FLAT = R.rod(SE2(), R.chebyshev(kappa_z=4), R.circle(6e-3), nodes=9, **FINGER)


def drawn(count, size=6):
    return jnp.array(np.random.default_rng(0).normal(0, 5, (count, size)))


@pytest.mark.parametrize("group", [SE2(), SE3()])
def test_the_logarithm_undoes_the_exponential(group):
    rng, n, rot = np.random.default_rng(0), group.algebra_dim, group.rotation_dim
    back = jax.jit(lambda w: logarithm(group, group.exp(w)))
    apart = jax.jit(jax.jacfwd(lambda d, w: logarithm(group, group.exp(d) @ group.exp(w))))
    for angle in (0.0, 1e-9, 1e-3, 0.14, 0.15, 3.0, 3.14):
        twist = rng.normal(size=n)
        twist[:rot] *= angle / np.linalg.norm(twist[:rot])
        w = jnp.array(twist)
        assert jnp.allclose(back(w), w, rtol=0, atol=1e-14)
        change = change_of_logarithm(group, w)
        assert jnp.allclose(change, apart(jnp.zeros(n), w), rtol=0, atol=1e-12)


def test_poses_are_reached_from_rest_in_ten_steps():
    def reach(q):
        pose = R.tip_pose(BODY, q)
        found = R.inverse_kinematics(BODY, R.Pose(pose), iterations=10)
        return found.error, R.tip_pose(BODY, found.q) - pose

    error, apart = jax.jit(jax.vmap(reach))(drawn(20))
    assert jnp.all(error < 1e-6 * 0.08) and jnp.abs(apart).max() < 1e-5


def test_a_loop_in_real_time_reaches_what_the_verb_reaches():
    poses = [R.tip_pose(BODY, q) for q in drawn(3)]

    def reach(pose, q):
        return R.inverse_kinematics(BODY, R.Pose(pose), q, iterations=10)

    compiled = sj.compiled(reach, poses[0], jnp.zeros(6))
    for pose in poses:
        found = compiled(pose, jnp.zeros(6))
        assert found.status == Status.successful
        assert jnp.abs(R.tip_pose(BODY, found.q) - pose).max() < 1e-5


def test_a_far_target_gives_the_closest_pose_and_says_so():
    far = eqx.filter_jit(
        lambda x: R.inverse_kinematics(FLAT, R.Position(x), jnp.array([1.0, 0.5, 0.0, 0.0]))
    )
    found = far(jnp.array([0.06, 0.12]))
    assert found.status == Status.out_of_reach
    # Straight towards the target is closest for an inextensible rod that may bend sharply;
    # with few modes no neighbour is closer.
    near = jax.vmap(lambda d: R.tip_pose(FLAT, found.q + d)[:2, 2])(0.3 * drawn(50, 4))
    gaps = jnp.linalg.norm(near - jnp.array([[0.06, 0.12]]), axis=1)
    assert jnp.all(gaps > found.error) and gaps.min() < 1.05 * found.error
    assert far(jnp.array([0.06, 0.03])).status == Status.successful
    assert far(jnp.array([jnp.nan, 0.0])).status == Status.not_finite


def test_the_null_space_holds_the_least_energy():
    @jax.jit
    def both(x):
        ends = [
            R.inverse_kinematics(FLAT, R.Position(x), forces=forces, q=q)
            for forces, q in (((), None), ((), jnp.array([9.0, -5.0, 8.0, 3.0])))
        ]
        return ends, jax.jacfwd(lambda q: R.tip_pose(FLAT, q)[:2, 2])(ends[0].q)

    (first, second), slope = both(jnp.array([0.06, 0.03]))
    assert first.status == Status.successful and second.status == Status.successful
    assert jnp.allclose(first.q, second.q, rtol=0, atol=1e-5)
    # At the least energy K q has no part in the null space of the task.
    force = R.stiffness_matrix(FLAT) @ first.q
    across = force - slope.T @ jnp.linalg.lstsq(slope.T, force)[0]
    assert jnp.linalg.norm(across) < 1e-6 * jnp.linalg.norm(force)
    assert first.error < 1e-7 * 0.08


def test_limits_and_obstacles_hold_at_the_answer():
    ball = sdf.Circle((0.05, 0.012), 8e-3)
    everywhere = jnp.linspace(0.05, 1.0, 24)

    @eqx.filter_jit
    def find(x, bound, distance):
        return R.inverse_kinematics(
            FLAT,
            R.Position(x),
            limits=(-bound, bound),
            obstacles=(R.ObstacleConstraint(ball, everywhere, distance),),
            forces=(),
        )

    goal = jnp.array([0.07, 0.02])
    found = find(goal, jnp.array(1e3), jnp.array(3e-3))
    path = R.forward_kinematics(FLAT, found.q, everywhere)[:, :2, 2]
    gap = jax.vmap(ball)(path).min()
    assert found.status == Status.successful and gap > 3e-3 - 1e-6 * 0.08
    assert gap < 3e-3 + 1e-5  # the least energy leans on the obstacle
    tight = find(goal, jnp.array(10.0), jnp.array(3e-3))
    assert jnp.all(jnp.abs(tight.q) <= 10.0)


@pytest.mark.stress(91)
def test_an_answer_on_its_limits_has_the_least_energy_there():
    stiffness, goal = np.asarray(R.stiffness_matrix(FLAT)), jnp.array([0.07, 0.02])
    bound = np.array([15.0, 3.0, 20.0, 50.0])
    reach = jax.jit(lambda q: R.tip_pose(FLAT, q)[:2, 2] - goal)
    slope = jax.jit(jax.jacfwd(reach))
    least = minimize(
        lambda q: 1e3 * q @ stiffness @ q,
        np.array([2.0, 2.9, -10.0, -12.0]),
        method="SLSQP",
        jac=lambda q: 2e3 * stiffness @ q,
        bounds=list(zip(-bound, bound, strict=True)),
        constraints=[
            {
                "type": "eq",
                "fun": lambda q: 1e2 * np.asarray(reach(q)),
                "jac": lambda q: 1e2 * np.asarray(slope(q)),
            }
        ],
        options={"ftol": 1e-15},
    )
    find = jax.jit(
        lambda x: R.inverse_kinematics(FLAT, R.Position(x), limits=(-bound, bound), forces=())
    )
    found = find(goal)
    assert found.status == Status.successful
    assert np.allclose(found.q, least.x, rtol=0, atol=1e-5)
    assert (np.abs(np.abs(found.q) - bound) < 1e-9).sum() == 2
    change = jax.jit(jax.jacfwd(lambda x: find(x).q))(goal)
    seen = (find(goal + jnp.array([1e-5, 0])).q - find(goal - jnp.array([1e-5, 0])).q) / 2e-5
    assert jnp.allclose(change[:, 0], seen, rtol=0, atol=1e-4 * float(jnp.abs(seen).max()))


def test_answers_are_differentiable_and_batched():
    ball = sdf.Circle((0.05, 0.012), 8e-3)
    everywhere = jnp.linspace(0.05, 1.0, 24)

    def find(x):
        goal = jnp.stack([x, 0.02 + 0 * x])
        found = R.inverse_kinematics(
            FLAT,
            R.Position(goal),
            obstacles=(R.ObstacleConstraint(ball, everywhere, 3e-3),),
            forces=(),
        )
        return found.q

    xs = jnp.array([0.07 - 1e-5, 0.07, 0.07 + 1e-5])
    qs = jax.jit(jax.vmap(find))(xs)
    slope = jax.jit(jax.jacrev(find))(xs[1])
    difference = (qs[2] - qs[0]) / 2e-5
    assert jnp.allclose(slope, difference, rtol=0, atol=1e-4 * float(jnp.abs(slope).max()))


# The grasp of a jellyfish: six fingers of 120 mm from the rim of a palm, a ball of 40 mm
# whose centre is 60 mm below.
ARM = R.rod(
    SE3(),
    R.chebyshev(kappa_y=3, kappa_z=3),
    R.rectangle(4e-3, 1e-3),
    length=0.12,
    young_modulus=1e6,
    poisson_ratio=0.49,
    density=1070.0,
    nodes=10,
)


def test_a_grasp_closes_from_rest_without_penetration():
    s = jnp.linspace(0.0, 1.0, 25)

    def mount(angle):
        """The frame of a finger that hangs from the rim, its x axis down."""
        turn = jnp.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
        about = jnp.stack(
            [
                jnp.stack([jnp.cos(angle), -jnp.sin(angle), 0 * angle]),
                jnp.stack([jnp.sin(angle), jnp.cos(angle), 0 * angle]),
                jnp.array([0.0, 0.0, 1.0]),
            ]
        )
        return about @ turn, about @ jnp.array([0.045, 0.0, 0.0])

    def grasp(angle):
        rotation, place = mount(angle)
        center = rotation.T @ (jnp.array([0.0, 0.0, -0.06]) - place)
        jellyfish = sdf.Sphere(center, 0.04)
        skin = 0.5e-3  # half the thickness of the finger
        sag = 0.005**2 / (8 * 0.04)  # of the arc between two sections
        hanging = R.forward_kinematics(ARM, jnp.zeros(6), s)[:, :3, 3]
        skinned = sdf.Sphere(center, 0.04 + skin)
        aims = jax.vmap(lambda p: sdf.project(skinned, p))(hanging)
        found = R.inverse_kinematics(
            ARM,
            R.Position(aims[8:], s[8:]),
            obstacles=(R.ObstacleConstraint(jellyfish, s[1:], skin + sag),),
        )
        fine = R.forward_kinematics(ARM, found.q, jnp.linspace(0.0, 1.0, 200))[:, :3, 3]
        return found, jax.vmap(jellyfish)(fine), jax.vmap(jellyfish)(hanging)

    angles = jnp.linspace(0.0, 5.0, 6) * jnp.pi / 3
    found, gap, before = jax.jit(jax.vmap(grasp))(angles)
    # The arc of the aims is shorter than the finger: it comes as close as it can.
    assert jnp.all(found.status._value == Status.out_of_reach._value)
    assert gap.min() > 0.5e-3  # between the sections that were asked, too
    assert jnp.all(gap[:, 100:].mean(axis=1) < 0.5 * before[:, 12:].mean(axis=1))


def test_a_tool_of_an_assembly_is_put_where_it_shall_be():
    nail = R.Link(0.02, 1e-6)
    arm = R.assembly(
        SE2(),
        finger=R.Part(FLAT, R.Revolute(stiffness=0.1)),
        tool=R.Part(nail, R.Prismatic([1.0, 0.0], stiffness=50.0), on="finger"),
    )

    def tool(q):
        return R.forward_kinematics(arm, q)["tool"][0]

    @jax.jit
    def reach(pose):
        found = R.inverse_kinematics(arm, R.Pose(pose, part="tool"))
        return found, tool(found.q)

    goal = tool(jnp.array([0.4, 6.0, -4.0, 5.0, 1.0, 0.01]))
    found, end = reach(goal)
    assert found.status == Status.successful and found.error < 1e-9 * 0.08
    assert jnp.allclose(end, goal, rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match="names no part"):
        R.inverse_kinematics(arm, R.Pose(goal))


def test_an_axis_is_turned_while_a_section_stays_put():
    begin = drawn(1)[0]
    pose = R.tip_pose(BODY, begin)  # almost straight: its axis turns a little, no more
    place, axis = pose[:3, 3], pose[:3, 0]

    @jax.jit
    def turn(direction):
        targets = R.Direction(direction), R.Position(place)
        found = R.inverse_kinematics(BODY, targets, begin, forces=())
        return found, R.tip_pose(BODY, found.q)

    near, far = (axis + jnp.array(d) for d in ([-0.5, 0.0, 0.0], [0.0, 0.0, 1.0]))
    found, end = turn(near)
    assert found.status == Status.successful
    assert jnp.allclose(end[:3, 0], near / jnp.linalg.norm(near), rtol=0, atol=1e-6)
    assert jnp.allclose(end[:3, 3], place, rtol=0, atol=1e-8)
    # The null space has a say out of reach, too, and must not keep the search awake.
    found, _ = turn(far)
    assert found.status == Status.out_of_reach and found.iterations < 60
    assert 1e-3 < found.error < 1.8e-3


def test_the_least_energy_has_first_and_second_derivatives():
    stiffness = R.stiffness_matrix(FLAT)

    def goal(x):
        return jnp.stack([x, 0.02 + 0 * x])

    def energy(x):
        found = R.inverse_kinematics(FLAT, R.Position(goal(x)), forces=())
        return found.q @ stiffness @ found.q, found

    def balance(ends, x):
        """Forces of the rod and of what holds its tip, and by how much that is off."""
        q, force = ends[:4], ends[4:]
        tip, pull = jax.vjp(lambda q: R.tip_pose(FLAT, q)[:2, 2], q)
        return jnp.concatenate([stiffness @ q + pull(force)[0], tip - goal(x)])

    def exact(q, x):
        def newton(_, ends):
            return ends - jnp.linalg.solve(jax.jacfwd(balance)(ends, x), balance(ends, x))

        ends = jax.lax.fori_loop(0, 6, newton, jnp.concatenate([q, jnp.zeros(2)]))
        return ends[:4] @ stiffness @ ends[:4]

    @jax.jit
    def both(x):
        slope, found = jax.grad(energy, has_aux=True)(x)
        bend, _ = jax.jacfwd(jax.grad(energy, has_aux=True), has_aux=True)(x)
        near = x + 1e-4 * jnp.arange(-2.0, 3.0)
        return found, slope, bend, jax.vmap(lambda x: exact(found.q, x))(near)

    found, slope, bend, e = both(jnp.array(0.07))
    assert found.status == Status.successful and found.iterations < 40
    first = (e[0] - 8 * e[1] + 8 * e[3] - e[4]) / 12e-4
    second = (-e[0] + 16 * e[1] - 30 * e[2] + 16 * e[3] - e[4]) / 12e-8
    assert jnp.abs(slope / first - 1) < 1e-7 and jnp.abs(bend / second - 1) < 1e-6
