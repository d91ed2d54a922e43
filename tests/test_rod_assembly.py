"""Assemblies: invariants, closed forms, coherence with single rods, motion, bad input."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import replace, rod as R
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.status import Status
from sorojax.math.steppers import (
    DormandPrince,
    GeneralisedAlpha,
    ImplicitMidpoint,
    RungeKutta4,
    TripleJump,
)
from sorojax.rod.assembly import rate, retract

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
    """A floating palm, two equal fingers on joints, a rigid tip on a slide."""
    inertia = jnp.array([[3e-6, 1e-7, 0], [1e-7, 5e-6, 2e-7], [0, 2e-7, 4e-6]])
    link = R.Link(0.02, inertia, [0.005, 0.002, -0.003])
    rod = bent()
    model = R.assembly(
        SE3(),
        palm=R.Part(link, R.Free()),
        thumb=R.Part(rod, R.Revolute([1.0, 2.0, 3.0], stiffness=0.1), on="palm"),
        index=R.Part(rod, on="thumb", s=0.6, offset=pose(0.01, 0.02, 0.4)),
        tip=R.Part(link, R.Prismatic([0.0, 1.0, 1.0]), on="index", offset=pose(0, 0.01, 1)),
    )
    rng = np.random.default_rng(0)
    scale = np.concatenate([[0.5] * 7, [6.0] * 3, [0.05], [6.0] * 3, [0.05], [0.01]])
    moved, v = (jnp.array(k * scale * rng.normal(size=16)) for k in (1, 5))
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
    found["inverse"] = R.inverse_dynamics(model, q, v, R.forward_dynamics(model, q, v))
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


def test_inverse_dynamics_undoes_forward_dynamics(found):
    scale = jnp.abs(found["coriolis"]).max()
    assert jnp.abs(found["inverse"]).max() < 1e-9 * scale


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


def test_planar_assembly_is_the_spatial_one_restricted():
    basis = R.chebyshev(kappa_z=2, sigma_y=1)
    models = []
    for group, spin in ((SE2(), 4e-6), (SE3(), [2e-6, 3e-6, 4e-6])):
        rod = R.rod(group, basis, DISC, **FINGER)
        link = R.Link(0.02, spin, [0.01, 0.02, 0.0][: group.space_dim])
        turn = jnp.eye(group.space_dim).at[:2, :2].set(jnp.array([[0.8, -0.6], [0.6, 0.8]]))
        offset = homogeneous(turn, jnp.array([0.01, -0.02, 0.0])[: group.space_dim])
        models.append(
            R.assembly(
                group,
                root=R.Part(rod, R.Revolute(), offset=offset),
                body=R.Part(link, R.Prismatic(), on="root"),
                end=R.Part(rod, on="body", offset=offset),
            )
        )
    rng = np.random.default_rng(2)
    scale = jnp.array([1.0, 9, 9, 0.05, 0.02, 9, 9, 0.05])
    q, v = (scale * jnp.array(k * rng.normal(size=8)) for k in (1, 5))
    flat, full = (R.mass_matrix(model, q) for model in models)
    assert relative(flat, full) < 1e-12
    down = jnp.array([2.0, -9.81]), jnp.array([2.0, -9.81, 0.0])
    flat, full = (R.bias_force(m, q, v, g) for m, g in zip(models, down, strict=True))
    assert relative(flat, full) < 1e-11
    flat, full = (R.jacobian_rate_product(m, q, v, AT)["end"] for m in models)
    assert relative(flat, full[:, jnp.array([2, 3, 4])]) < 1e-11
    flat, full = (R.momentum(m, q, v) for m in models)
    assert relative(flat, full[jnp.array([2, 3, 4])]) < 1e-12


# Motion


@pytest.fixture(scope="module")
def flying():
    """A bent rod thrown with a spin; nothing acts on it."""
    model = R.assembly(SE3(), rod=R.Part(bent(), R.Free()))
    v = jnp.array([30.0, -20.0, 40.0, 1.0, -0.5, 2.0, 100.0, -80.0, 150.0, 0.1])
    return model, R.rest(model).at[7:].set(jnp.array([6.0, -5.0, 8.0, 0.02])), v


@pytest.mark.parametrize(
    "stepper, error, kept",
    [
        (GeneralisedAlpha(1.0), 2e-3, 1e-2),
        (ImplicitMidpoint(), 2e-3, 1e-3),
        (TripleJump(), 1e-5, 1e-5),
        (RungeKutta4(), 1e-6, 1e-7),
        (DormandPrince(), 1e-8, 1e-8),
    ],
)
def test_a_thrown_rod_keeps_its_momentum(flying, stepper, error, kept):
    model, q, v = flying
    path = R.rollout(model, q, v, step=1e-4, saves=1, every=100, stepper=stepper, unroll=False)
    assert path.status == Status.successful
    assert jnp.isclose(jnp.linalg.norm(path.q[-1, :4]), 1.0, rtol=0, atol=1e-14)
    assert relative(path.q[-1], tight(model, q, v)) < error
    before, after = (R.momentum(model, q, v) for q, v in zip(path.q, path.v, strict=True))
    for part in (slice(3), slice(3, 6)):
        assert relative(after[part], before[part]) < kept


REFERENCES = {}


def tight(model, q, v):
    """End of the throw by a solver of diffrax."""
    if not REFERENCES:
        term = dfx.ODETerm(R.vector_field(model))
        control = dfx.PIDController(rtol=1e-11, atol=1e-11)
        solution = dfx.diffeqsolve(
            term, dfx.Dopri8(), 0.0, 0.01, 1e-4, (q, v), stepsize_controller=control,
            max_steps=10_000,
        )  # fmt: skip
        REFERENCES["q"] = solution.ys[0][0]
    return REFERENCES["q"]


def test_dynamics_are_differentiable_at_rest():
    model = R.assembly(SE3(), rod=R.Part(bent(), R.Free()))
    q, zero = R.rest(model), jnp.zeros(10)

    def fall(step):
        return R.forward_dynamics(model, retract(model, q, step), zero, (R.Gravity(),))

    step = jnp.full(10, 1e-5)
    slope = jax.jit(jax.jacrev(fall))(zero)
    difference = fall(step) - fall(-step)
    assert jnp.abs(slope @ (2 * step) - difference).max() < 1e-7 * jnp.abs(fall(zero)).max()


# Forces


def test_forces_act_on_the_parts_that_they_name(hand):
    model, q, v = hand
    zero = jnp.zeros(())
    moment = R.motion(model, q, v)
    wrench = jnp.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])
    tips = R.jacobian(model, q, [1.0])

    @eqx.filter_jit
    def total(forces):
        return R.total_force(forces, zero, moment)

    idle = total(())
    for name in ("index", "palm"):
        force = total((R.On(name, R.TipWrench(wrench)),)) - idle
        assert relative(force, wrench @ tips[name][0]) < 1e-11
    damping = R.damping_matrix(model, (R.Damping(0.02), R.On("index", R.Damping(0.01))))
    every = (R.Damping(0.02), R.On("index", R.Damping(0.01)))
    assert relative(total(every) - idle, -damping @ v) < 1e-10
    pushed = total((R.JointEffort("tip", [3.0]),)) - idle
    assert jnp.allclose(pushed, jnp.zeros(16).at[-1].set(3.0), rtol=0, atol=1e-12)
    weight = total((R.Gravity(DOWN),)) - idle
    assert relative(weight, -R.gravity_force(model, q, DOWN)) < 1e-12


class Spring(R.AbstractPairForce):
    """Pulls two parts together."""

    def __call__(self, t, first, second):
        stretch = second.position[0] - first.position[0]
        pair = (first.linear_jacobian[0], second.linear_jacobian[0])
        return stretch @ pair[0], -stretch @ pair[1]


def test_pair_forces_pull_against_each_other(hand):
    model, q, _ = hand
    zero = jnp.zeros(())

    def energy(step):
        moment = R.motion(model, retract(model, q, step))
        ends = [R.part_motion(moment, k).position[0] for k in (0, 2)]
        return jnp.sum((ends[1] - ends[0]) ** 2) / 2

    moment = R.motion(model, q)
    spring = (R.Between("palm", "index", Spring()),)
    force = R.total_force(spring, zero, moment) - R.total_force((), zero, moment)
    assert relative(force, -jax.jit(jax.grad(energy))(jnp.zeros(16))) < 1e-10


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
        R.mass_matrix(model, jnp.zeros(16))
    with pytest.raises(ValueError, match="three moments"):
        R.mass_matrix(R.assembly(SE3(), a=R.Part(R.Link(1.0, 1.0), R.Free())), jnp.ones(7))
    with pytest.raises(ValueError, match="need a direction"):
        R.Revolute([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="got no part"):
        R.assembly(SE3())
    broken = R.rollout(model, q * jnp.nan, v, step=1e-3, saves=1, unroll=False)
    assert broken.status == Status.not_finite
