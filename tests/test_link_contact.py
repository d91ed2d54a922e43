"""Rods against rigid links, links against obstacles, and forces that change with time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R, sdf
from sorojax.contact import LinePenalty
from sorojax.math import ContactMidpoint
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.ode import contact_midpoint as contact_stepper
from sorojax.systems import SmoothRamp

T0 = jnp.zeros(())
FINGER = {"length": 0.1, "young_modulus": 1e6, "poisson_ratio": 0.4, "density": 1100.0}
RADIUS = 5e-3
LAW = LinePenalty(stiffness=5e5, smoothing=2e-5, friction=0.5, slip=1e-3)


def touching(group, shape, law):
    """A free rod and a free link that overlap, at a moment at which all moves."""
    dim = group.space_dim
    names = ("kappa_z",) if dim == 2 else ("kappa_y", "kappa_z")
    rod = R.rod(
        group, R.chebyshev(**dict.fromkeys(names, 2)), R.circle(RADIUS), nodes=8, **FINGER
    )
    inertia = 1e-5 if dim == 2 else [1e-5, 2e-5, 3e-5]
    at = homogeneous(jnp.eye(dim), jnp.array([0.06, -0.0145, 0.001])[:dim])
    pair = R.assembly(
        group,
        rod=R.Part(rod, R.Free()),
        stone=R.Part(R.Link(0.05, inertia), R.Free(), offset=at),
    )
    rates = 0.05 * jnp.asarray(np.random.default_rng(0).standard_normal(R.num_dof(pair)))
    contact = R.LinkContact(shape, RADIUS, law, points=32)
    return pair, R.rest(pair), rates, contact


def test_the_force_on_both_is_the_slope_of_the_energy():
    law = LinePenalty(stiffness=5e5, smoothing=2e-5)
    pair, q, v, contact = touching(SE2(), sdf.Rectangle([-0.02, -0.01], [0.02, 0.01]), law)

    @jax.jit
    def at(move):
        here = R.motion(pair, q + move, v)
        touch = contact.touch(*(R.part_motion(here, k) for k in (0, 1)))
        energy = touch.weights @ law.energy(touch.gap)
        forces = [
            R.total_force(f, T0, here) for f in ((R.PairForce("rod", "stone", contact),), ())
        ]
        return energy, forces[0] - forces[1]

    move = jnp.zeros(q.shape).at[0].set(-0.05).at[5].set(0.2)
    slope = jax.grad(lambda move: at(move)[0])(move)
    energy, force = at(move)
    assert energy > 0
    np.testing.assert_allclose(force, -slope, atol=1e-9 * float(jnp.abs(slope).max()))


def test_no_force_comes_from_nowhere():
    """Friction too: forces and moments about the origin on rod and link cancel."""
    pair, q, v, contact = touching(SE3(), sdf.Cylinder(0.01, 0.06), LAW)

    @jax.jit
    def push(q, v):
        here = R.motion(pair, q, v)
        ends = [
            R.total_force(f, T0, here) for f in ((R.PairForce("rod", "stone", contact),), ())
        ]
        return ends[0] - ends[1]

    force = np.asarray(push(q, v))
    on_rod, on_stone = force[:6], force[-6:]
    place = np.array([0.06, -0.0145, 0.001])
    assert np.abs(on_rod[3:]).max() > 0.1
    np.testing.assert_allclose(on_rod[3:] + on_stone[3:], 0, atol=1e-12)
    turning = on_rod[:3] + on_stone[:3] + np.cross(place, on_stone[3:])
    np.testing.assert_allclose(turning, 0, atol=1e-14)


LASTING = ContactMidpoint(passes=1, lasting=True, theta=1.0, tolerance=1e-6)


@pytest.mark.parametrize("stepper", [ContactMidpoint(), LASTING], ids=["midpoint", "lasting"])
def test_a_block_slides_as_far_as_friction_lets_it(stepper):
    speed, half = 0.3, 0.01
    corners = np.array([[-half, -half], [half, -half]])
    floor = sdf.Rectangle([-1.0, -1.0], [1.0, 0.0])
    contact = R.LinkObstacle(floor, corners, [half, half], LAW)
    block = R.assembly(SE2(), block=R.Part(R.Link(0.05, 1e-5), R.Free()))
    q, v = jnp.array([0.0, 0.0, half]), jnp.array([0.0, speed, 0.0])
    forces = (R.Gravity(), R.PartForce("block", contact))
    path = R.rollout(block, q, v, forces, step=1e-3, saves=100, stepper=stepper)
    assert float(path.q[-1, 1]) == pytest.approx(speed**2 / (2 * 0.5 * 9.81), rel=0.02)
    sunk = half - np.asarray(path.q)[:, 2]
    still = 0.05 * 9.81 / (2 * half * 5e5) + 1e-5
    assert sunk[-1] == pytest.approx(still, rel=0.05)
    assert sunk.max() < 2 * still  # of a load that comes at once
    nose = 0.5 * 0.05 * 9.81 / (half * 5e5) / (2 * half)  # down by friction while it slides
    assert abs(float(path.q[-1, 0])) < nose


def test_one_loop_for_both_solutions_gives_the_same_path(monkeypatch):
    """Through the air, onto the floor and along it."""
    half = 0.01
    floor = sdf.Rectangle([-1.0, -1.0], [1.0, 0.0])
    corners = np.array([[-half, -half], [half, -half]])
    contact = R.LinkObstacle(floor, corners, [half, half], LAW)
    block = R.assembly(SE2(), block=R.Part(R.Link(0.05, 1e-5), R.Free()))
    q, v = jnp.array([0.0, 0.0, 1.2 * half]), jnp.array([0.0, 0.1, 0.0])
    forces = (R.Gravity(), R.PartForce("block", contact))

    def path():
        jax.clear_caches()
        return R.rollout(block, q, v, forces, step=1e-3, saves=50, stepper=LASTING)

    once = path()
    monkeypatch.setattr(contact_stepper, "_solve_together", contact_stepper._solve_apart)
    apart = path()
    height = np.asarray(once.q)[:, 2]
    assert height.max() > 1.1 * half and height.min() < half
    np.testing.assert_allclose(once.q, apart.q, rtol=0, atol=1e-14)


def test_two_rods_are_no_rod_and_link():
    pair, q, v, contact = touching(SE2(), sdf.Circle([0.0, 0.0], 0.01), LAW)
    here = R.motion(pair, q, v)
    with pytest.raises(ValueError, match="need a rod and then a link"):
        contact(T0, *(R.part_motion(here, k) for k in (1, 0)))


def test_a_varying_wrench_is_the_one_of_the_moment():
    rod = R.rod(SE2(), R.chebyshev(kappa_z=2), R.circle(RADIUS), nodes=6, **FINGER)
    here = R.motion(rod, jnp.array([3.0, -2.0]))
    ramp = SmoothRamp([0.0, 1.0], [0.0, 2.0])

    def wrench(t):
        return jnp.stack([0 * t, 0 * t, ramp(t)])

    force = R.TimeVaryingForce(R.TipWrench, wrench)
    for t in (0.0, 0.3, 2.0):
        now = jnp.asarray(t)
        assert jnp.array_equal(force(now, here), R.TipWrench(wrench(now))(now, here))
    assert eqx.tree_equal(force, R.TimeVaryingForce(R.TipWrench, wrench))


def test_a_screw_is_a_hinge_or_a_slide_and_both():
    link = R.Link(0.1, [1e-4, 2e-4, 3e-4])
    q, v = jnp.array([0.7]), jnp.array([2.0])

    def moved(joint):
        model = R.assembly(SE3(), thing=R.Part(link, joint))
        here = R.motion(model, q, v)
        found = R.tip_pose(model, q)["thing"], R.inertia(here)[0]
        return *found, R.total_force((), T0, here)

    turned, slid = R.Revolute(damping=0.5), R.Prismatic([0.0, 0.0, 1.0], damping=0.5)
    for screw, other in ((R.Screw(1.0, 0.0, 0.5), turned), (R.Screw(0.0, 1.0, 0.5), slid)):
        for got, want in zip(moved(screw), moved(other), strict=True):
            np.testing.assert_allclose(got, want, atol=1e-15)
    pose, mass, _ = moved(R.Screw(1.0, 0.02))
    assert pose[2, 3] == 0.7 * 0.02
    assert float(mass[0, 0]) == pytest.approx(3e-4 + 0.1 * 0.02**2)
    with pytest.raises(ValueError, match="need one that moves"):
        R.Screw(0.0, 0.0)
