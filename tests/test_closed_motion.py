"""Closed loops and driven ends in motion."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from sorojax import rod
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.ode.steppers import (
    DormandPrince,
    GeneralisedAlpha,
    ImplicitMidpoint,
    RungeKutta4,
)
from sorojax.math.status import Status
from sorojax.rod.dynamics.closures import closure_change, closure_jacobian, violations
from sorojax.rod.model.assembly import retract

WEIGHT = (rod.Gravity(),)


def flat(x: Any, y: Any = 0.0):
    return homogeneous(jnp.eye(2), jnp.array([x, y]))


def deep(*position):
    return homogeneous(jnp.eye(3), jnp.array(position, float))


def bar(length, group=None):
    """A thin bar of 1 kg/m along x."""
    about = length**3 / 12
    if isinstance(group, SE3):
        return rod.Link(length, [1e-4, about, about], center=[length / 2, 0.0, 0.0])
    return rod.Link(length, about, center=[length / 2, 0.0])


A, B, C, D = 0.1, 0.25, 0.2, 0.3


def four_bar():
    hinge = rod.Revolute()
    tree = rod.assembly(
        SE2(),
        crank=rod.Part(bar(A), hinge),
        coupler=rod.Part(bar(B), hinge, on="crank", offset=flat(A)),
        rocker=rod.Part(bar(C), hinge, on="coupler", offset=flat(B)),
    )
    pin = rod.Closure("rocker", rod.Spherical(), offset=flat(D), frame=flat(C))
    return rod.with_closures(tree, pin=pin)


def start(loop, guess, crank_rate):
    """Coordinates of a closed loop, and the rates for one of the first joint."""
    found = rod.close_loops(loop, jnp.array(guess))
    assert found.status == Status.successful
    G = closure_jacobian(rod.motion(loop, found.q), jnp.zeros(()))
    rest = -jnp.linalg.pinv(G[:, 1:]) @ G[:, 0] * crank_rate
    return found.q, jnp.concatenate([jnp.array([crank_rate]), rest])


def opening(loop, path):
    at = jax.vmap(lambda t, q: violations(rod.motion(loop, q), t))(path.time, path.q)
    return float(jnp.max(jnp.abs(at)))


def crank_alone(q, v, seconds):
    """The one equation of a four-bar: I(x) x'' + I'(x) x'^2 / 2 + V'(x) = 0, with inertia and
    potential from the velocities of the bars' centres."""

    def angles(x):
        px, py = D - A * np.cos(x), -A * np.sin(x)
        r2 = px**2 + py**2
        base, reach = np.arctan2(py, px), np.arccos((B**2 + r2 - C**2) / (2 * B * np.sqrt(r2)))
        coupler = base + reach
        tip = np.array(
            [A * np.cos(x) + B * np.cos(coupler), A * np.sin(x) + B * np.sin(coupler)]
        )
        return coupler, np.arctan2(-tip[1], D - tip[0])

    def inertia_potential(x):
        e = 1e-6
        coupler, rocker = angles(x)
        w, u = (np.subtract(angles(x + e), angles(x - e))) / (2 * e)
        centre = -A * np.sin(x) - B / 2 * np.sin(coupler) * w
        climb = A * np.cos(x) + B / 2 * np.cos(coupler) * w
        inertia = A**3 / 3 + B * (centre**2 + climb**2) + B**3 / 12 * w**2 + C**3 / 3 * u**2
        y = A * A / 2 * np.sin(x) + B * (A * np.sin(x) + B / 2 * np.sin(coupler))
        return inertia, 9.81 * (y - C * C / 2 * np.sin(rocker))

    def field(_, y):
        e = 1e-4
        near = [inertia_potential(y[0] + k * e) for k in (-1, 0, 1)]
        slope, pull = (np.subtract(near[2], near[0])) / (2 * e)
        return [y[1], -(slope * y[1] ** 2 / 2 + pull) / near[1][0]]

    run = scipy.integrate.solve_ivp(field, (0, seconds), [q, v], rtol=1e-9, atol=1e-11)
    return run.y[:, -1]


@pytest.mark.parametrize("stepper", [DormandPrince(), GeneralisedAlpha(1.0)])
def test_a_four_bar_moves_as_its_one_equation_says(stepper):
    loop = four_bar()
    q, v = start(loop, [1.0, -0.5, -1.5], 5.0)
    path = rod.rollout(loop, q, v, WEIGHT, step=1e-3, saves=10, every=40, stepper=stepper)
    assert path.status == Status.successful
    assert opening(loop, path) < 1e-12
    want = crank_alone(float(q[0]), 5.0, 0.4)
    tol = 1e-6 if isinstance(stepper, DormandPrince) else 5e-3
    assert np.allclose([path.q[-1, 0], path.v[-1, 0]], want, rtol=tol)
    energy = [
        float(rod.kinetic_energy(loop, *x) + rod.potential_energy(loop, x[0], [0, -9.81]))
        for x in ((path.q[0], path.v[0]), (path.q[-1], path.v[-1]))
    ]
    assert np.isclose(*energy, rtol=1e-6 if isinstance(stepper, DormandPrince) else 1e-3)


def pendulum(joint):
    """A bar on a ball joint of the tree, or free and held by a closure."""
    tree = rod.assembly(SE3(), bar=rod.Part(bar(0.3, SE3()), joint))
    if isinstance(joint, rod.Spherical):
        return tree
    return rod.with_closures(tree, ball=rod.Closure("bar", rod.Spherical()))


def test_a_pendulum_on_a_closure_is_one_on_a_joint():
    spin, runs = jnp.array([0.3, 1.0, 2.0]), []
    for joint in (rod.Spherical(), rod.Free()):
        model = pendulum(joint)
        v = jnp.zeros(rod.num_dof(model)).at[:3].set(spin)
        runs.append(
            rod.rollout(
                model,
                rod.rest(model),
                v,
                WEIGHT,
                step=2e-3,
                saves=3,
                every=40,
                stepper=RungeKutta4(),
                check=False,
            )
        )
    joint, closed = runs
    assert np.allclose(closed.q[:, :4], joint.q, atol=1e-7)
    assert np.allclose(np.linalg.norm(closed.q[:, :4], axis=1), 1, atol=1e-14)
    # Newton: the reaction is mass times the acceleration of the centre, but for the weight
    model = pendulum(rod.Spherical())
    q, v = joint.q[-1], joint.v[-1]
    a = rod.forward_dynamics(model, q, v, WEIGHT)
    turn = rod.Spherical().pose(SE3(), q)[0]
    arm = turn @ jnp.array([0.15, 0.0, 0.0])
    centre = jnp.cross(a, arm) + jnp.cross(v, jnp.cross(v, arm))
    want = 0.3 * (centre + jnp.array([0.0, 0.0, 9.81]))
    assert np.allclose(closed.reactions["ball"][-1], [0, 0, 0, *want], atol=1e-6)


def test_closures_that_say_the_same_twice_do_no_harm():
    hinge = rod.Revolute(axis=[0.0, 1.0, 0.0])
    tree = rod.assembly(
        SE3(),
        crank=rod.Part(bar(A, SE3()), hinge),
        coupler=rod.Part(bar(B, SE3()), hinge, on="crank", offset=deep(A, 0, 0)),
        rocker=rod.Part(bar(C, SE3()), hinge, on="coupler", offset=deep(B, 0, 0)),
    )
    ends: Any = {"offset": deep(D, 0, 0), "frame": deep(C, 0, 0)}
    loop = rod.with_closures(tree, pin=rod.Closure("rocker", hinge, **ends))
    planar = four_bar()
    q, v = start(planar, [1.0, -0.5, -1.5], 5.0)
    settings = {"step": 1e-3, "saves": 2, "every": 50, "check": False}
    want = rod.rollout(planar, q, v, WEIGHT, stepper=RungeKutta4(), **settings)
    found = rod.rollout(loop, -q, -v, WEIGHT, stepper=RungeKutta4(), **settings)
    assert found.status == Status.successful  # 5 equations, 3 of them of no use
    assert np.allclose(-found.q, want.q, atol=1e-8)
    pin, other = found.reactions["pin"][-1], want.reactions["pin"][-1]
    assert np.allclose(
        pin, jnp.stack([0 * other[0]] * 3 + [other[1], 0 * other[0], other[2]]), atol=1e-6
    )


@pytest.mark.parametrize("group", [SE2(), SE3()])
def test_a_damped_ball_with_a_rotor_loses_what_its_damper_takes(group):
    """About its centre a ball of inertia I with a rotor J turns as exp(-d t / (I + J))."""
    joint = rod.Spherical(damping=0.3, armature=0.02)
    inertia = 0.04 * np.ones(group.rotation_dim if group.space_dim == 3 else ())
    model = rod.assembly(group, ball=rod.Part(rod.Link(1.0, inertia), joint))
    v = jnp.arange(1.0, 1 + rod.num_dof(model))
    for stepper, tol in ((RungeKutta4(), 1e-8), (GeneralisedAlpha(1.0), 1e-4)):
        path = rod.rollout(
            model, rod.rest(model), v, step=2e-3, saves=1, every=100, stepper=stepper
        )
        assert np.allclose(path.v[-1], v * np.exp(-0.2 * 0.3 / 0.06), rtol=tol)


SOFT = {"young_modulus": 1e6, "poisson_ratio": 0.5, "density": 1000}
BEAM = rod.rod(
    SE2(), rod.chebyshev(kappa_z=2, sigma_x=1), rod.circle(5e-3), length=0.1, nodes=6, **SOFT
)


def shaken(t):
    return flat(0.0, 2e-3 * (1 - jnp.cos(30 * t)))


@pytest.mark.parametrize("stepper", [RungeKutta4(), GeneralisedAlpha(1.0), ImplicitMidpoint()])
def test_a_base_that_is_driven_moves_the_rod_as_its_acceleration_does(stepper):
    """A clamped rod under the force of inertia of its base, in the frame of the base."""
    clamped = rod.assembly(SE2(), rod=rod.Part(BEAM))
    free = rod.assembly(SE2(), rod=rod.Part(BEAM, rod.Free()))
    loop = rod.with_closures(free, base=rod.Closure("rod", at=0.0, motion=shaken))

    class Inertia(rod.AbstractForce):
        def __call__(self, t, motion):
            lift = 2e-3 * 30**2 * jnp.cos(30 * t)
            return rod.Gravity(jnp.stack([0.0 * lift, -lift]))(t, motion)

    settings = {"step": 1e-3, "saves": 4, "every": 25, "stepper": stepper, "check": False}
    zero = jnp.zeros(3)
    want = rod.rollout(clamped, zero, zero, (rod.PartForce("rod", Inertia()),), **settings)
    found = rod.rollout(loop, jnp.zeros(6), jnp.zeros(6), (), **settings)
    assert opening(loop, found) < 1e-12
    size = float(jnp.abs(want.q).max())
    tol = {RungeKutta4: 1e-6, GeneralisedAlpha: 2e-2, ImplicitMidpoint: 2e-2}[type(stepper)]
    assert np.allclose(found.q[:, 3:], want.q, atol=tol * size)


def test_a_ring_spins_on():
    """A rod whose ends are clamped to each other keeps energy and momentum."""
    basis = rod.chebyshev(kappa_z=5, sigma_x=1)
    beam = rod.rod(SE2(), basis, rod.circle(5e-3), length=0.1, nodes=14, **SOFT)
    free = rod.assembly(SE2(), rod=rod.Part(beam, rod.Free()))
    ring = rod.with_closures(free, seam=rod.Closure("rod", on="rod", s=0.0))
    q = rod.close_loops(ring, jnp.zeros(9).at[3].set(2 * np.pi / 0.1))
    assert q.status == Status.successful
    v = jnp.zeros(9).at[:3].set(jnp.array([20.0, 0.1, 0.2]))
    path = rod.rollout(
        ring, q.q, v, (), step=1e-4, saves=4, every=100, stepper=DormandPrince(), check=False
    )
    assert path.status == Status.successful and opening(ring, path) < 1e-12
    first, last = (
        (
            rod.kinetic_energy(ring, *x) + rod.potential_energy(ring, x[0]),
            rod.momentum(ring, *x),
        )
        for x in ((path.q[0], path.v[0]), (path.q[-1], path.v[-1]))
    )
    assert np.isclose(first[0], last[0], rtol=1e-7)
    assert np.allclose(first[1], last[1], rtol=1e-6)


@pytest.mark.parametrize("stepper", [RungeKutta4(), GeneralisedAlpha()])
def test_gradients_of_a_closed_run_are_those_of_differences(stepper):
    loop = four_bar()
    q, v = start(loop, [1.0, -0.5, -1.5], 5.0)

    def end(length, rate):
        model = eqx.tree_at(lambda m: m.parts[0].body.mass, loop, length)
        path = rod.rollout(
            model, q, rate * v, WEIGHT, step=2e-3, saves=1, every=30, stepper=stepper
        )
        return path.q[-1, 0] + 1e-2 * path.reactions["pin"][-1, 1]

    at, along, h = (jnp.array(0.1), jnp.array(1.0)), (0.3, 0.2), 1e-5
    there, back = (
        end(*(x + sign * h * d for x, d in zip(at, along, strict=True))) for sign in (1, -1)
    )
    want = (there - back) / (2 * h)
    forward = jax.jvp(end, at, tuple(jnp.array(d) for d in along))[1]
    reverse = jnp.dot(jnp.array(along), jnp.stack(jax.grad(end, argnums=(0, 1))(*at)))
    assert np.isclose(forward, want, rtol=1e-6)
    assert np.isclose(reverse, forward, rtol=1e-10)


def test_inverse_dynamics_undoes_forward_dynamics():
    loop = four_bar()
    q, v = start(loop, [1.0, -0.5, -1.5], 5.0)
    assert np.allclose(
        rod.inverse_dynamics(loop, q, v, rod.forward_dynamics(loop, q, v, WEIGHT), WEIGHT),
        0,
        atol=1e-12,
    )
    push = rod.JointEffort("crank", 0.2)
    a = rod.forward_dynamics(loop, q, v, (*WEIGHT, push))
    effort = rod.inverse_dynamics(loop, q, v, a, WEIGHT)
    again = tuple(rod.JointEffort(name, effort[k]) for k, name in enumerate(loop.names))
    assert np.allclose(rod.forward_dynamics(loop, q, v, (*WEIGHT, *again)), a, rtol=1e-9)


def test_second_derivatives_of_violations_are_those_of_differentiation():
    tree = rod.assembly(
        SE3(),
        a=rod.Part(bar(0.3, SE3()), rod.Free()),
        b=rod.Part(bar(0.2, SE3()), rod.Spherical(), on="a", offset=deep(0.3, 0.01, 0)),
    )

    def driven(t):
        turn = rod.Revolute().pose(SE3(), jnp.sin(3 * t)[None])[0]
        return homogeneous(turn, jnp.stack([jnp.sin(t), t**2, 0.1 + t]))

    loop = rod.with_closures(
        tree,
        one=rod.Closure("b", rod.Revolute(), on="a", frame=deep(0.1, 0, 0.2)),
        two=rod.Closure("a", rod.Fixed(), motion=driven),
        three=rod.Closure("b", rod.Prismatic(), offset=deep(0, 0.1, 0)),
    )
    draw = np.random.default_rng(0)
    q = retract(loop, rod.rest(loop), jnp.array(draw.normal(0, 0.4, rod.num_dof(loop))))
    v, t = jnp.array(draw.normal(size=rod.num_dof(loop))), jnp.array(0.3)

    def value(x):
        return violations(rod.motion(loop, retract(loop, q, x * v)), t + x)

    def rate(x):
        return jax.jvp(value, (x,), (1.0,))

    (g, first), (_, second) = jax.jvp(rate, (0.0,), (1.0,))
    found = closure_change(rod.motion(loop, q, v), t)
    for got, want in zip(found, (g, first, second), strict=True):
        assert np.allclose(got, want, atol=1e-12)


def test_a_pose_that_is_singular_is_told():
    """A parallelogram that is driven through the pose in which all bars lie on one line."""
    hinge = rod.Revolute()
    tree = rod.assembly(
        SE2(),
        crank=rod.Part(bar(A), hinge),
        coupler=rod.Part(bar(D), hinge, on="crank", offset=flat(A)),
        rocker=rod.Part(bar(A), hinge, on="coupler", offset=flat(D)),
    )
    pin = rod.Closure("rocker", rod.Spherical(), offset=flat(D), frame=flat(A))
    loop = rod.with_closures(tree, pin=pin)
    q, v = jnp.array([0.5, -0.5, 0.5 - np.pi]), jnp.array([-5.0, 5.0, -5.0])
    runs = [
        rod.rollout(loop, q, v, (), step=1e-3, saves=1, every=n, stepper=RungeKutta4())
        for n in (50, 110)
    ]
    assert runs[0].status == Status.successful
    assert runs[1].status == Status.singular


def test_runs_of_closed_loops_are_batched():
    loop = four_bar()
    q, v = start(loop, [1.0, -0.5, -1.5], 5.0)

    def end(size):
        return rod.rollout(loop, q, size * v, WEIGHT, step=2e-3, saves=1, every=10).q[-1]

    sizes = jnp.array([0.5, 1.0])
    assert np.allclose(jax.vmap(end)(sizes), [end(x) for x in sizes], atol=1e-12)


def test_a_loop_that_is_open_or_in_contact_is_refused():
    loop = four_bar()
    with pytest.raises(ValueError, match="open by"):
        rod.rollout(loop, jnp.array([1.0, -0.5, -1.5]), jnp.zeros(3), step=1e-3, saves=1)
    with pytest.raises(ValueError, match="without closures"):
        rod.close_loops(rod.assembly(SE2(), bar=rod.Part(bar(A))))


def test_a_loop_that_cannot_close_says_so():
    far = rod.with_closures(
        four_bar(), far=rod.Closure("crank", rod.Spherical(), offset=flat(5.0))
    )
    assert rod.close_loops(far).status == Status.not_converged
