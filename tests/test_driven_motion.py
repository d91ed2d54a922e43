"""Joints that are moved by a given velocity: closed forms, order, and what a rod feels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from sorojax import rod
from sorojax.math.lie import SE2, SE3, homogeneous, plane_rotation, skew
from sorojax.math.ode.steppers import RungeKutta4

SCREW = {2: jnp.array([1.5, 0.2, -0.3]), 3: jnp.array([0.7, -1.1, 0.4, 0.2, 0.1, -0.3])}
GROUP = {2: SE2(), 3: SE3()}


def placed(dim):
    twist = 0.4 * SCREW[dim][::-1]
    return GROUP[dim].exp(twist)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_constant_body_twist_is_an_exponential(dim):
    twist, start = SCREW[dim], placed(dim)
    one = rod.motion_from_velocity(jnp.array([0.5]), twist[None], start, axes="moving")
    two = rod.motion_from_velocity(
        jnp.array([0.5, 1.7]), jnp.stack([twist, twist]), start, axes="moving"
    )
    for t in (-1.0, 0.5, 1.1, 1.7, 4.0):  # before the first sample and after the last too
        want = start @ GROUP[dim].exp((t - 0.5) * twist)
        assert np.allclose(one(t), want, atol=1e-14)
        assert np.allclose(two(t), want, atol=1e-14)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_screw_that_gains_speed_is_exact(dim):
    times = jnp.array([0.0, 0.3, 1.0, 1.2, 2.0])
    twists, start = times[:, None] * SCREW[dim][None], placed(dim)
    found = jax.vmap(rod.motion_from_velocity(times, twists, start, axes="moving"))
    t = jnp.linspace(0, 2, 9)
    want = jax.vmap(lambda t: start @ GROUP[dim].exp(t**2 / 2 * SCREW[dim]))(t)
    assert np.allclose(found(t), want, atol=1e-14)


@pytest.mark.parametrize("dim", [2, 3])
def test_along_fixed_axes_turn_and_travel_do_not_mix(dim):
    times = jnp.array([0.0, 0.4, 1.0])
    start, n = placed(dim), GROUP[dim].rotation_dim
    spin = SCREW[dim] * jnp.where(jnp.arange(n + dim) < n, 1, 0)
    velocity = jnp.array([[0.0, 1.0, 0.3], [2.0, -1.0, 0.0], [0.0, 0.0, 0.5]])[:, :dim]
    twists = times[:, None] * spin[None] + jnp.zeros((3, n + dim)).at[:, n:].set(velocity)
    found = rod.motion_from_velocity(times, twists, start)
    area = jnp.sum((velocity[1:] + velocity[:-1]) / 2 * jnp.diff(times)[:, None], axis=0)
    assert np.allclose(found(1.0)[:dim, dim], start[:dim, dim] + area, atol=1e-14)
    turn = GROUP[dim].exp(spin / 2)[:dim, :dim]  # of the ground, after 1 s
    assert np.allclose(found(1.0)[:dim, :dim], turn @ start[:dim, :dim], atol=1e-14)
    stopped = rod.motion_from_velocity(
        jnp.append(times, 2.0), jnp.concatenate([twists, 0 * spin[None]]), start
    )
    assert np.allclose(stopped(5.0), stopped(2.0), atol=1e-15)


def wavy(t):
    """A twist that does not commute with itself at another time."""
    angular = jnp.stack([jnp.sin(2 * t), jnp.cos(3 * t), t])
    return jnp.concatenate([angular, jnp.stack([jnp.cos(t), 0.3 * t, jnp.sin(3 * t)])])


@pytest.mark.parametrize("axes", ["fixed", "moving"])
def test_intervals_are_of_sixth_order(axes):
    """One linear twist, cut into more and more intervals."""
    first, last = wavy(jnp.array(0.0)), 3 * wavy(jnp.array(1.0))

    def field(t, y):
        pose, twist = y.reshape(4, 4), first + t * (last - first)
        spin, velocity = np.asarray(skew(twist[:3])), np.asarray(twist[3:])
        rate = np.zeros((4, 4))
        if axes == "moving":
            rate[:3, :3], rate[:3, 3] = pose[:3, :3] @ spin, pose[:3, :3] @ velocity
        else:
            rate[:3, :3], rate[:3, 3] = spin @ pose[:3, :3], velocity
        return rate.ravel()

    want = scipy.integrate.solve_ivp(
        field, (0, 1), np.eye(4).ravel(), "DOP853", rtol=1e-12, atol=1e-13
    ).y[:, -1]
    errors = []
    for count in (4, 8, 16):
        times = jnp.linspace(0, 1, count + 1)
        twists = first[None] + times[:, None] * (last - first)[None]
        found = rod.motion_from_velocity(times, twists, axes=axes).poses[-1]
        errors.append(float(np.abs(found.ravel() - want).max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 1e-8 and (orders > 5.5).all()


@pytest.mark.parametrize("axes", ["fixed", "moving"])
def test_velocity_and_acceleration_are_those_of_the_samples(axes):
    times = jnp.linspace(0, 1, 21)
    move = rod.motion_from_velocity(times, jax.vmap(wavy)(times), axes=axes)

    def twist(t):
        pose, rate = jax.jvp(move, (t,), (jnp.ones_like(t),))
        turn = pose[:3, :3].T
        if axes == "moving":
            spin, velocity = turn @ rate[:3, :3], turn @ rate[:3, 3]
        else:
            spin, velocity = rate[:3, :3] @ turn, rate[:3, 3]
        return jnp.stack([spin[2, 1], spin[0, 2], spin[1, 0], *velocity])

    t = jnp.array([0.0, 0.013, 0.52, 0.95, 0.999])
    found, slope = jax.vmap(lambda t: jax.jvp(twist, (t,), (jnp.ones_like(t),)))(t)
    want = np.stack([np.interp(t, times, s) for s in jax.vmap(wavy)(times).T], axis=1)
    assert np.allclose(found, want, atol=1e-8)
    k = np.searchsorted(times, t, side="right") - 1
    steps = np.diff(jax.vmap(wavy)(times), axis=0) / 0.05
    assert np.allclose(slope, steps[k], atol=1e-5)


def test_a_plane_is_one_of_space():
    times = jnp.array([0.0, 0.5, 1.0])
    flat = jnp.array([[0.3, 1.0, 0.0], [2.0, 0.5, -1.0], [-1.0, 0.0, 0.4]])
    deep = jnp.zeros((3, 6)).at[:, 2:5].set(flat)
    for axes in ("fixed", "moving"):
        found, want = (rod.motion_from_velocity(times, x, axes=axes)(0.8) for x in (flat, deep))
        assert np.allclose(found, want[jnp.array([[0], [1], [3]]), jnp.array([[0, 1, 3]])])


def test_the_driven_end_of_a_rod_moves_as_it_is_told():
    """Rates of the section at the base, in a run, beside the twists that were given."""
    body = rod.rod(
        SE3(), rod.chebyshev(kappa_y=2, kappa_z=2), rod.circle(5e-3), length=0.1, nodes=6,
        young_modulus=1e6, poisson_ratio=0.5, density=1000,
    )  # fmt: skip
    times = jnp.linspace(0, 0.1, 6)
    start = homogeneous(jnp.eye(3), jnp.array([0.1, 0.0, 0.0]))
    given = times[:, None] * jax.vmap(wavy)(times)
    free = rod.assembly(SE3(), rod=rod.Part(body, rod.Free()))
    move = rod.motion_from_velocity(times, given, start)
    loop = rod.with_closures(free, base=rod.Closure("rod", at=0.0, motion=move))
    q = rod.close_loops(loop).q
    path = rod.rollout(
        loop, q, jnp.zeros(10), (rod.Gravity(),), step=1e-3, saves=8, every=15,
        stepper=RungeKutta4(), check=False,
    )  # fmt: skip

    def twist(q, v):
        return rod.jacobian(loop, q, jnp.zeros(1))["rod"][0] @ v

    found = jax.vmap(twist)(path.q, path.v)
    want = np.stack([np.interp(path.time, times, column) for column in given.T], axis=1)
    assert np.abs(found - want).max() < 1e-8 and np.abs(want).max() > 0.05
    poses = jax.vmap(lambda q: rod.forward_kinematics(loop, q, jnp.zeros(1))["rod"][0])(path.q)
    assert np.allclose(poses, jax.vmap(move)(path.time), atol=1e-11)
    tip = path.v[:, 6:]
    assert np.abs(tip).max() > 1.0  # it bends, and what holds it pushes
    assert float(jnp.abs(path.reactions["base"]).max()) > 1e-3


def test_a_turn_in_a_plane():
    times = jnp.array([0.0, 2.0])
    move = rod.motion_from_velocity(times, jnp.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]))
    assert np.allclose(move(2.0)[:2, :2], plane_rotation(jnp.array(3.0)), atol=1e-14)


TWO = jnp.array([0.0, 1.0])


def test_samples_that_make_no_motion_are_refused():
    one = jnp.zeros((2, 6))
    with pytest.raises(ValueError, match=r"`twists` has shape \(2, 5\) at 2 times, need"):
        rod.motion_from_velocity(TWO, one[:, :5])
    with pytest.raises(ValueError, match="at 3 times, need"):
        rod.motion_from_velocity(jnp.arange(3.0), one)
    with pytest.raises(ValueError, match="`times` do not increase, need"):
        rod.motion_from_velocity(0 * TWO, one)
    with pytest.raises(ValueError, match=r"`start` has shape \(3, 3\), need \(4, 4\)"):
        rod.motion_from_velocity(TWO, one, jnp.eye(3))
    with pytest.raises(ValueError, match="`twists` must be finite"):
        rod.motion_from_velocity(TWO, one.at[0, 0].set(jnp.nan))
