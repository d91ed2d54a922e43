"""Assemblies: invariants, closed forms, coherence with single rods, motion, bad input."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import replace, rod as R, systems as S
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.status import Status
from sorojax.math.steppers import (
    DormandPrince,
    GeneralisedAlpha,
    ImplicitMidpoint,
    RungeKutta4,
    TripleJump,
    start,
)
from sorojax.rod.assembly import rate, retract
from sorojax.rod.rollout import second_order

FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
DISC = R.circle(6e-3, shear_factor=27 / 28)
DOWN = jnp.array([1.0, 2.0, -9.81])
AT = [0.3, 1.0]


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
    model = R.assembly(
        SE3(),
        palm=R.Part(link, R.Free()),
        finger=R.Part(bent(), hinge, on="palm", offset=pose(0.01, 0.02, 0.4)),
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
    flow = rate(model, q, v)
    verbs = {
        "mass": lambda q: R.mass_matrix(model, q),
        "jacobian": lambda q: R.jacobian(model, q, AT),
        "poses": lambda q: R.forward_kinematics(model, q, AT),
    }
    found = {}
    for name, verb in verbs.items():
        found[name], found[f"{name}_rate"] = jax.jvp(verb, (q,), (flow,))
    found["coriolis"] = R.coriolis_force(model, q, v)
    found["matrix"] = R.coriolis_matrix(model, q, v)
    found["product"] = R.jacobian_rate_product(model, q, v, AT)
    found["energy"] = R.kinetic_energy(model, q, v)
    found["momentum"] = R.momentum(model, q, v)
    found["weight"] = R.gravity_force(model, q, DOWN) + R.elastic_force(model, q)
    energy = lambda step: R.potential_energy(model, retract(model, q, step), DOWN)  # noqa: E731
    found["slope"] = jax.grad(energy)(jnp.zeros_like(v))
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


def test_gravity_and_springs_are_gradients_of_their_energy(found):
    assert relative(found["weight"], found["slope"]) < 1e-10


def test_momentum_is_that_of_the_floating_base(found, hand):
    # Rates of a free root: the linear ones see the linear momentum.
    model, q, v = hand
    assert relative(found["momentum"][3:], (found["mass"] @ v)[3:6]) < 1e-12
    about = (found["mass"] @ v)[:3] + jnp.cross(q[4:7], found["momentum"][3:])
    assert relative(found["momentum"][:3], about) < 1e-10
    assert jnp.isclose(found["energy"], v @ found["mass"] @ v / 2, rtol=1e-13)


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
    assert relative(R.mass_matrix(model, q), mass_matrix) < 1e-14
    assert relative(R.coriolis_force(model, q, v), coriolis) < 1e-13
    g = 9.81 * mass
    first, both = np.cos(0.3), np.cos(0.3 - 0.8)
    weight = g * jnp.array([(half + length) * first + half * both, half * both])
    assert relative(R.gravity_force(model, q), weight) < 1e-14


def test_constant_segments_end_to_end_are_one_piecewise_rod():
    whole = R.rod(SE3(), R.piecewise_constant(kappa_y=2, kappa_z=2), DISC, **FINGER)
    half = replace(
        R.rod(SE3(), R.constant("kappa_y", "kappa_z"), DISC, **FINGER), lambda r: r.length, 0.04
    )
    model, swap = R.serial(half, half), jnp.array([0, 2, 1, 3])
    q, v = jnp.array([8.0, -5.0, 6.0, 9.0]), jnp.array([20.0, -30.0, 10.0, 15.0])
    mass = R.mass_matrix(whole, q)
    assert relative(R.mass_matrix(model, q[swap]), mass[swap][:, swap]) < 1e-11
    bias = R.bias_force(whole, q, v)
    assert relative(R.bias_force(model, q[swap], v[swap]), bias[swap]) < 1e-11
    tip = R.tip_pose(model, q[swap])["segment_1"]
    assert jnp.allclose(tip, R.tip_pose(whole, q), rtol=0, atol=1e-12)


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
    a = R.forward_dynamics(model, q, v, (R.Gravity(down),))
    return {
        "mass": R.mass_matrix(model, q),
        "bias": R.bias_force(model, q, v, down),
        "product": R.jacobian_rate_product(model, q, v, AT)["end"],
        "momentum": R.momentum(model, q, v),
        "inverse": R.inverse_dynamics(model, q, v, a, (R.Gravity(down),)),
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
    for found in (flat, full):
        assert jnp.abs(found["inverse"]).max() < 1e-9 * jnp.abs(found["bias"]).max()


# Motion


@pytest.fixture(scope="module")
def thrown():
    """A tumbling body, and its motion by a solver of diffrax."""
    body = R.Link(0.3, [2e-3, 4e-3, 1e-3], [0.1, 0, 0])
    model = R.assembly(SE3(), body=R.Part(body, R.Free()))
    q, v = R.rest(model), jnp.array([3.0, -8.0, 5.0, 1.0, 2.0, -1.0])
    solution = dfx.diffeqsolve(
        dfx.ODETerm(R.vector_field(model)), dfx.Dopri8(), 0.0, 0.5, 1e-3, (q, v),
        stepsize_controller=dfx.PIDController(rtol=1e-12, atol=1e-12),
    )  # fmt: skip
    assert solution.ys is not None
    return model, q, v, solution.ys[0][0]


@pytest.mark.parametrize(
    "stepper, order",
    [
        (GeneralisedAlpha(1.0), 2),
        (ImplicitMidpoint(), 2),
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
    errors = [float(jnp.abs(state.q - end).max()) for state in (coarse, fine)]
    assert order - 0.4 < np.log2(errors[0] / errors[1]) < order + 1.3
    assert jnp.isclose(jnp.linalg.norm(fine.q[:4]), 1.0, rtol=0, atol=1e-14)


def test_a_thrown_rod_keeps_its_momentum():
    basis = R.chebyshev(kappa_y=1, kappa_z=2, sigma_x=1)
    rod = R.rod(SE3(), basis, DISC, nodes=10, **FINGER)
    model = R.assembly(SE3(), rod=R.Part(rod, R.Free()))
    v = jnp.array([30.0, -20.0, 40.0, 1.0, -0.5, 2.0, 100.0, -80.0, 150.0, 0.1])
    q = R.rest(model).at[7:].set(jnp.array([6.0, -5.0, 8.0, 0.02]))
    path = R.rollout(model, q, v, step=1e-4, saves=1, every=100, stepper=DormandPrince())
    assert path.status == Status.successful
    momenta = jax.vmap(lambda q, v: R.momentum(model, q, v))(path.q, path.v)
    assert relative(momenta[1, :3], momenta[0, :3]) < 1e-8
    assert relative(momenta[1, 3:], momenta[0, 3:]) < 1e-8


def test_dynamics_are_differentiable_at_rest():
    link = R.Link(0.02, [2e-6, 3e-6, 4e-6], [0.01, 0.0, 0.0])
    hinge = R.Part(link, R.Revolute(), on="base")
    model = R.assembly(SE3(), base=R.Part(link, R.Free()), arm=hinge)
    q, zero = R.rest(model), jnp.zeros(7)
    v = jnp.linspace(0.0, 2.0, 7)

    @jax.jit
    def fall(step):
        return R.forward_dynamics(model, retract(model, q, step), v, (R.Gravity(),))

    step = jnp.full(7, 1e-4)
    difference = fall(step) - fall(-step)
    for jacobian in (jax.jacfwd, jax.jacrev):
        slope = jax.jit(jacobian(fall))(zero)
        assert relative(slope @ (2 * step), difference) < 1e-6


# Forces


def test_forces_act_on_the_parts_that_they_name(hand):
    model, q, v = hand
    wrench = jnp.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])
    cases = {
        "idle": (),
        "finger": (R.On("finger", R.TipWrench(wrench)),),
        "palm": (R.On("palm", R.TipWrench(wrench)),),
        "damped": (R.Damping(0.02), R.On("finger", R.Damping(0.01))),
        "pushed": (R.JointEffort("nail", [3.0]),),
        "weight": (R.Gravity(DOWN),),
    }

    @jax.jit
    def totals(q):
        moment = R.motion(model, q, v)
        return {k: R.total_force(forces, q[0], moment) for k, forces in cases.items()}

    found = totals(q)
    tips = R.jacobian(model, q, [1.0])
    for name in ("finger", "palm"):
        assert relative(found[name] - found["idle"], wrench @ tips[name][0]) < 1e-10
    damping = R.damping_matrix(model, cases["damped"])
    assert relative(found["damped"] - found["idle"], -damping @ v) < 1e-9
    pushed = jnp.zeros(12).at[-1].set(3.0)
    assert jnp.allclose(found["pushed"] - found["idle"], pushed, rtol=0, atol=1e-10)
    weight = found["weight"] - found["idle"]
    assert relative(weight, -R.gravity_force(model, q, DOWN)) < 1e-9


class Spring(R.AbstractPairForce):
    """Pulls two parts together."""

    def __call__(self, t, first, second):
        stretch = second.position[0] - first.position[0]
        pair = (first.linear_jacobian[0], second.linear_jacobian[0])
        return stretch @ pair[0], -stretch @ pair[1]


def test_pair_forces_pull_against_each_other():
    model = tree(SE2())
    q = jnp.array([0.3, 5.0, -4.0, 0.02, 0.01, 3.0, 2.0, 0.03])

    @jax.jit
    def both(q):
        def energy(q):
            moment = R.motion(model, q)
            ends = [R.part_motion(moment, k).position[0] for k in (1, 2)]
            return jnp.sum((ends[1] - ends[0]) ** 2) / 2

        moment = R.motion(model, q)
        spring = (R.Between("body", "end", Spring()),)
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
    forces = (R.On("end", bellows), R.Damping(0.01))
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
        bound = (R.On("end", R.Pressurised(bellows, 2e3)), R.Damping(0.01))
        bound = (*bound, R.JointEffort("root", [0.01]))
        now = {**state, "body": {"q": q, "v": 0 * q}}
        rate = network.vector_field(0 * q[0], now)["body"]["v"]
        return rate, R.forward_dynamics(model, q, 0 * q, bound), S.outputs(network, q[0], now)

    found, expected, ports = both(q)
    assert relative(found, expected) < 1e-12
    assert jnp.isclose(ports["body.end_volume"], bellows.slope @ q[5:], rtol=1e-14)
    tip = R.tip_pose(model, q)["end"][:2, 2]
    assert jnp.allclose(ports["body.end_position"], tip, rtol=0, atol=1e-14)


# Bad input


def test_messages_name_the_remedy(hand):
    model, q, v = hand
    rod = bent()
    with pytest.raises(ValueError, match="List the carrier first"):
        R.assembly(SE3(), a=R.Part(rod, on="b"), b=R.Part(rod))
    with pytest.raises(ValueError, match="need SE2"):
        R.assembly(SE2(), a=R.Part(rod))
    with pytest.raises(ValueError, match=r"need a point of the rod in \[0, 1\]"):
        R.Part(rod, s=1.5)
    with pytest.raises(ValueError, match="Wrap it"):
        R.forward_dynamics(model, q, v, (R.TipWrench(jnp.zeros(6)),))
    with pytest.raises(ValueError, match="no part `thumbs`"):
        R.forward_dynamics(model, q, v, (R.On("thumbs", R.Gravity()),))
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
