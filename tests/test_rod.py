"""Rods: closed forms, invariants, derivatives, coherence, cost, bad input."""

import dataclasses
import inspect

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import replace, rod as R
from sorojax.math.lie import SE2, SE3
from sorojax.math.ode.steppers import (
    DormandPrince,
    GeneralisedAlpha,
    ImplicitMidpoint,
    TripleJump,
)
from sorojax.math.quadrature import gauss_legendre
from sorojax.math.status import Status
from sorojax.rod.model.basis import SampledModes

pytestmark = pytest.mark.quick

FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
DISC = R.circle(6e-3, shear_factor=27 / 28)


def finger(**options):
    return R.rod(SE3(), R.chebyshev(kappa_y=3, kappa_z=3), DISC, **FINGER, **options)


def planar(basis=None, **options):
    basis = R.chebyshev(kappa_z=3) if basis is None else basis
    return R.rod(SE2(), basis, DISC, **FINGER, **options)


def drawn_state(dof=6):
    rng = np.random.default_rng(0)
    return jnp.array(rng.normal(size=dof) * 5.0), jnp.array(rng.normal(size=dof) * 20.0)


def relative(value, reference):
    return float(jnp.abs(value - reference).max() / jnp.abs(reference).max())


# Closed forms


@pytest.mark.versions
def test_constant_curvature_is_a_circular_arc():
    curvature, s = 30.0, jnp.array([0.3, 1.0])
    rod = planar(R.constant("kappa_z"), nodes=16)
    poses = R.forward_kinematics(rod, jnp.array([curvature]), s)
    angle = curvature * s * 0.08
    arc = jnp.stack([jnp.sin(angle), 1 - jnp.cos(angle)], axis=1) / curvature
    assert jnp.allclose(poses[:, :2, 2], arc, rtol=0, atol=1e-13)
    assert jnp.allclose(poses[:, 0, 0], jnp.cos(angle), rtol=0, atol=1e-13)


def test_an_end_moment_rolls_the_rod_up():
    rod = planar(nodes=20)
    bending = float(rod.material.young_modulus * rod.section.second_moment_z)
    moment = 2 * np.pi * bending / 0.08
    rest = R.equilibrium(rod, (R.TipWrench([moment, 0.0, 0.0]),))
    assert rest.status == Status.successful
    tip = R.tip_pose(rod, rest.q)
    assert jnp.allclose(tip[:2, 2] / 0.08, 0.0, rtol=0, atol=1e-8)
    assert jnp.isclose(R.tip_angle(R.motion(rod, rest.q)), 2 * np.pi, rtol=1e-12)


@pytest.mark.parametrize(
    "alpha, tip, error",
    [
        (1.0, (0.943566763717, 0.301720773800), 1e-8),
        (10.0, (0.445004402246, 0.810609024880), 2e-5),
    ],
)
def test_elastica(alpha, tip, error):
    rod = planar(R.chebyshev(kappa_z=5), nodes=10)
    load = alpha * rod.material.young_modulus * rod.section.second_moment_z / 0.08**2
    rest = R.equilibrium(rod, (R.TipWrench([0.0, 0.0, float(load)]),))
    assert jnp.linalg.norm(R.tip_pose(rod, rest.q)[:2, 2] / 0.08 - jnp.array(tip)) < error


def test_bending_frequencies_of_a_cantilever():
    # Rotary inertia of a vanishing second moment: Euler-Bernoulli.
    rod = planar(R.chebyshev(kappa_z=4), nodes=12)
    thin = replace(rod, lambda r: r.section.second_moment_z, 1e-9 * float(DISC.second_moment_z))
    mass = R.mass_matrix(thin, jnp.zeros(4))
    values = jnp.linalg.eigvals(jnp.linalg.solve(mass, R.stiffness_matrix(rod)))
    material, section = rod.material, rod.section
    unit = material.density * section.area / (material.young_modulus * section.second_moment_z)
    found = jnp.sort(jnp.sqrt(values.real * unit) * 0.08**2)
    reference = jnp.array([3.516021, 22.1578, 63.35])
    assert jnp.allclose(found[:3], reference, rtol=1e-4, atol=0)


def test_eight_nodes_resolve_the_inertia_of_three_modes():
    q, v = drawn_state()
    few, many = finger(nodes=8), finger(nodes=32)
    assert relative(R.mass_matrix(few, q), R.mass_matrix(many, q)) < 1e-9
    assert relative(R.bias_force(few, q, v), R.bias_force(many, q, v)) < 1e-9


# Invariants


@pytest.fixture(scope="module")
def general():
    basis = R.chebyshev(kappa_x=2, kappa_y=1, kappa_z=1, sigma_x=1, sigma_y=1, sigma_z=1)
    rest = [3.0, -5.0, 4.0, 1.05, 0.1, -0.05]
    section = dataclasses.replace(
        R.rectangle(8e-3, 14e-3), mass_offset_y=1.5e-3, mass_offset_z=-1e-3
    )
    rod = R.rod(SE3(), basis, section, rest_strain=rest, nodes=20, **FINGER)
    rng = np.random.default_rng(1)
    scale = np.array([8.0] * 4 + [0.1] * 3)
    return rod, jnp.array(rng.normal(size=7) * scale), jnp.array(5 * rng.normal(size=7) * scale)


def test_mass_is_symmetric_positive_and_coriolis_follows_from_it(general):
    rod, q, v = general

    @jax.jit
    def verbs(q, v):
        mass, rate = jax.jvp(lambda q: R.mass_matrix(rod, q), (q,), (v,))
        lagrange = rate @ v - jax.grad(lambda q: R.kinetic_energy(rod, q, v))(q)
        return mass, lagrange, R.coriolis_force(rod, q, v)

    mass, lagrange, coriolis = verbs(q, v)
    assert relative(mass, mass.T) < 1e-13 and jnp.linalg.eigvalsh(mass)[0] > 0
    assert relative(coriolis, lagrange) < 1e-10


def test_coriolis_matrix_makes_the_force_and_the_rate_of_the_mass(general):
    rod, q, v = general

    @jax.jit
    def along(q, v):
        _, rate = jax.jvp(lambda q: R.mass_matrix(rod, q), (q,), (v,))
        _, turning = jax.jvp(lambda q: R.jacobian(rod, q, [0.3, 1.0]), (q,), (v,))
        product = R.jacobian_rate_product(rod, q, v, [0.3, 1.0])
        return R.coriolis_matrix(rod, q, v), rate, turning @ v, product

    matrix, rate, exact, product = along(q, v)
    assert relative(matrix @ v, R.coriolis_force(rod, q, v)) < 1e-10
    assert (
        jnp.abs(rate - 2 * matrix + (rate - 2 * matrix).T).max() < 1e-12 * jnp.abs(rate).max()
    )
    assert relative(product, exact) < 1e-10


def test_momentum_of_a_clamped_rod_is_the_impulse_of_its_clamp(general):
    # A clamped rod is a free one whose base stands still.
    rod, q, v = general
    free = R.assembly(SE3(), rod=R.Part(rod, R.Free()))
    still = jnp.zeros(6)
    place = jnp.concatenate([R.rest(free)[:7], q])
    rates = jnp.concatenate([still, v])
    momentum = R.momentum(rod, q, v)
    assert relative((R.mass_matrix(free, place) @ rates)[:6], momentum) < 1e-12
    assert relative(R.mass_matrix(free, place)[6:, 6:], R.mass_matrix(rod, q)) < 1e-14


def test_mass_beside_the_axis_moves_with_the_section(general):
    flat = planar(nodes=9)
    offset = dataclasses.replace(flat.section, mass_offset_y=1.2e-3)
    flat = dataclasses.replace(flat, section=offset)
    for body, q, v in (general, (flat, general[1][:3], general[2][:3])):
        dim, section = body.group.space_dim, body.section
        s, weights = (jnp.asarray(x) for x in gauss_legendre(body.quadrature))
        offsets = [0.0, section.mass_offset_y, section.mass_offset_z][:dim]
        point = jnp.array([*offsets, 1.0])

        def places(q, body=body, s=s, point=point, dim=dim):
            poses = R.forward_kinematics(body, q, s)
            return (poses @ point)[:, :dim], poses[:, :dim, :dim]

        (_, turn), (velocity, turning) = jax.jvp(places, (q,), (v,))
        spin = jnp.swapaxes(turn, 1, 2) @ turning
        area, about_y, about_z = section.area, section.second_moment_y, section.second_moment_z
        about_z = about_z - area * section.mass_offset_y**2
        rates = spin[:, 1, 0] ** 2 * about_z
        if dim == 3:
            about_y = about_y - area * section.mass_offset_z**2
            rates = (
                rates + spin[:, 2, 0] ** 2 * about_y + spin[:, 2, 1] ** 2 * (about_y + about_z)
            )
        lines = area * jnp.sum(velocity**2, axis=1) + rates
        exact = body.material.density * body.length * (weights @ lines) / 2
        assert relative(R.kinetic_energy(body, q, v), exact) < 1e-10  # 20 nodes: 4.7e-11
    with pytest.raises(ValueError, match="mass cannot lie further away"):
        R.Section(1e-4, 1e-9, 1e-9, 2e-9, mass_offset_y=4e-3)


def test_gravity_is_the_gradient_of_its_energy(general):
    rod, q, _ = general
    g = jnp.array([1.0, 2.0, -9.81])
    total = jax.grad(lambda q: R.potential_energy(rod, q, g))(q)
    force = R.gravity_force(rod, q, g) + R.elastic_force(rod, q)
    assert relative(force, total) < 1e-11


def test_jacobian_is_the_derivative_of_the_pose(general):
    rod, q, _ = general
    s = jnp.array([0.3, 1.0])

    @jax.jit
    def verbs(q):
        rate = jax.jacfwd(lambda q: R.forward_kinematics(rod, q, s))(q)
        return rate, R.jacobian(rod, q, s), R.forward_kinematics(rod, q, s)

    rate, found, poses = verbs(q)
    assert relative(found[:, 3:], rate[:, :3, 3]) < 1e-11
    turn = poses[:, :3, :3]
    spin = jnp.einsum("pijn,pkj->pikn", rate[:, :3, :3], turn)
    angular = jnp.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    assert relative(found[:, :3], angular) < 1e-11


def test_energy_is_conserved_without_damping():
    rod, g = planar(), jnp.array([0.0, -9.81])
    path = R.rollout(
        rod,
        jnp.zeros(3),
        jnp.zeros(3),
        (R.Gravity(),),
        step=2.5e-4,
        saves=20,
        every=200,
        stepper=DormandPrince(),
    )
    total = jax.vmap(lambda q, v: R.kinetic_energy(rod, q, v) + R.potential_energy(rod, q, g))(
        path.q, path.v
    )
    elastic = jax.vmap(lambda q: R.potential_energy(rod, q))(path.q)
    assert jnp.abs(total - total[0]).max() < 1e-6 * elastic.max()


@pytest.mark.parametrize(
    "stepper, step, error",
    [
        (GeneralisedAlpha(), 1e-3, 2e-5),
        (ImplicitMidpoint(), 1e-3, 2e-5),
        (TripleJump(), 5e-3, 2e-5),
        (DormandPrince(), 2.5e-4, 3e-7),
    ],
)
def test_steppers_reach_the_reference_motion(stepper, step, error):
    # The spatial finger of the reference bends in one plane.
    path = R.rollout(
        planar(),
        jnp.zeros(3),
        jnp.zeros(3),
        (R.Gravity(), R.Damping(0.01)),
        step=step,
        saves=5,
        every=round(0.1 / step),
        stepper=stepper,
    )
    tip = R.tip_pose(planar(), path.q[-1])[:2, 2]
    reference = jnp.array([7.917524e-2, -1.071715e-2])
    assert path.status == Status.successful
    assert jnp.linalg.norm(tip - reference) < error * 0.08


@pytest.mark.versions
def test_any_solver_of_diffrax_moves_the_rod():
    rod, rest = planar(), jnp.zeros(3)
    term = dfx.ODETerm(R.vector_field(rod, (R.Gravity(), R.Damping(0.01))))
    solution = dfx.diffeqsolve(
        term,
        dfx.Tsit5(),
        0.0,
        0.5,
        1e-4,
        (rest, rest),
        max_steps=100_000,
        stepsize_controller=dfx.PIDController(rtol=1e-7, atol=1e-7),
    )
    assert solution.ys is not None
    tip = R.tip_pose(rod, solution.ys[0][0])[:2, 2]
    assert jnp.linalg.norm(tip - jnp.array([7.917524e-2, -1.071715e-2])) < 1e-6 * 0.08


# Derivatives


@pytest.mark.parametrize("jacobian", [jax.jacfwd, jax.jacrev])
def test_dynamics_are_differentiable_in_the_straight_rod(jacobian):
    rod, zero = finger(), jnp.zeros(6)
    slope = jacobian(lambda q: R.forward_dynamics(rod, q, zero, (R.Gravity(),)))(zero)
    near = jnp.full(6, 1e-3)
    ahead = R.forward_dynamics(rod, near, zero, (R.Gravity(),))
    behind = R.forward_dynamics(rod, -near, zero, (R.Gravity(),))
    assert relative(slope @ (2 * near), ahead - behind) < 1e-6


@pytest.mark.stress(5)
def test_second_derivatives_are_finite_in_the_straight_rod():
    rod, zero = finger(nodes=6), jnp.zeros(6)
    height = lambda q: R.tip_pose(rod, q)[2, 3]  # noqa: E731
    along = jnp.arange(1.0, 7.0)
    curve = jax.jit(lambda q: jax.jvp(jax.grad(height), (q,), (along,))[1])(zero)
    step = 1e-4
    slope = jax.jit(jax.grad(height))
    difference = (slope(step * along) - slope(-step * along)) / (2 * step)
    assert jnp.isfinite(curve).all()
    assert jnp.abs(curve - difference).max() < 1e-6 * jnp.abs(slope(zero)).max()


@pytest.mark.stress(51)
def test_single_precision_keeps_its_digits():
    """Solving M a = f in floating-point numbers errs by a multiple of eps cond(D M D), D the
    inverse roots of M's diagonal (Higham, Accuracy and Stability, 2002, theorem 10.4), which
    also bounds what the sums in M cost, as |M_ij| of sums of products is at most the root of
    M_ii M_jj. In 1000 states the error is at most 0.93 times that, with 16 nodes 0.98 times,
    with SSE4.2, AVX2 and AVX-512, of JAX 0.10 and 0.12. More than three times that holds."""
    wide, eps = finger(), float(jnp.finfo(jnp.float32).eps)
    narrow = jax.tree.map(lambda x: x.astype(jnp.float32), wide)
    rng = np.random.default_rng(0)
    for _ in range(8):
        q, v = jnp.array(rng.normal(size=6) * 5.0), jnp.array(rng.normal(size=6) * 20.0)
        q32, v32 = q.astype(jnp.float32), v.astype(jnp.float32)
        a = R.forward_dynamics(narrow, q32, v32, (R.Gravity(),), t=jnp.float32(0))
        assert a.dtype == jnp.float32
        mass = np.asarray(R.mass_matrix(wide, q))
        size = np.sqrt(np.diag(mass))
        bound = 4 * eps * np.linalg.cond(mass / np.outer(size, size))
        exact = R.forward_dynamics(wide, q, v, (R.Gravity(),))
        assert relative(a.astype(q.dtype), exact) < bound < 8e-4
        found = R.mass_matrix(narrow, q32).astype(q.dtype)
        assert relative(found, mass) < 2e-6


@pytest.mark.versions
def test_equilibrium_is_differentiable_in_every_number():
    rod = planar()

    def tip(young):
        soft = replace(rod, lambda r: r.material.young_modulus, young)
        return R.tip_pose(soft, R.equilibrium(soft, (R.Gravity(),)).q)[1, 2]

    slope = jax.grad(tip)(jnp.array(1e6))
    difference = (tip(jnp.array(1.001e6)) - tip(jnp.array(0.999e6))) / 2e3
    assert jnp.isclose(slope, difference, rtol=1e-5)


# Coherence and transformations


def test_planar_rod_is_the_spatial_one_restricted():
    basis = R.chebyshev(kappa_z=3, sigma_x=2, sigma_y=2)
    flat, full = (R.rod(group, basis, DISC, **FINGER) for group in (SE2(), SE3()))
    scale = jnp.array([1.0, 1, 1, 0.02, 0.02, 0.02, 0.02])
    q, v = (x * scale for x in drawn_state(7))
    assert relative(R.mass_matrix(flat, q), R.mass_matrix(full, q)) < 1e-12
    down2, down3 = jnp.array([0.0, -9.81]), jnp.array([0.0, -9.81, 0.0])
    assert relative(R.bias_force(flat, q, v, down2), R.bias_force(full, q, v, down3)) < 1e-12
    tips = [R.tip_pose(rod, q) for rod in (flat, full)]
    assert jnp.allclose(tips[0][:2, 2], tips[1][:2, 3], rtol=0, atol=1e-15)


def test_sampled_modes_reproduce_the_modes_they_sample():
    s = np.linspace(0, 1, 201)
    exact = R.chebyshev(kappa_z=3)
    sampled = R.StrainBasis({"kappa_z": SampledModes(s, exact(s)[0])})
    assert planar(sampled).nodes == 48
    q, v = drawn_state(3)
    smooth, broken = planar(nodes=24), planar(sampled, nodes=24)
    assert relative(R.mass_matrix(broken, q), R.mass_matrix(smooth, q)) < 1e-4
    assert relative(R.stiffness_matrix(broken), R.stiffness_matrix(smooth)) < 1e-3
    energy = jax.grad(lambda b: R.potential_energy(planar(b, nodes=24), q))(sampled)
    assert jnp.isfinite(energy.modes["kappa_z"].values).all()


@pytest.mark.versions
def test_batches_agree_with_single_calls():
    rods = eqx.filter_vmap(lambda length: replace(planar(), lambda r: r.length, length))(
        jnp.array([0.07, 0.09])
    )
    q, v = drawn_state(3)
    many = eqx.filter_vmap(R.forward_dynamics, in_axes=(0, None, None))(rods, q, v)
    long = replace(planar(), lambda r: r.length, 0.09)
    one = R.forward_dynamics(long, q, v)
    assert relative(many[1], one) < 1e-12
    states = jnp.linspace(0.5, 1.0, 70)[:, None]  # more than a chunk
    each = R.forward_dynamics(long, states * q[None], states * v[None])
    assert each.shape == (70, 3) and relative(each[-1], one) < 1e-12
    lanes = jnp.linspace(0.5, 1.0, 131)[:, None]
    rows = lanes * q[None], lanes * v[None]
    by_vmap = jax.vmap(lambda q, v: R.forward_dynamics(long, q, v))(*rows)
    assert relative(by_vmap, R.forward_dynamics(long, *rows)) < 1e-12


class Hardening(R.AbstractElastic):
    """A stand-in for an identified law."""

    slope: jax.Array

    def restoring_force(self, q):
        return self.slope * q + 1e-3 * self.slope * q**3


def test_an_elastic_term_replaces_the_law_of_the_rod():
    rod, q = planar(), jnp.array([5.0, -2.0, 1.0])
    law = Hardening(jnp.array(1e-3))
    with_law = R.forward_dynamics(rod, q, 0 * q, (law,))
    expected = -jnp.linalg.solve(R.mass_matrix(rod, q), law.restoring_force(q))
    assert relative(with_law, expected) < 1e-9
    text = str(jax.make_jaxpr(lambda q: R.total_force((law,), 0.0, R.motion(rod, q)))(q))
    assert "integer_pow" in text


# Cost


@pytest.mark.versions
def test_numbers_do_not_retrace_and_absent_forces_cost_nothing():
    rod, (q, v) = planar(), drawn_state(3)
    once = eqx.filter_jit(eqx.debug.assert_max_traces(R.mass_matrix, max_traces=1))
    for young in (1e6, 2e6, 3):
        once(replace(rod, lambda r: r.material.young_modulus, young), q)

    def operations(function, x):  # those of functions with rules of their own among them
        return len(jax.jit(function).lower(x).as_text().splitlines())

    def size(forces):
        plain = inspect.unwrap(R.forward_dynamics)
        return operations(lambda q: plain(rod, q, v, forces), q)

    def forces_only(forces):
        constants = R.operators(rod)
        moment = R.motion(rod, q, v, constants=constants)
        return operations(lambda t: R.total_force(forces, t, moment), 0.0)

    assert forces_only(()) < forces_only((R.Damping(0.1),)) < size(())
    assert size((R.Gravity(),)) > size(())


TRACES = []


class Clock(R.AbstractForce):
    """Counts how often it is traced."""

    def __call__(self, t, motion):
        TRACES.append(t)
        return 0 * motion.q * t


def test_time_and_points_do_not_retrace():
    rod, (q, v) = planar(), drawn_state(3)
    for t in (0.0, 0.5, 1.0):
        R.forward_dynamics(rod, q, v, (Clock(),), t=t)
    assert len(TRACES) == 1
    poses = [R.forward_kinematics(rod, q, [0.2, s]) for s in (0.5, 1.0)]
    assert jnp.array_equal(poses[0][0], poses[1][0])


# Bad input


def test_stiffness_and_mass_may_be_those_of_two_sections():
    """Each of a tapered rod is that of the rod with its section alone, and so are slopes."""
    thick = R.taper(R.circle, 9e-3, 5e-3)
    made = finger(mass_section=thick)
    heavy = R.rod(SE3(), R.chebyshev(kappa_y=3, kappa_z=3), thick, **FINGER)
    q, _ = drawn_state()
    assert jnp.array_equal(R.mass_matrix(made, q), R.mass_matrix(heavy, q))
    stiff, soft = R.operators(finger()), R.operators(made)
    assert jnp.array_equal(stiff.stiffness, soft.stiffness)

    def tip_mass(scale):
        return R.mass_matrix(finger(mass_section=R.scaled(DISC, scale)), q)[0, 0]

    grown = (tip_mass(1.001) - tip_mass(0.999)) / 0.002
    assert np.isclose(jax.grad(tip_mass)(1.0), grown, rtol=1e-5)
    with pytest.raises(ValueError, match="`area` has shape"):
        finger(mass_section=R.circle(np.ones(3)))


@pytest.mark.versions
def test_messages_name_the_remedy():
    with pytest.raises(ValueError, match="need one or more of kappa_x"):
        R.chebyshev(curvature=3)
    with pytest.raises(ValueError, match="Leave the strain out"):
        R.chebyshev(kappa_z=0)
    with pytest.raises(ValueError, match="use SE3"):
        planar(R.chebyshev(kappa_y=2))
    with pytest.raises(ValueError, match="poisson_ratio, density"):
        R.rod(SE2(), R.chebyshev(kappa_z=2), DISC, length=1.0, young_modulus=1e6)
    with pytest.raises(ValueError, match=r"need \(3\)"):
        R.mass_matrix(planar(), jnp.zeros(2))
    with pytest.raises(ValueError, match="must rise strictly"):
        SampledModes([0.0, 0.5, 0.5], np.zeros((3, 1)))
    with pytest.raises(ValueError, match="has 0.5"):
        R.Elastic(1e6, 0.7, 1000.0)
