"""Contact of rods: the law, obstacles, itself, each other; energy and derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R, sdf
from sorojax.contact import LinePenalty
from sorojax.math.lie import SE2, SE3
from sorojax.math.ode.linearly_implicit import LinearlyImplicit
from sorojax.math.status import Status
from sorojax.rod.contact.obstacle import energy as energy_of_touch

RADIUS = 6e-3
FINGER = dict(length=0.08, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
LAW = LinePenalty(stiffness=5e7, smoothing=6e-6, friction=0.5)
T0 = jnp.zeros(())


def size(value):
    return float(jnp.abs(value).max())


def rise(energy):
    """Largest growth over the least value before it."""
    energy = np.asarray(energy)
    return float(np.max(energy - np.minimum.accumulate(energy)))


# The law


def test_the_law_derives_from_its_energy_and_is_smooth():
    gap = np.append(np.linspace(-1.5e-5, 5e-6, 41), [-1e-12, 1e-12, -6e-6 + 1e-12])
    own = LAW.energy, LAW.pressure, LAW.slope
    (_, pressure, slope), (push, growth, bend) = jax.jit(
        lambda gap: jax.jvp(lambda gap: [f(gap) for f in own], (gap,), (jnp.ones_like(gap),))
    )(gap)
    assert size(push + pressure) < 1e-12 * size(pressure)
    assert size(growth + slope) < 1e-12 * 5e7
    assert size(bend[-3:]) < 1e-5 * 5e7 / 6e-6
    damped = LinePenalty(stiffness=5e7, smoothing=6e-6, damping=2.0)
    assert np.allclose(damped.approach(np.array([-1.0, 0.1, 1.0])), [3.0, 0.8, 0.0])
    with pytest.raises(ValueError, match="must be positive"):
        LinePenalty(stiffness=-1.0, smoothing=1e-5)


# A rod that falls into a corner


FLOOR, WALL = sdf.Rectangle([-1.0, -1.0], [1.0, 0.0]), sdf.Rectangle([0.09, -1.0], [1.0, 1.0])
G = jnp.array([0.0, -9.81])


def corner(points):
    """Face by face: in the concave edge of a union only one of them would push."""
    options = {"points": points, "caps": "both"}
    return [R.ObstacleContact(face, RADIUS, LAW, **options) for face in (FLOOR, WALL)]


def dropped(points, q, v):
    """A free planar rod falls for 0.2 s: energy, penetration, end."""
    rod = R.rod(SE2(), R.chebyshev(kappa_z=2), R.circle(RADIUS), nodes=8, **FINGER)
    body = R.assembly(SE2(), rod=R.Part(rod, R.Free()))
    faces = corner(points)
    forces = (R.Gravity(), *(R.PartForce("rod", face) for face in faces))
    path = R.rollout(body, q, v, forces, step=1e-3, saves=100, every=2)

    def report(q, v):
        motion = R.part_motion(R.motion(body, q, v), 0)
        energy = R.kinetic_energy(body, q, v) + R.potential_energy(body, q, G)
        energy = energy + sum(R.contact_energy(face, motion) for face in faces)
        return energy, jnp.max(jnp.stack([R.penetration(face, motion) for face in faces]))

    return path, *jax.vmap(report)(path.q, path.v)


@pytest.fixture(scope="module")
def drop():
    return eqx.filter_jit(dropped)


STARTS = ([0.1, -0.03, 0.03, 0.0, 0.0], [-0.6, 0.0, 0.06, 0.0, 0.0])  # turn, x, y, q


@pytest.mark.parametrize("start, speed", [(STARTS[0], 0.0), (STARTS[1], 0.4)])
def test_a_falling_rod_does_not_sink_in_and_loses_energy(drop, start, speed):
    q, v = jnp.array(start), jnp.zeros(5).at[1].set(speed)
    path, energy, depth = drop(32, q, v)
    assert path.status == Status.successful
    assert 0 < size(depth) < 0.01 * RADIUS
    assert float(energy[-1]) < float(energy[0])
    assert rise(energy) < 2e-4 * float(energy[0])


def test_a_damped_contact_holds_back_what_closes():
    """Its damping matrix is the slope of the force by the rates: of a straight rod that sinks
    in along the normal, exactly."""
    rod = R.rod(SE2(), R.chebyshev(kappa_z=1), R.circle(RADIUS), nodes=4, **FINGER)
    body = R.assembly(SE2(), rod=R.Part(rod, R.Free()))
    law = LinePenalty(stiffness=5e7, smoothing=6e-6, damping=2.0)
    floor = R.ObstacleContact(FLOOR, RADIUS, law, points=8, caps="both")
    q, v = jnp.zeros(4).at[2].set(RADIUS - 4e-6), jnp.zeros(4).at[2].set(-0.1)

    def at(v):
        return R.part_motion(R.motion(body, q, v), 0)

    damping = floor.linearised(T0, at(v)).damping
    slope = -jax.jacfwd(lambda v: floor.linearised(T0, at(v)).force)(v)
    assert float(damping[2, 2]) > 0
    assert np.allclose(damping[2, 2], slope[2, 2], rtol=1e-9)
    assert size(floor.linearised(T0, at(-6 * v)).damping) == 0.0  # it has let go


def test_twice_the_points_give_the_same_equilibrium():
    rod = R.rod(SE2(), R.chebyshev(kappa_z=3), R.circle(RADIUS), **FINGER)
    stone = sdf.Circle([0.045, -0.014], 6e-3)
    ends = []

    @eqx.filter_jit
    def lying(contact):
        rest = R.equilibrium(rod, (R.Gravity(), contact))
        return rest, R.penetration(contact, R.motion(rod, rest.q))

    for points in (32, 64):
        rest, depth = lying(R.ObstacleContact(stone, RADIUS, LAW, points=points))
        assert rest.status == Status.successful
        assert 0 < float(depth) < 0.01 * RADIUS
        ends.append(rest.q)
    assert size(ends[0] - ends[1]) < 0.02 * size(ends[1])


def test_one_linear_solution_per_step_comes_to_rest_where_contact_balances():
    rod = R.rod(SE2(), R.chebyshev(kappa_z=3), R.circle(RADIUS), **FINGER)
    smooth = LinePenalty(stiffness=5e7, smoothing=6e-6)
    stone = R.ObstacleContact(sdf.Circle([0.045, -0.014], 6e-3), RADIUS, smooth)
    rest = R.equilibrium(rod, (R.Gravity(), stone))
    forces, zero = (R.Gravity(), stone, R.Damping(0.05)), jnp.zeros(3)
    options = {"step": 2e-3, "saves": 1, "every": 1000, "check": False}
    path = R.rollout(rod, zero, zero, forces, stepper=LinearlyImplicit(), **options)
    assert path.status == rest.status == Status.successful
    assert size(path.q[-1] - rest.q) < 1e-8 * size(rest.q) and size(path.v[-1]) < 1e-6


# Bodies against each other, at one moment


def coil(q):
    rod = R.rod(
        SE2(), R.chebyshev(kappa_z=3), R.circle(3e-3), nodes=20, **(FINGER | {"length": 0.2})
    )
    return R.motion(rod, q)


def crossed(q):
    rod = R.rod(SE3(), R.chebyshev(kappa_y=2, kappa_z=2), R.circle(RADIUS), **FINGER)
    low = jnp.array([[0.0, -1, 0, 0.05], [1, 0, 0, -0.04], [0, 0, 1, -0.0118], [0, 0, 0, 1]])
    pair = R.assembly(SE3(), top=R.Part(rod), low=R.Part(rod, offset=low))
    return pair, R.motion(pair, q)


def test_self_contact_is_the_slope_of_its_energy():
    """The depth of a coil that closes is measured by the benchmark `rod_contact`."""
    law = LinePenalty(stiffness=5e6, smoothing=6e-6)
    contact = R.SelfContact(3e-3, law, points=64)

    @jax.jit
    def at(q):
        slope = jax.grad(lambda q: R.contact_energy(contact, coil(q)))(q)
        return slope, contact.linearised(T0, coil(q)), R.penetration(contact, coil(q))

    slope, term, depth = at(jnp.array([34.0, 2.0, 0.5]))
    assert float(depth) > 0 and size(slope) > 0
    assert size(term.force + slope) < 1e-12 * size(slope)
    assert float(jnp.linalg.eigvalsh(term.stiffness)[0]) > -1e-12 * size(term.stiffness)
    slope, term, depth = at(jnp.array([12.0, 1.0, 0.5]))
    assert float(depth) == 0 and size(slope) == 0 and size(term.force) == 0


def test_rods_that_cross_press_against_each_other():
    contact = R.RodContact([RADIUS, RADIUS], LinePenalty(5e6, 1.2e-5), points=48)

    @jax.jit
    def at(q):
        def energy(q):
            pair, motion = crossed(q)
            bodies = [R.part_motion(motion, k) for k in (0, 1)]
            found = contact.touches(*bodies)
            return sum(energy_of_touch(contact.law, touch) for touch in found)

        pair, motion = crossed(q)
        plain = R.total_force((), T0, motion)
        force = R.total_force((R.PairForce("top", "low", contact),), T0, motion) - plain
        held = R.HeldRod(contact, R.part_motion(motion, 1))
        alone = held(T0, R.part_motion(motion, 0))
        return jax.grad(energy)(q), force, alone

    slope, force, alone = at(jnp.array([1.0, 0.5, 0.3, 0.1, -1.0, 0.2, 0.4, 0.0]))
    assert size(slope) > 0
    assert size(force + slope) < 1e-7 * size(slope)
    assert size(alone[-4:] - force[:4]) < 1e-12 * size(force)


# Derivatives through making and breaking contact


@pytest.mark.slow
@pytest.mark.stress(44)
def test_pushes_are_differentiable_through_contact():
    rod = R.rod(SE2(), R.chebyshev(kappa_z=2), R.circle(RADIUS), nodes=8, **FINGER)
    low = sdf.Rectangle([-1.0, -1.0], [1.0, -0.012])
    contact = R.ObstacleContact(low, RADIUS, LAW, points=16)

    def push(speed):
        v = jnp.stack([-speed, 0 * speed])
        forces = (R.Gravity(), contact, R.Damping(0.01))
        path = R.rollout(rod, 0 * v, v, forces, step=2e-3, saves=15, every=2)
        return R.tip_pose(rod, path.q[-1])[1, 2], path.q

    @jax.jit
    @jax.vmap
    def every(speed):
        (height, path), ahead = jax.linearize(push, speed)
        back = jax.linear_transpose(lambda x: ahead(x)[0], speed)
        depth = jax.vmap(lambda q: R.penetration(contact, R.motion(rod, q)))(path)
        one = jnp.ones_like(speed)
        return height, ahead(one)[0], back(one)[0], depth

    # unbatched, where a branch is taken and not selected
    alone = jax.jit(jax.grad(lambda speed: push(speed)[0]))(jnp.array(300.0))

    change = 1e-3
    height, forward, backward, depth = every(300.0 + change * np.array([-1.0, 0.0, 1.0]))
    touches = np.asarray(depth[1] > 0)
    assert touches.any() and not touches[0] and not touches.all()
    assert np.allclose(backward, forward, rtol=1e-8, atol=0)
    assert np.isclose(alone, forward[1], rtol=1e-8)
    assert np.isclose(forward[1], (height[2] - height[0]) / (2 * change), rtol=1e-4)


# Far obstacles


def test_a_far_obstacle_is_skipped_and_a_near_one_is_not():
    rod = R.rod(SE3(), R.chebyshev(kappa_z=2, sigma_x=1), R.circle(RADIUS), **FINGER)
    law, none = LinePenalty(5e6, 1.2e-5), jnp.zeros(())

    @eqx.filter_jit
    def met(contact, q):
        motion = R.motion(rod, q)
        return contact.is_near(motion, none), contact(T0, motion)

    for height, want in ((-0.2, False), (-5.9e-3, True)):
        contact = R.ObstacleContact(sdf.HalfSpace([0, height, 0], [0, 1, 0]), RADIUS, law)
        is_near, force = met(contact, jnp.array([3.0, 1.0, 0.2]))
        assert bool(is_near) is want
        assert (size(force) > 0) is want
    with pytest.raises(ValueError, match="2 or more along the rod"):
        R.ObstacleContact(FLOOR, RADIUS, law, points=1)
    with pytest.raises(ValueError, match="one for each of 32 points"):
        R.ObstacleContact(FLOOR, [RADIUS] * 3, law)
