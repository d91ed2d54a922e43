"""What joints carry: against momenta, efforts and statics, of trees and of single rods."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import rod as R
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.rod.dynamics.points import moment_of
from sorojax.rod.model.assembly import rate, retract

SOFT = dict(length=0.08, nodes=10, young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
DOWN = jnp.array([1.0, 2.0, -9.81])
PUSH = jnp.array([0.01, -0.02, 0.03, 0.4, 0.2, -0.3])


def spatial():
    """A palm that floats, a finger on a sprung hinge, a nail on a slide along it."""
    inertia = jnp.array([[3e-6, 1e-7, 0], [1e-7, 5e-6, 2e-7], [0, 2e-7, 4e-6]])
    link = R.Link(0.02, inertia, [0.005, 0.002, -0.003])
    finger = R.rod(SE3(), R.chebyshev(kappa_y=1, kappa_z=2, sigma_x=1), R.circle(6e-3), **SOFT)
    here = homogeneous(jnp.eye(3), jnp.array([0.01, 0.02, -0.01]))
    hinge = R.Revolute([1.0, 2.0, 3.0], stiffness=0.1, damping=1e-3)
    model = R.assembly(
        SE3(),
        palm=R.Part(link, R.Free()),
        finger=R.Part(finger, hinge, on="palm", offset=here),
        nail=R.Part(link, R.Prismatic([0.0, 1.0, 1.0]), on="finger", s=0.6, offset=here),
    )
    return model, (R.Gravity(DOWN), R.PartForce("finger", R.TipWrench(PUSH)))


def planar():
    finger = R.rod(SE2(), R.chebyshev(kappa_z=2, sigma_x=1), R.circle(6e-3), **SOFT)
    model = R.assembly(
        SE2(),
        finger=R.Part(finger, R.Revolute()),
        nail=R.Part(R.Link(0.02, 1e-5, [0.0, 0.01]), R.Revolute(damping=1e-3), on="finger"),
    )
    wrench = R.TipWrench(PUSH[jnp.array([2, 3, 4])])
    return model, (R.Gravity(DOWN[1:]), R.PartForce("finger", wrench))


@eqx.filter_jit
def everything(model, forces, q, v, a):
    momenta, change = jax.jvp(
        lambda q, v: R.part_momenta(model, q, v), (q, v), (rate(model, q, v), a)
    )
    return dict(
        wrenches=R.joint_wrenches(model, q, v, a, forces),
        change=change,
        momenta=momenta,
        whole=R.momentum(model, q, v),
        efforts=R.inverse_dynamics(model, q, v, a, forces),
        rows=R.jacobian(model, q, [0.0, 1.0]),
        poses=R.forward_kinematics(model, q, [0.0, 1.0]),
    )


@pytest.fixture(scope="module", params=[spatial, planar])
def found(request):
    model, forces = request.param()
    rng, dof = np.random.default_rng(0), R.num_dof(model)
    moved, v, a = (jnp.array(k * rng.normal(size=dof)) for k in (0.3, 3.0, 30.0))
    q = retract(model, R.rest(model), moved)
    return model, forces, (q, v, a), everything(model, forces, q, v, a)


def about_ground(wrench, origin):
    """A wrench moved from `origin` to that of the ground."""
    rot = wrench.shape[0] - origin.shape[0]
    moment = moment_of(np.asarray(origin)[None], wrench[None, rot:])[0]
    return np.concatenate([wrench[:rot] + moment, wrench[rot:]])


def test_newton_and_euler_hold_for_every_part(found):
    """Momenta, differentiated in time, against joints, weight and loads, about one point."""
    model, forces, (q, v, a), seen = found
    g = np.asarray(forces[0].acceleration)
    scale = max(np.abs(x).max() for x in seen["change"].values())
    for name in model.names:
        at = {n: np.asarray(x)[0, :-1, -1] for n, x in seen["poses"].items()}
        total = about_ground(seen["wrenches"][name], at[name])
        for other, carried in zip(model.names, model.parts, strict=True):
            if carried.on == name:
                total = total - about_ground(seen["wrenches"][other], at[other])
        total = total + about_ground(*weight_of(model, q, name, g))
        if name == forces[1].part:
            tip = np.asarray(seen["poses"][name])[-1, :-1, -1]
            total = total + about_ground(np.asarray(forces[1].force.wrench), tip)
        assert np.abs(total - seen["change"][name]).max() < 1e-12 * scale


def weight_of(model, q, name, g):
    """Weight of a part, and where it acts: the place of its centre of mass."""
    here = R.part_motion(R.motion(model, q), model.names.index(name))
    mass = np.asarray(here.operators.mass)
    centre = mass @ np.asarray(here.position) / mass.sum()
    still = np.zeros(model.group.rotation_dim)
    return np.concatenate([still, mass.sum() * g]), centre


def test_efforts_are_what_wrenches_do_along_the_axes(found):
    model, _, (q, v, _), seen = found
    for name, part, at in zip(model.names, model.parts, R.slices(model), strict=True):
        along = seen["rows"][name][0][:, at.joint_v].T @ seen["wrenches"][name]
        spring = part.joint.effort(q[at.joint_q], v[at.joint_v])
        needed = seen["efforts"][at.joint_v] + (0.0 if spring is None else spring)
        assert jnp.abs(along - needed).max() < 1e-12 * jnp.abs(needed).max()


def test_momenta_of_parts_add_up(found):
    total = sum(found[3]["momenta"].values())
    assert jnp.abs(total - found[3]["whole"]).max() < 1e-13 * jnp.abs(total).max()


def test_a_clamp_bears_the_weight_at_its_arm_and_what_pulls_at_the_tip():
    finger = spatial()[0]["finger"].body
    q, still = jnp.array([5.0, -4.0, 3.0, 0.02]), jnp.zeros(4)
    forces = R.Gravity(DOWN), R.TipWrench(PUSH), R.Damping(0.01)
    seen = R.joint_wrenches(finger, q, still, still, forces)
    here = R.motion(finger, q)
    mass = np.asarray(here.operators.mass)
    loads = about_ground(
        np.append(np.zeros(3), mass.sum() * DOWN), mass @ here.position / mass.sum()
    )
    loads = loads + about_ground(PUSH, R.tip_pose(finger, q)[:3, 3])
    assert np.abs(seen + loads).max() < 1e-13 * np.abs(loads).max()


def test_a_clamp_in_motion_is_that_of_the_same_rod_as_a_part():
    finger = spatial()[0]["finger"].body
    state = jnp.array([5.0, -4.0, 3.0, 0.02]), jnp.array([1.0, 2, -3, 0.1]), jnp.ones(4)
    alone = R.joint_wrenches(finger, *state, (R.Gravity(),))
    model = R.assembly(
        SE3(), base=R.Part(R.Link(1.0, [1.0, 1.0, 1.0])), rod=R.Part(finger, on="base")
    )
    assert jnp.allclose(
        alone, R.joint_wrenches(model, *state, (R.Gravity(),))["rod"], rtol=1e-13
    )


def test_a_force_without_a_part_is_refused():
    model, _ = planar()
    with pytest.raises(ValueError, match="names no part"):
        zero = jnp.zeros(R.num_dof(model))
        R.joint_wrenches(model, zero, zero, zero, (R.TipWrench(PUSH[:3]),))
