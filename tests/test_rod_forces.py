"""Forces on rods: points, threads, wrenches, fluids, laws; closed forms and derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R
from sorojax.math.lie import SE2, SE3

FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
T0 = jnp.zeros(())
ROUTES = (
    R.Straight([3e-3, 1e-3]),
    R.Converging([4e-3, 0.0], [1e-3, 1e-3], stop=0.7),
    R.Helical(3e-3, 1.5, 0.3),
    R.Routed(lambda s: jnp.stack([3e-3 * jnp.sin(s), 2e-3 * s**2])),
)


def size(value):
    return float(jnp.abs(value).max())


@pytest.fixture(scope="module")
def general():
    """A rod with every kind of strain, its motion, and the same as a function of q."""
    basis = R.chebyshev(kappa_x=2, kappa_y=2, kappa_z=2, sigma_x=1, sigma_y=1)
    rest = [3.0, -5.0, 4.0, 1.05, 0.1, -0.05]
    rod = R.rod(SE3(), basis, R.circle(6e-3), rest_strain=rest, nodes=14, **FINGER)
    rng = np.random.default_rng(0)
    q = jnp.array(rng.normal(size=8) * np.array([5.0] * 6 + [0.05] * 2))
    v = jnp.array(rng.normal(size=8))
    return rod, q, v, eqx.filter_jit(R.motion)(rod, q, v)


@pytest.fixture(scope="module")
def arc():
    return R.rod(SE2(), R.constant("kappa_z"), R.circle(6e-3), nodes=8, **FINGER)


def bending(rod):
    return rod.material.young_modulus * rod.section.second_moment_z


# Points


def test_points_agree_with_the_kinematics_of_the_rod(general):
    rod, q, v, motion = general
    s = np.linspace(0, 1, 4)
    at = R.points(motion, s)
    poses, jacobian = R.forward_kinematics(rod, q, s), R.jacobian(rod, q, s)
    assert size(at.position - poses[:, :3, 3]) < 1e-15
    assert size(at.directors - poses[:, :3, :3]) < 1e-14
    assert size(at.linear_jacobian - jacobian[:, 3:]) < 1e-15
    assert size(at.velocity - jacobian[:, 3:] @ v) < 1e-15
    assert size(at.spin - jacobian[:, :3] @ v) < 1e-14
    rng = np.random.default_rng(1)
    force, moment = (jnp.array(rng.normal(size=(4, 3))) for _ in range(2))
    loads = jnp.concatenate([moment, force], axis=1)
    expected = jnp.einsum("pi,pin->n", loads, jacobian)
    assert size(at.generalised(force, moment) - expected) < 1e-13


# Threads


def test_a_length_is_that_of_the_curve_in_space(general):
    rod, q, _, motion = general
    for route, length in zip(ROUTES, R.thread_lengths(rod, ROUTES, q), strict=True):
        s = np.linspace(route.start, route.stop, 4001)
        at, place = R.points(motion, s), jax.vmap(route.offset)(jnp.asarray(s))
        curve = at.position + jnp.einsum("pij,pj->pi", at.directors[:, :, 1:], place)
        chords = jnp.sum(jnp.linalg.norm(jnp.diff(curve, axis=0), axis=1))
        assert abs(float(length - chords)) < 1e-6 * float(length)


def test_forces_of_threads_are_slopes_of_lengths_and_volumes(general):
    rod, q, v, motion = general
    slope = eqx.filter_jit(jax.jacfwd(lambda q: R.thread_lengths(rod, ROUTES, q)))(q)
    tension = jnp.array([1.0, 2.0, 3.0, 4.0])
    force = R.Tendons(ROUTES, tension)(T0, motion)
    assert size(force + slope.T @ tension) < 1e-10 * size(force)
    assert size(R.thread_rates(rod, ROUTES, q, v) - slope @ v) < 1e-15
    chambers = R.thread_chambers(rod, ROUTES, 1e-6 * tension)
    pushed = R.Pressurised(chambers, jnp.full(4, 1e5))(T0, motion)
    assert chambers.ports == (4,)
    assert size(pushed - 0.1 * slope.T @ tension) < 1e-10 * size(pushed)
    timed = R.Tendons(ROUTES, lambda t: t * tension)(jnp.array(2.0), motion)
    assert size(timed - 2 * force) < 1e-15


def test_a_straight_tendon_bends_to_constant_curvature(arc):
    rest = R.equilibrium(arc, (R.Tendons(R.Straight([3e-3, 0.0]), 2.0),))
    assert jnp.allclose(rest.q, 2 * 3e-3 / bending(arc), rtol=1e-12, atol=0)


def test_friction_takes_tension_as_on_a_capstan(arc):
    curvature, mu = 20.0, 0.3
    motion = R.motion(arc, jnp.array([curvature]))
    force = R.Tendons(R.Straight([3e-3, 0.0]), 2.0, mu)(T0, motion)
    turn = mu * curvature * 0.08
    expected = 2 * 3e-3 * 0.08 * (1 - np.exp(-turn)) / turn
    assert jnp.allclose(force, expected, rtol=1e-10, atol=0)
    slope = jax.grad(lambda q: R.Tendons(ROUTES[:1], 2.0, mu)(T0, R.motion(arc, q)).sum())(
        jnp.zeros(1)
    )
    assert jnp.all(jnp.isfinite(slope))


def test_routing_is_differentiable(arc):
    def turn(depth):
        route = R.Straight(jnp.stack([depth, 0 * depth]))
        return R.equilibrium(arc, (R.Tendons(route, 2.0),)).q[0]

    assert jnp.isclose(jax.grad(turn)(jnp.array(3e-3)), 2.0 / bending(arc), rtol=1e-9)


# Wrenches, fluids, laws, maps


def test_wrenches_dead_and_follower(general):
    rod, q, v, motion = general
    wrench = jnp.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert size(R.PointWrench(wrench)(T0, motion) - R.TipWrench(wrench)(T0, motion)) < 1e-13
    pose = R.forward_kinematics(rod, q, [0.3])[0, :3, :3]
    turned = jnp.concatenate([pose @ wrench[:3], pose @ wrench[3:]])
    follower = R.PointWrench(wrench, 0.3, follower=True)(T0, motion)
    assert size(follower - R.PointWrench(turned, 0.3)(T0, motion)) < 1e-13
    weight = motion.operators.mass.sum() / rod.length * -9.81
    line = R.LineWrench(jnp.zeros(6).at[5].set(weight))(T0, motion)
    assert size(line - R.Gravity()(T0, motion)) < 1e-15
    same = R.LineWrench(lambda s: jnp.zeros(6).at[5].set(weight) + 0 * s)(T0, motion)
    assert size(line - same) < 1e-16


def test_a_fluid_carries_and_brakes(general):
    rod, q, v, motion = general
    floating = R.Buoyancy(1000.0)(T0, motion)
    assert size(floating + R.Gravity()(T0, motion) / 2) < 1e-16
    drag = R.Drag(1000.0, 12e-3, viscous=0.1)
    assert float(drag(T0, motion) @ v) < 0
    carried = R.Drag(1000.0, 12e-3, flow=[0.0, 0.0, 0.0])(T0, R.motion(rod, q))
    assert size(carried) == 0
    slope = jax.jacfwd(lambda v: drag(T0, R.motion(rod, q, v)))(0 * v)
    assert jnp.all(jnp.linalg.eigvalsh((slope + slope.T) / 2) < 1e-15)


def test_drag_of_a_cylinder_in_a_cross_flow(arc):
    motion, flow = R.motion(arc, jnp.zeros(1)), 0.7
    force = R.Drag(1000.0, 12e-3, flow=[0.0, flow])(T0, motion)
    # Uniform load p on a clamped straight rod: p L^3 / 6 about constant curvature.
    load = 1000.0 * 12e-3 * 1.1 * flow**2 / 2
    assert jnp.allclose(force, load * 0.08**3 / 6, rtol=1e-12, atol=0)


def test_a_section_law_replaces_the_linear_one(general):
    rod, q, _, motion = general
    stiffness = R.stiffness_matrix(rod)
    names = ("kappa_x", "kappa_y", "kappa_z", "sigma_x", "sigma_y", "sigma_z")
    young, shear = 1e6, 1e6 / 2.6
    s = rod.section
    moments = [shear * s.torsion_constant, young * s.second_moment_y, young * s.second_moment_z]
    forces = [young * s.area, *[shear * s.shear_factor * s.area] * 2]
    scale = jnp.stack([*moments, *forces])
    assert len(names) == scale.shape[0]
    linear = R.section_law(rod, lambda strain, s: scale * strain)
    assert size(linear(T0, motion) + stiffness @ q) < 1e-13 * size(stiffness @ q)
    hard = R.section_law(rod, R.EnergyLaw(lambda e, s: (1 + s) * jnp.sum(scale * e**2) / 2))
    assert size(hard(T0, motion)) > 1.2 * size(linear(T0, motion))
    tangent = R.loads.tangent_stiffness((hard,), motion)
    assert size(tangent - tangent.T) < 1e-12 * size(tangent)


def test_an_input_map_acts(arc):
    motion = R.motion(arc, jnp.array([2.0]))
    force = R.Actuation(lambda q: jnp.outer(q, jnp.array([1.0, 3.0])), [0.5, 1.0])
    assert jnp.allclose(force(T0, motion), 7.0)


def test_messages_name_the_remedy(arc):
    motion = R.motion(arc, jnp.zeros(1))
    with pytest.raises(ValueError, match="0 <= start < stop <= 1"):
        R.Straight([1e-3, 0.0], start=0.5, stop=0.2)
    with pytest.raises(ValueError, match="one tension per routing"):
        R.Tendons(ROUTES, [1.0])(T0, motion)
    with pytest.raises(ValueError, match="one area per routing"):
        R.thread_chambers(arc, ROUTES, [1e-6])
    with pytest.raises(ValueError, match=r"m_z, f_x, f_y"):
        R.PointWrench(jnp.zeros(6))(T0, motion)
    with pytest.raises(ValueError, match="one row per coordinate"):
        R.Actuation(lambda q: jnp.ones((2, 1)), [1.0])(T0, motion)
