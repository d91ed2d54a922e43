"""Rods and assemblies as chains, checked in MuJoCo itself: tip, lowest frequency, motion."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from benchmarks.cases.robots_export import balanced, lowest
from sorojax import io, rod as R
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.rod.model.assembly import retract

mujoco = pytest.importorskip("mujoco", reason="the extra `robots` is not installed")

SOFT = dict(length=0.12, young_modulus=1e6, poisson_ratio=0.4, density=1000.0)
TURN = homogeneous(
    jnp.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]), jnp.array([0, 0, 0.3])
)


def straight():
    basis = R.chebyshev(kappa_x=1, kappa_y=3, kappa_z=3, sigma_x=1)
    return R.rod(SE3(), basis, R.ellipse(7e-3, 5e-3), **SOFT), (), [0, 2e-3, 0, 0, 8e-3, -4e-3]


def curved():
    """A tapered hook that is twisted at rest."""
    made = R.rod(
        SE3(), R.chebyshev(kappa_x=2, kappa_y=4, kappa_z=4), R.taper(R.circle, 8e-3, 5e-3),
        rest_strain=[4.0, 3.0, 12.0, 1.0, 0, 0], **SOFT,
    )  # fmt: skip
    return made, (), [0, 0, 0, 4e-3, 2e-3, 8e-3]


def planar():
    made = R.rod(SE2(), R.bernstein(kappa_z=4, sigma_x=1, sigma_y=1), R.circle(6e-3), **SOFT)
    return made, (), [1e-3, 4e-3, -5e-3]


def reduced():
    """Its law is not that of its section, as one that is identified from a solid."""
    made, _, load = straight()
    law = R.LinearElastic(np.asarray(R.stiffness_matrix(made)) * 1.7)
    return made, (law,), load


RODS = {f.__name__: f for f in (straight, curved, planar, reduced)}


def spatial(wrench):
    """A wrench or place of the plane in space."""
    wrench = np.asarray(wrench)
    if len(wrench) == 3:
        return np.array([0, 0, wrench[0], wrench[1], wrench[2], 0])
    return wrench


@pytest.fixture(scope="module", params=RODS)
def chain(request, tmp_path_factory):
    made, laws, load = RODS[request.param]()
    path = tmp_path_factory.mktemp("mjcf") / "rod.xml"
    found = io.export_mjcf(path, made, (R.Gravity(), R.Damping(0.02), *laws), segments=12)
    return made, laws, load, found, mujoco.MjModel.from_xml_path(str(path))


@pytest.mark.parametrize("pulled", [0.0, 1.0])
def test_the_tip_rests_where_that_of_the_rod_does(chain, pulled):
    made, laws, load, _, model = chain
    load = pulled * np.array(load)
    dim = made.group.space_dim
    rest = R.equilibrium(made, (R.Gravity(), R.TipWrench(load), *laws))
    start, tip = (
        np.pad(np.asarray(R.tip_pose(made, q)[:dim, dim]), (0, 3 - dim))
        for q in (0 * rest.q, rest.q)
    )
    found = balanced(model, mujoco.MjData(model), model.site("rod_tip").id, spatial(load))
    assert np.linalg.norm(tip - start) > 0.04 * SOFT["length"]
    assert np.linalg.norm(found - tip) < 0.02 * np.linalg.norm(tip - start)


def test_the_lowest_frequency_is_that_of_the_rod(chain):
    made, laws, _, found, model = chain
    fit = found.chains["rod"]
    zero = jnp.zeros(made.basis.num_dof)
    stiffness = laws[0].stiffness if laws else R.stiffness_matrix(made)
    mass = R.mass_matrix(made, zero)
    value = scipy.linalg.eigh(stiffness, mass, eigvals_only=True)[0]
    assert fit.frequency == pytest.approx(np.sqrt(value) / (2 * np.pi), rel=1e-6)
    assert lowest(model) == pytest.approx(fit.frequency, rel=0.05)
    assert lowest(model) == pytest.approx(fit.chain_frequency, rel=1e-6)
    assert found.unmapped == ()


def test_mass_is_that_of_the_rod(chain):
    made, model = chain[0], chain[-1]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass = R.operators(made).mass
    assert model.body_mass.sum() == pytest.approx(float(mass.sum()), rel=1e-9)
    position = R.motion(made, jnp.zeros(made.basis.num_dof)).position
    center = np.asarray(mass @ position / mass.sum())
    assert data.subtree_com[0][: len(center)] == pytest.approx(center, abs=1e-7)


def test_it_falls_as_the_rod_does(tmp_path):
    """Weight and damper: the tip over 0.2 s, from rest."""
    made, _, _ = straight()
    forces = R.Gravity(), R.Damping(0.01)
    io.export_mjcf(tmp_path / "rod.xml", made, forces, segments=10)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "rod.xml"))
    data, tips = mujoco.MjData(model), []
    zero = jnp.zeros(made.basis.num_dof)
    path = R.rollout(made, zero, zero, forces, step=1e-3, saves=10, every=20)
    for time in path.time[1:]:
        while data.time < float(time) - model.opt.timestep / 2:
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        tips.append(data.site_xpos[0].copy())
    ours = np.stack([R.tip_pose(made, q)[:3, 3] for q in path.q[1:]])
    drop = np.abs(ours - [SOFT["length"], 0, 0]).max()
    assert drop > 0.1 * SOFT["length"]
    assert np.abs(np.stack(tips) - ours).max() < 0.03 * drop


@pytest.fixture(scope="module")
def arm():
    """A sprung arm with a finger at its end, a nail on the finger, and a ball that is free."""
    finger = straight()[0]
    link = R.Link(0.3, np.diag([1e-4, 4e-4, 4e-4]) + 1e-5, [0.08, 0.0, 0.01])
    hinge = R.Revolute([0.0, 1.0, 0.2], stiffness=2.0, damping=0.02, armature=3e-4)
    slide = R.Prismatic([0.0, 0.0, 1.0], stiffness=80.0)
    here = homogeneous(jnp.eye(3), jnp.array([0.15, 0.0, 0.01]))
    return R.assembly(
        SE3(),
        mast=R.Part(R.Link(1.0, np.ones(3)), offset=TURN),
        arm=R.Part(link, hinge, on="mast", offset=here),
        finger=R.Part(finger, on="arm", offset=here),
        nail=R.Part(R.Link(2e-3, 1e-7 * np.ones(3)), slide, on="finger", s=0.7, offset=here),
        ball=R.Part(R.Link(0.05, 1e-5 * np.ones(3)), R.Free(), offset=TURN),
    )


def test_an_arm_with_a_finger_hangs_as_it_does_here(arm, tmp_path):
    forces = R.Gravity(), R.Damping(0.02)
    found = io.export_mjcf(tmp_path / "arm.xml", arm, forces, segments=12)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    assert found.unmapped == () and list(found.chains) == ["finger"]
    assert model.joint("arm").stiffness[0] == 2 and model.dof_armature[0] == pytest.approx(3e-4)
    fixed = R.Assembly(arm.group, arm.names[:-1], arm.parts[:-1])  # the ball would fall
    rest = R.equilibrium(fixed, (R.Gravity(),))
    poses = [R.tip_pose(fixed, q) for q in (R.rest(fixed), rest.q)]
    spec = mujoco.MjSpec.from_file(str(tmp_path / "arm.xml"))
    spec.delete(spec.body("ball"))
    model = spec.compile()
    data = mujoco.MjData(model)
    found = balanced(model, data, model.site("finger_tip").id, np.zeros(6))
    for name, place in (("finger", found), ("nail", data.body("nail").xpos)):
        start, tip = (np.asarray(pose[name][:3, 3]) for pose in poses)
        assert np.linalg.norm(place - tip) < 0.02 * np.linalg.norm(tip - start), name
    zero = R.rest(fixed)
    values = scipy.linalg.eigh(
        R.stiffness_matrix(fixed), R.mass_matrix(fixed, zero), eigvals_only=True
    )
    assert lowest(model) == pytest.approx(np.sqrt(values[0]) / (2 * np.pi), rel=0.05)


@pytest.mark.parametrize("group", [SE2(), SE3()])
def test_a_ball_joint_goes_out_and_comes_back(group, tmp_path):
    dim = group.space_dim
    link = R.Link(0.3, 1e-3 if dim == 2 else [1e-3, 2e-3, 2e-3], [0.1, *np.zeros(dim - 1)])
    ball = R.Part(link, R.Spherical(damping=0.2, armature=0.05))
    model = R.assembly(group, arm=ball, hand=dataclasses.replace(ball, on="arm"))
    made = io.export_mjcf(tmp_path / "ball.xml", model, (R.Gravity(),))
    assert made.unmapped == () and made.text.count('type="ball"') == 2 * (dim - 2)
    back = io.import_robot(made.text).assembly
    q = retract(model, R.rest(model), jnp.linspace(-0.5, 1, R.num_dof(model)))
    assert np.allclose(R.mass_matrix(back, q), R.mass_matrix(model, q), rtol=1e-10)
    rates = jnp.arange(1.0, 1 + R.num_dof(model))
    a, b = (R.inverse_dynamics(x, q, rates, 0 * rates) for x in (model, back))
    assert np.allclose(a, b, rtol=1e-9, atol=1e-12)


def test_what_the_file_has_not_is_named(arm, tmp_path):
    forces = (
        R.Gravity(), R.PartForce("finger", R.TipWrench(np.ones(6))), R.JointEffort("arm", [1.0])
    )  # fmt: skip
    found = io.export_mjcf(tmp_path / "arm.xml", arm, forces, segments=4)
    assert found.unmapped == ("TipWrench on finger", "JointEffort")
    stiff = R.rod(SE2(), R.chebyshev(kappa_z=1), R.circle(6e-3), **SOFT)
    found = io.export_mjcf(tmp_path / "rod.xml", stiff)
    assert found.unmapped[0].startswith("lowest frequency of rod: ")
    with pytest.raises(ValueError, match="joint of `bolt` is a Screw, need Fixed"):
        bolt = R.assembly(SE3(), bolt=R.Part(R.Link(1.0, np.ones(3)), R.Screw(1.0, 0.1)))
        io.export_mjcf(tmp_path / "bolt.xml", bolt)
    with pytest.raises(ValueError, match="`segments` is 1, need 2"):
        io.export_mjcf(tmp_path / "rod.xml", stiff, segments=1)
