"""Forces on rods: points, threads, wrenches, fluids, laws; closed forms and derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R
from sorojax.math.lie import SE2, SE3
from sorojax.rod.forces.loads import tangent_stiffness

FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
T0 = jnp.zeros(())
ROUTES = (
    R.Straight([3e-3, 1e-3]),
    R.Converging([4e-3, 0.0], [1e-3, 1e-3], stop=0.7),
    R.Helical(3e-3, 1.5, 0.3),
    R.Routed(lambda s: jnp.stack([3e-3 * jnp.sin(s), 2e-3 * s**2])),
)


def size(value):
    return float(np.abs(value).max())


motion_of = eqx.filter_jit(R.motion)


@eqx.filter_jit
def forces(motion, *every, t=T0):
    """Each of the forces at one moment, in one program."""
    return tuple(force(t, motion) for force in every)


@pytest.fixture(scope="module")
def general():
    """A rod with every kind of strain, and its motion."""
    basis = R.chebyshev(kappa_x=2, kappa_y=2, kappa_z=2, sigma_x=1, sigma_y=1)
    rest = [3.0, -5.0, 4.0, 1.05, 0.1, -0.05]
    rod = R.rod(SE3(), basis, R.circle(6e-3), rest_strain=rest, nodes=14, **FINGER)
    rng = np.random.default_rng(0)
    q = jnp.array(rng.normal(size=8) * np.array([5.0] * 6 + [0.05] * 2))
    v = jnp.array(rng.normal(size=8))
    return rod, q, v, motion_of(rod, q, v)


@pytest.fixture(scope="module")
def arc():
    return R.rod(SE2(), R.constant("kappa_z"), R.circle(6e-3), nodes=8, **FINGER)


def bent(rod, curvature):
    return motion_of(rod, jnp.full(1, curvature))


def bending(rod):
    return rod.material.young_modulus * rod.section.second_moment_z


# Points


def test_points_agree_with_the_kinematics_of_the_rod(general):
    rod, q, v, motion = general
    s = np.linspace(0, 1, 4)
    force, moment = np.random.default_rng(1).normal(size=(2, 4, 3))

    @jax.jit
    def found(motion):
        at = R.points(motion, s)
        fields = at.position, at.directors, at.linear_jacobian, at.velocity, at.spin
        return *fields, at.generalised(force, moment)

    @jax.jit
    def known(rod, q):
        return R.forward_kinematics(rod, q, s), R.jacobian(rod, q, s)

    poses, jacobian = map(np.asarray, known(rod, q))
    position, directors, linear, velocity, spin, total = found(motion)
    assert size(position - poses[:, :3, 3]) < 1e-15
    assert size(directors - poses[:, :3, :3]) < 1e-14
    assert size(linear - jacobian[:, 3:]) < 1e-15
    assert size(velocity - jacobian[:, 3:] @ np.asarray(v)) < 1e-15
    assert size(spin - jacobian[:, :3] @ np.asarray(v)) < 1e-14
    loads = np.concatenate([moment, force], axis=1)
    assert size(total - np.einsum("pi,pin->n", loads, jacobian)) < 1e-13


# Threads


def test_a_length_is_that_of_the_curve_in_space(general):
    rod, q, _, motion = general
    s = np.linspace([r.start for r in ROUTES], [r.stop for r in ROUTES], 4001)

    @jax.jit
    def curves(motion):
        at, pairs = R.points(motion, s.ravel()), zip(ROUTES, s.T, strict=True)
        place = [jax.vmap(r.offset)(jnp.asarray(own)) for r, own in pairs]
        return at.position, at.directors, jnp.stack(place, axis=1).reshape(-1, 2)

    position, directors, place = map(np.asarray, curves(motion))
    curve = position + np.einsum("pij,pj->pi", directors[:, :, 1:], place)
    steps = np.diff(curve.reshape(4001, -1, 3), axis=0)
    chords = np.sum(np.linalg.norm(steps, axis=2), axis=0)
    assert np.allclose(R.thread_lengths(rod, ROUTES, q), chords, rtol=1e-6, atol=0)


def test_forces_of_threads_are_slopes_of_lengths_and_volumes(general):
    rod, q, v, motion = general
    lengths = eqx.filter_jit(jax.jacfwd(lambda q: R.thread_lengths(rod, ROUTES, q)))
    slope, v = np.asarray(lengths(q)), np.asarray(v)
    tension = np.array([1.0, 2.0, 3.0, 4.0])
    assert size(R.thread_rates(rod, ROUTES, q, v) - slope @ v) < 1e-15
    chambers = R.thread_chambers(rod, ROUTES, 1e-6 * tension)
    assert chambers.ports == (4,)
    force, pushed, timed = forces(
        motion,
        R.Tendons(ROUTES, tension),
        R.Pressurised(chambers, np.full(4, 1e5)),
        R.Tendons(ROUTES, lambda t: t * tension),
        t=jnp.array(2.0),
    )
    assert size(force + slope.T @ tension) < 1e-10 * size(force)
    assert size(pushed - 0.1 * slope.T @ tension) < 1e-10 * size(pushed)
    assert size(timed - 2 * force) < 1e-15


def test_a_straight_tendon_bends_to_constant_curvature(arc):
    def turn(depth):
        route = R.Straight(jnp.stack([depth, 0 * depth]))
        return R.equilibrium(arc, (R.Tendons(route, 2.0),)).q[0]

    curvature, slope = jax.jit(jax.value_and_grad(turn))(3e-3)
    assert np.isclose(curvature, 2 * 3e-3 / bending(arc), rtol=1e-12, atol=0)
    assert np.isclose(slope, 2.0 / bending(arc), rtol=1e-9, atol=0)


def test_a_tension_that_closes_over_numbers_has_their_derivative_in_motions(arc):
    """The tension is linear in the numbers, and so is a short motion."""

    def end(pull):
        tendon = R.Tendons(ROUTES[0], lambda t: pull * jnp.minimum(t / 2e-3, 1.0))
        rest = jnp.zeros(1)
        path = R.rollout(arc, rest, rest, (tendon,), step=1e-3, saves=4, check=False)
        return path.q[-1, 0]

    def total(pulls):
        ends = jax.vmap(end)(pulls)
        return jnp.sum(ends), ends

    pulls = jnp.array([0.01, 0.02])
    slopes, ends = jax.jit(jax.grad(total, has_aux=True))(pulls)
    assert jnp.allclose(slopes, ends / pulls, rtol=1e-3)


def test_friction_takes_tension_as_on_a_capstan(arc):
    curvature, mu = 20.0, 0.3

    @jax.jit
    @jax.value_and_grad
    def pulled(q):
        return R.Tendons(R.Straight([3e-3, 0.0]), 2.0, mu)(T0, R.motion(arc, q[None]))[0]

    turn = mu * curvature * 0.08
    expected = 2 * 3e-3 * 0.08 * (1 - np.exp(-turn)) / turn
    assert np.isclose(pulled(curvature)[0], expected, rtol=1e-10, atol=0)
    assert np.isfinite(pulled(0.0)[1])


# Wrenches, fluids, laws, maps


def test_wrenches_dead_and_follower(general):
    rod, q, v, motion = general
    wrench = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    pose = np.asarray(R.forward_kinematics(rod, q, [0.3]))[0, :3, :3]
    turned = np.concatenate([pose @ wrench[:3], pose @ wrench[3:]])
    weight = np.zeros(6)
    weight[5] = np.sum(motion.operators.mass) / 0.08 * -9.81
    at_tip, tip, follower, dead, line, same, gravity = forces(
        motion,
        R.PointWrench(wrench),
        R.TipWrench(wrench),
        R.PointWrench(wrench, 0.3, follower=True),
        R.PointWrench(turned, 0.3),
        R.LineWrench(weight),
        R.LineWrench(lambda s: weight + 0 * s),
        R.Gravity(),
    )
    assert size(at_tip - tip) < 1e-13
    assert size(follower - dead) < 1e-13
    assert size(line - gravity) < 1e-15
    assert size(line - same) < 1e-16


def test_a_fluid_carries_and_brakes(general):
    rod, q, v, motion = general
    drag = R.Drag(1000.0, 12e-3, viscous=0.1)
    still = R.Drag(1000.0, 12e-3, flow=[0.0, 0.0, 0.0])
    floating, gravity, braked = forces(motion, R.Buoyancy(1000.0), R.Gravity(), drag)
    assert size(floating + gravity / 2) < 1e-16
    assert float(braked @ v) < 0

    # Only the velocity of a motion depends on its rates.
    def at(v):
        return eqx.tree_at(lambda m: m.v, motion, v)

    rest = jax.jit(lambda v: (still(T0, at(v)), jax.jacfwd(lambda v: drag(T0, at(v)))(v)))
    carried, slope = map(np.asarray, rest(0 * v))
    assert size(carried) == 0
    assert np.all(np.linalg.eigvalsh((slope + slope.T) / 2) < 1e-15)


def test_drag_of_a_cylinder_in_a_cross_flow(arc):
    flow = 0.7
    (force,) = forces(bent(arc, 0.0), R.Drag(1000.0, 12e-3, flow=[0.0, flow]))
    # Uniform load p on a clamped straight rod: p L^3 / 6 about constant curvature.
    load = 1000.0 * 12e-3 * 1.1 * flow**2 / 2
    assert np.allclose(force, load * 0.08**3 / 6, rtol=1e-12, atol=0)


def test_drag_of_a_cylinder_along_the_flow():
    flow, finger = 0.7, dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2e3)
    rod = R.rod(SE2(), R.chebyshev(sigma_x=1), R.circle(6e-3), nodes=4, **finger)
    drag = R.Drag(1000.0, 12e-3, along=0.02, flow=[flow, 0.0])
    (force,) = forces(R.motion(rod, jnp.zeros(1)), drag)
    # Friction on the circumference, whose load p stretches a clamped rod by p L^2 / 2.
    load = 1000.0 * np.pi * 12e-3 * 0.02 * flow**2 / 2
    assert np.allclose(force, load * 0.08**2 / 2, rtol=1e-12, atol=0)


def test_a_section_law_replaces_the_linear_one(general):
    rod, q, _, motion = general
    expected = np.asarray(R.elastic_force(rod, q))
    young, shear = 1e6, 1e6 / 2.6
    s = rod.section
    moments = [shear * s.torsion_constant, young * s.second_moment_y, young * s.second_moment_z]
    tensions = [young * s.area, *[shear * s.shear_factor * s.area] * 2]
    scale = np.array([*moments, *tensions], float)
    assert scale.shape == (6,)
    linear = R.section_law(rod, lambda strain, s: scale * strain)
    hard = R.section_law(rod, R.EnergyLaw(lambda e, s: (1 + s) * jnp.sum(scale * e**2) / 2))
    soft, strong = forces(motion, linear, hard)
    assert size(soft + expected) < 1e-13 * size(expected)
    assert size(strong) > 1.2 * size(soft)
    tangent = np.asarray(eqx.filter_jit(tangent_stiffness)((hard,), motion))
    assert size(tangent - tangent.T) < 1e-12 * size(tangent)


def test_an_input_map_acts(arc):
    force = R.Actuation(lambda q: jnp.outer(q, jnp.array([1.0, 3.0])), [0.5, 1.0])
    assert np.allclose(forces(bent(arc, 2.0), force)[0], 7.0)


def test_messages_name_the_remedy(arc):
    motion = bent(arc, 0.0)
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
