"""Assemblies: invariants, closed forms, coherence with single rods, motion, bad input."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from sorojax import replace, rod as R, systems as S
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.ode.linearly_implicit import LinearlyImplicit
from sorojax.math.ode.steppers import (
    DormandPrince,
    GeneralisedAlpha,
    ImplicitMidpoint,
    RungeKutta4,
    TripleJump,
    start,
)
from sorojax.math.status import Status
from sorojax.rod.dynamics.rollout import second_order
from sorojax.rod.model.assembly import rate, retract

FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
DISC = R.circle(6e-3, shear_factor=27 / 28)
DOWN = jnp.array([1.0, 2.0, -9.81])
AT = [0.3, 1.0]
WRENCH = jnp.array([0.3, -0.1, 0.2, 1.0, 2.0, -3.0])
Q = jnp.array([0.3, 5.0, -4.0, 0.02, 0.01, 3.0, 2.0, 0.03])  # of the planar tree


def bent(**options):
    basis = R.chebyshev(kappa_y=1, kappa_z=2, sigma_x=1)
    return R.rod(SE3(), basis, DISC, nodes=14, **FINGER, **options)


def pose(x, y, angle):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, 0.6 * c, -0.8], [0.8 * s, 0.8 * c, 0.6]])
    turn = np.linalg.qr(turn)[0]
    turn[:, 2] *= np.linalg.det(turn)
    return homogeneous(jnp.array(turn), jnp.array([x, y, 0.01]))


def relative(value, reference):
    return float(jnp.abs(value - reference).max() / jnp.abs(reference).max())


@pytest.fixture(scope="module")
def hand():
    """A floating palm, a finger on a sprung hinge, a rigid nail on a slide along it."""
    inertia = jnp.array([[3e-6, 1e-7, 0], [1e-7, 5e-6, 2e-7], [0, 2e-7, 4e-6]])
    link = R.Link(0.02, inertia, [0.005, 0.002, -0.003])
    hinge = R.Revolute([1.0, 2.0, 3.0], stiffness=0.1)
    heavy = dataclasses.replace(DISC, mass_offset_y=1e-3, mass_offset_z=-2e-3)
    finger = dataclasses.replace(bent(), section=heavy)
    model = R.assembly(
        SE3(),
        palm=R.Part(link, R.Free()),
        finger=R.Part(finger, hinge, on="palm", offset=pose(0.01, 0.02, 0.4)),
        nail=R.Part(
            link, R.Prismatic([0.0, 1.0, 1.0]), on="finger", s=0.6, offset=pose(0, 0.01, 1)
        ),
    )
    rng = np.random.default_rng(0)
    scale = np.array([0.5] * 7 + [6.0] * 3 + [0.05, 0.01])
    moved, v = (jnp.array(k * scale * rng.normal(size=12)) for k in (1, 5))
    return model, retract(model, R.rest(model), moved), v


@eqx.filter_jit
def everything(model, q, v):
    """All verbs and their derivatives along the motion, in one program."""

    def verbs(q):
        return {
            "mass": R.mass_matrix(model, q),
            "jacobian": R.jacobian(model, q, AT),
            "poses": R.forward_kinematics(model, q, AT),
            "potential": R.potential_energy(model, q, DOWN),
        }

    found, rates = jax.jvp(verbs, (q,), (rate(model, q, v),))
    found |= {f"{name}_rate": value for name, value in rates.items()}
    found["coriolis"] = R.coriolis_force(model, q, v)
    found["matrix"] = R.coriolis_matrix(model, q, v)
    found["product"] = R.jacobian_rate_product(model, q, v, AT)
    found["momentum"] = R.momentum(model, q, v)
    found["weight"] = R.gravity_force(model, q, DOWN)
    found["elastic"] = R.elastic_force(model, q)
    moment, pushes = R.motion(model, q, v), (R.PartForce("finger", R.TipWrench(WRENCH)),)
    found["pushed"] = R.total_force(pushes, q[0], moment) - R.total_force((), q[0], moment)
    return found


@pytest.fixture(scope="module")
def found(hand):
    return everything(*hand)


# Invariants


def test_mass_is_symmetric_and_positive(found):
    assert relative(found["mass"], found["mass"].T) < 1e-14
    assert jnp.linalg.eigvalsh(found["mass"])[0] > 0


def test_coriolis_matrix_makes_the_force_and_the_rate_of_the_mass(hand, found):
    assert relative(found["matrix"] @ hand[2], found["coriolis"]) < 1e-9
    skew = found["mass_rate"] - 2 * found["matrix"]
    assert jnp.abs(skew + skew.T).max() < 1e-12 * jnp.abs(found["mass_rate"]).max()


def test_jacobians_are_rates_of_poses(hand, found):
    for name, jacobian in found["jacobian"].items():
        velocity = found["poses_rate"][name]
        twist = jacobian @ hand[2]
        assert relative(twist[:, 3:], velocity[:, :3, 3]) < 1e-9
        spin = velocity[:, :3, :3] @ jnp.swapaxes(found["poses"][name][:, :3, :3], 1, 2)
        spin = jnp.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        assert relative(twist[:, :3], spin) < 1e-9
        product, scale = found["product"][name], jnp.abs(hand[2]).max()
        exact = found["jacobian_rate"][name] @ hand[2]
        assert jnp.abs(product - exact).max() < 1e-9 * max(float(jnp.abs(exact).max()), scale)


def test_gravity_and_springs_take_their_power_from_their_energy(hand, found):
    powers = jnp.stack([found["weight"] @ hand[2], found["elastic"] @ hand[2]])
    assert jnp.abs(powers).min() > 0.01 * jnp.abs(powers).max()
    assert jnp.isclose(powers.sum(), found["potential_rate"], rtol=1e-10, atol=0)


def test_a_wrench_on_a_carried_rod_acts_through_its_jacobian(found):
    assert relative(found["pushed"], WRENCH @ found["jacobian"]["finger"][1]) < 1e-9


def test_momentum_is_that_of_the_floating_base(found, hand):
    # Rates of a free root: the linear ones see the linear momentum.
    model, q, v = hand
    assert relative(found["momentum"][3:], (found["mass"] @ v)[3:6]) < 1e-12
    about = (found["mass"] @ v)[:3] + jnp.cross(q[4:7], found["momentum"][3:])
    assert relative(found["momentum"][:3], about) < 1e-10


# Closed forms and coherence


def test_double_pendulum():
    length, mass, spin = 0.4, 0.7, 2e-3
    link = R.Link(mass, spin, [0.5 * length, 0.0])
    end = homogeneous(jnp.eye(2), jnp.array([length, 0.0]))
    model = R.assembly(
        SE2(),
        upper=R.Part(link, R.Revolute()),
        lower=R.Part(link, R.Revolute(), on="upper", offset=end),
    )
    q, v = jnp.array([0.3, -0.8]), jnp.array([1.5, 2.5])
    half = length / 2
    c, s = np.cos(-0.8), np.sin(-0.8)
    mid = mass * half**2 + spin
    off = mass * length * half * c
    m22, m12 = mid, mid + off
    m11 = 2 * mid + mass * length**2 + 2 * off
    mass_matrix = jnp.array([[m11, m12], [m12, m22]])
    pull = mass * length * half * s
    coriolis = pull * jnp.array([-2.5 * (2 * 1.5 + 2.5), 1.5**2])

    @jax.jit
    def verbs(q, v):
        energy = R.kinetic_energy(model, q, v)
        force = R.coriolis_force(model, q, v)
        return R.mass_matrix(model, q), force, R.gravity_force(model, q), energy

    found = verbs(q, v)
    assert relative(found[0], mass_matrix) < 1e-14
    assert relative(found[1], coriolis) < 1e-13
    assert jnp.isclose(found[3], v @ mass_matrix @ v / 2, rtol=1e-13)
    g = 9.81 * mass
    first, both = np.cos(0.3), np.cos(0.3 - 0.8)
    weight = g * jnp.array([(half + length) * first + half * both, half * both])
    assert relative(found[2], weight) < 1e-14


def test_constant_segments_end_to_end_are_one_piecewise_rod():
    whole = R.rod(SE2(), R.piecewise_constant(kappa_z=2), DISC, **FINGER)
    segment = R.rod(SE2(), R.constant("kappa_z"), DISC, **FINGER)
    half = replace(segment, lambda r: r.length, 0.04)
    q, v = jnp.array([8.0, -5.0]), jnp.array([20.0, -30.0])

    @eqx.filter_jit
    def verbs(model):
        bias = R.bias_force(model, q, v)
        return R.mass_matrix(model, q), bias, R.tip_pose(model, q)

    one, two = verbs(whole), verbs(R.serial(half, half))
    assert relative(two[0], one[0]) < 1e-11
    assert relative(two[1], one[1]) < 1e-11
    assert jnp.allclose(two[2]["segment_1"], one[2], rtol=0, atol=1e-12)


def tree(group):
    """Rod on a hinge, link on a slide at its tip, an equal rod on the link."""
    rod = R.rod(group, R.chebyshev(kappa_z=2, sigma_y=1), DISC, **FINGER)
    dim = group.space_dim
    spin = 4e-6 if dim == 2 else [2e-6, 3e-6, 4e-6]
    link = R.Link(0.02, spin, [0.01, 0.02, 0.0][:dim])
    turn = jnp.eye(dim).at[:2, :2].set(jnp.array([[0.8, -0.6], [0.6, 0.8]]))
    offset = homogeneous(turn, jnp.array([0.01, -0.02, 0.0])[:dim])
    return R.assembly(
        group,
        root=R.Part(rod, R.Revolute(), offset=offset),
        body=R.Part(link, R.Prismatic(), on="root"),
        end=R.Part(rod, on="body", offset=offset),
    )


@eqx.filter_jit
def dynamics(model, q, v, down):
    return {
        "mass": R.mass_matrix(model, q),
        "bias": R.bias_force(model, q, v, down),
        "product": R.jacobian_rate_product(model, q, v, AT)["end"],
        "momentum": R.momentum(model, q, v),
    }


def test_planar_assembly_is_the_spatial_one_restricted():
    rng = np.random.default_rng(2)
    scale = jnp.array([1.0, 9, 9, 0.05, 0.02, 9, 9, 0.05])
    q, v = (scale * jnp.array(k * rng.normal(size=8)) for k in (1, 5))
    flat = dynamics(tree(SE2()), q, v, jnp.array([2.0, -9.81]))
    full = dynamics(tree(SE3()), q, v, jnp.array([2.0, -9.81, 0.0]))
    keep = jnp.array([2, 3, 4])
    assert relative(flat["mass"], full["mass"]) < 1e-11
    assert relative(flat["bias"], full["bias"]) < 1e-9
    assert relative(flat["product"], full["product"][:, keep]) < 1e-9
    assert relative(flat["momentum"], full["momentum"][keep]) < 1e-11


# Motion


@pytest.fixture(scope="module")
def thrown():
    """A tumbling body, and where Euler's equations bring it in half a second."""
    center, moments = np.array([0.1, 0, 0]), np.array([2e-3, 4e-3, 1e-3])
    model = R.assembly(SE3(), body=R.Part(R.Link(0.3, moments, center), R.Free()))
    v = np.array([3.0, -8.0, 5.0, 1.0, 2.0, -1.0])

    def euler(_, state):
        spin, turn = state[:3], state[3:].reshape(3, 3)
        change = np.cross(moments * spin, spin) / moments
        return np.concatenate([change, np.cross(turn, spin).ravel()])

    begin = np.concatenate([v[:3], np.eye(3).ravel()])
    path = solve_ivp(euler, (0, 0.5), begin, method="DOP853", rtol=1e-13, atol=1e-13)
    turn = path.y[3:, -1].reshape(3, 3)
    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    position = center + 0.5 * (v[3:] + np.cross(v[:3], center)) - turn @ center
    return model, R.rest(model), jnp.array(v), jnp.array([w, x, y, z, *position])


@pytest.mark.parametrize(
    "stepper, order",
    [
        (GeneralisedAlpha(1.0), 2),
        (ImplicitMidpoint(), 2),
        (LinearlyImplicit(), 1),
        (TripleJump(3), 4),
        (RungeKutta4(), 4),
        (DormandPrince(), 5),
    ],
)
def test_steppers_have_their_order_on_rotations(thrown, stepper, order):
    model, q, v, end = thrown

    @jax.jit
    def run(count):
        problem = second_order(model, q, ())
        h = 0.5 / count.astype(q.dtype)
        body = lambda k, state: stepper.step(problem, k.astype(h.dtype) * h, h, state)  # noqa: E731
        return jax.lax.fori_loop(0, count, body, start(problem, 0 * h, q, v))

    coarse, fine = run(jnp.array(64)), run(jnp.array(128))
    end = end.at[:4].multiply(jnp.sign(end[:4] @ fine.q[:4]))  # q and -q turn alike
    errors = [float(jnp.abs(state.q - end).max()) for state in (coarse, fine)]
    assert order - 0.4 < np.log2(errors[0] / errors[1]) < order + 1.3
    assert jnp.isclose(jnp.linalg.norm(fine.q[:4]), 1.0, rtol=0, atol=1e-14)


def test_a_thrown_rod_keeps_its_momentum():
    rod = R.rod(SE3(), R.chebyshev(kappa_z=1, sigma_x=1), DISC, nodes=10, **FINGER)
    model = R.assembly(SE3(), rod=R.Part(rod, R.Free()))
    v = jnp.array([30.0, -20.0, 40.0, 1.0, -0.5, 2.0, 100.0, 0.1])
    q = R.rest(model).at[7:].set(jnp.array([6.0, 0.02]))
    path = R.rollout(model, q, v, step=1e-4, saves=1, every=100, stepper=DormandPrince())
    assert path.status == Status.successful
    momenta = jax.vmap(lambda q, v: R.momentum(model, q, v))(path.q, path.v)
    assert relative(momenta[1, :3], momenta[0, :3]) < 1e-8
    assert relative(momenta[1, 3:], momenta[0, 3:]) < 1e-8


def test_dynamics_are_differentiable_at_rest_with_straight_rods():
    link = R.Link(0.02, [2e-6, 3e-6, 4e-6], [0.01, 0.0, 0.0])
    rod = R.rod(SE3(), R.constant("kappa_x", "kappa_z"), DISC, nodes=5, **FINGER)
    arm = R.Part(rod, on="base")
    model = R.assembly(SE3(), base=R.Part(link, R.Free()), arm=arm)
    v, step = jnp.linspace(0.0, 2.0, 8), jnp.full(8, 1e-4)
    weights = jnp.linspace(1.0, 2.0, 8) * jnp.array([1.0, -1.0] * 4)

    @eqx.filter_jit
    def both(model):
        def fall(model, step):
            q = retract(model, R.rest(model), step)
            return R.vector_field(model, (R.Gravity(),))(0.0, (q, v))[1]

        zero = 0 * step
        ahead, behind = jax.vmap(lambda k: fall(model, k * step))(jnp.array([1.0, -1.0]))
        along = jax.jvp(lambda step: fall(model, step), (zero,), (2 * step,))[1]
        scalar = lambda at: weights @ fall(*at)  # noqa: E731
        return ahead - behind, along, eqx.filter_grad(scalar)((model, zero))

    difference, along, (by_model, by_step) = both(model)
    assert relative(along, difference) < 1e-6
    assert jnp.isclose(by_step @ (2 * step), weights @ difference, rtol=1e-6)
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(by_model))
    assert by_model["arm"].body.length != 0


# Forces


def test_forces_act_on_the_parts_that_they_name():
    model, down = tree(SE2()), jnp.array([1.0, -9.81])
    q, v = Q, jnp.linspace(2.0, -1.0, 8)
    wrench = jnp.array([0.3, 1.0, 2.0])
    cases = {
        "idle": (),
        "end": (R.PartForce("end", R.TipWrench(wrench)),),
        "body": (R.PartForce("body", R.TipWrench(wrench)),),
        "damped": (R.Damping(0.02), R.PartForce("end", R.Damping(0.01))),
        "pushed": (R.JointEffort("body", [3.0]),),
        "weight": (R.Gravity(down),),
    }

    @jax.jit
    def totals(q):
        moment = R.motion(model, q, v)
        found = {k: R.total_force(forces, q[0], moment) for k, forces in cases.items()}
        damping = R.damping_matrix(model, cases["damped"])
        return found, R.jacobian(model, q, [1.0]), damping, R.gravity_force(model, q, down)

    found, tips, damping, weight = totals(q)
    for name in ("end", "body"):
        assert relative(found[name] - found["idle"], wrench @ tips[name][0]) < 1e-10
    assert relative(found["damped"] - found["idle"], -damping @ v) < 1e-9
    pushed = jnp.zeros(8).at[4].set(3.0)
    assert jnp.allclose(found["pushed"] - found["idle"], pushed, rtol=0, atol=1e-10)
    assert relative(found["weight"] - found["idle"], -weight) < 1e-9


class Spring(R.AbstractPairForce):
    """Pulls two parts together."""

    def __call__(self, t, first, second):
        stretch = second.position[0] - first.position[0]
        pair = (first.linear_jacobian[0], second.linear_jacobian[0])
        return stretch @ pair[0], -stretch @ pair[1]


def test_pair_forces_pull_against_each_other():
    model, q = tree(SE2()), Q

    @jax.jit
    def both(q):
        def energy(q):
            moment = R.motion(model, q)
            ends = [R.part_motion(moment, k).position[0] for k in (1, 2)]
            return jnp.sum((ends[1] - ends[0]) ** 2) / 2

        moment = R.motion(model, q)
        spring = (R.PairForce("body", "end", Spring()),)
        force = R.total_force(spring, q[0], moment) - R.total_force((), q[0], moment)
        return force, -jax.grad(energy)(q)

    assert relative(*both(q)) < 1e-10


class Bellows(R.AbstractChamber):
    """A chamber whose volume is affine in q."""

    slope: jax.Array
    ports: tuple[int, ...] = eqx.field(static=True, default=())

    def volume(self, q):
        return self.slope @ q


def test_an_assembly_is_a_block_of_a_network():
    model, bellows = tree(SE2()), Bellows(jnp.array([2e-8, 1e-8, 0.0]))
    forces = (R.PartForce("end", bellows), R.Damping(0.01))
    body = S.AssemblyBody(model, forces, driven=("root",))
    wires = {"body.end_pressure": "pump.value", "body.root_effort": "motor.value"}
    blocks = {
        "body": body,
        "pump": S.Source(S.Constant(2e3), "Pa"),
        "motor": S.Source(S.Constant([0.01])),
    }
    network = S.Network(blocks, wires)
    state = network.initial_state()
    q = jnp.linspace(0.1, 0.4, 8)
    state["body"]["q"] = q

    @jax.jit
    def both(q):
        bound = (R.PartForce("end", R.Pressurised(bellows, 2e3)), R.Damping(0.01))
        bound = (*bound, R.JointEffort("root", [0.01]))
        now = {**state, "body": {"q": q, "v": 0 * q}}
        rate = network.vector_field(0 * q[0], now)["body"]["v"]
        a = R.forward_dynamics(model, q, 0 * q, bound)
        missing = R.inverse_dynamics(model, q, 0 * q, a, bound)
        ports = S.outputs(network, q[0], now)
        return rate, a, missing, ports, R.tip_pose(model, q)["end"][:2, 2]

    found, expected, missing, ports, tip = both(q)
    assert jnp.abs(missing).max() < 1e-12
    assert relative(found, expected) < 1e-12
    assert jnp.isclose(ports["body.end_volume"], bellows.slope @ q[5:], rtol=1e-14)
    assert jnp.allclose(ports["body.end_position"], tip, rtol=0, atol=1e-14)


# Bad input


def test_messages_name_the_remedy():
    model, q, v = tree(SE2()), Q, 0 * Q
    rod = bent()
    with pytest.raises(ValueError, match="List the carrier first"):
        R.assembly(SE3(), a=R.Part(rod, on="b"), b=R.Part(rod))
    with pytest.raises(ValueError, match="need SE2"):
        R.assembly(SE2(), a=R.Part(rod))
    with pytest.raises(ValueError, match=r"need a point of the rod in \[0, 1\]"):
        R.Part(rod, s=1.5)
    with pytest.raises(ValueError, match="Wrap it"):
        R.forward_dynamics(model, q, v, (R.TipWrench(jnp.zeros(3)),))
    with pytest.raises(ValueError, match="no part `thumbs`"):
        R.forward_dynamics(model, q, v, (R.PartForce("thumbs", R.Gravity()),))
    with pytest.raises(ValueError, match="see `rest`"):
        R.mass_matrix(model, jnp.zeros(12))
    with pytest.raises(ValueError, match="three moments"):
        R.mass_matrix(R.assembly(SE3(), a=R.Part(R.Link(1.0, 1.0), R.Free())), jnp.ones(7))
    with pytest.raises(ValueError, match="need a direction"):
        R.Revolute([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="got no part"):
        R.assembly(SE3())
    flat = R.assembly(SE2(), arm=R.Part(R.Link(1.0, 1.0), R.Revolute()))
    broken = R.rollout(flat, jnp.array([jnp.nan]), jnp.zeros(1), step=1e-3, saves=1)
    assert broken.status == Status.not_finite
