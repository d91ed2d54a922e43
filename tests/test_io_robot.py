"""Robots from files against MuJoCo itself: inertia, bias, motion; what is refused."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sorojax as sj
from sorojax import io, robots, rod as R
from sorojax.math.lie import SE3

pytestmark = pytest.mark.quick

mujoco = pytest.importorskip("mujoco", reason="the extra `robots` is not installed")

ODD = """
<mujoco model="odd">
  <compiler angle="radian" autolimits="true"/>
  <option gravity="0.3 -0.2 -9.6"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="stand" pos="0.1 0 0.2" euler="0.2 0.1 0">
      <geom type="box" size="0.1 0.1 0.05" mass="3"/>
      <body name="arm" pos="0 0 0.1" quat="0.8 0.6 0 0">
        <joint name="yaw" axis="0 0 1" pos="0.01 0.02 0.03" armature="0.02" damping="0.1"/>
        <joint name="slide" type="slide" axis="1 1 0" ref="0.05" stiffness="40" springref="0.1"
               armature="0.3"/>
        <joint name="pitch" axis="0 1 1" pos="0 0 -0.05" ref="0.3" range="-1 2"
               actuatorfrcrange="-5 6"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0.05 0" mass="1.2"/>
        <body name="plate" pos="0.3 0 0" euler="0.4 0 0.3">
          <geom type="ellipsoid" size="0.05 0.04 0.02" mass="0.4"/>
          <site name="tool" pos="0 0.05 0.01" euler="0 0.5 0"/>
          <body name="wrist" pos="0.05 0 0.02">
            <joint name="roll" axis="1 0 0" stiffness="0.4"/>
            <geom type="cylinder" size="0.02 0.05" pos="0.01 0 0" mass="0.3"/>
          </body>
        </body>
      </body>
    </body>
    <body name="drone" pos="1 0 1" euler="0.3 0 0">
      <freejoint name="base"/>
      <geom type="box" size="0.1 0.05 0.02" pos="0.02 0.01 0" mass="0.7"/>
      <body name="tail" pos="-0.1 0 0"><joint name="fin" axis="0 0 1"/>
        <geom size="0.02" pos="-0.1 0.01 0.02" mass="0.1"/></body>
    </body>
  </worldbody>
  <actuator>
    <motor name="turn" joint="yaw" gear="50" ctrlrange="-1 1"/>
    <position name="hold" joint="roll" kp="3" kv="0.2" gear="2" ctrlrange="-0.5 0.5"/>
    <velocity name="run" joint="fin" kv="0.1"/>
  </actuator>
  <keyframe><key name="up" qpos="0.1 0.2 0.3 0.4 1 2 3 0 1 0 0 0.5"/></keyframe>
</mujoco>
"""

BALLS = """
<mujoco model="balls">
  <compiler angle="radian" autolimits="true"/>
  <option gravity="0.3 -0.2 -9.6"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="arm" pos="0.1 0 0.2" euler="0.2 0.1 0">
      <joint name="rail" type="slide" axis="1 0.2 0" armature="0.1"/>
      <joint name="shoulder" type="ball" pos="0.01 0.02 -0.03" damping="0.3" armature="0.02"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0.05 0" mass="1.2"/>
      <body name="forearm" pos="0.3 0 0" euler="0.4 0 0.3">
        <joint name="elbow" axis="0 1 0" damping="0.05"/>
        <geom type="box" size="0.1 0.02 0.03" pos="0.1 0 0" mass="0.5"/>
        <body name="hand" pos="0.2 0.01 0">
          <joint name="wrist" type="ball"/>
          <geom type="ellipsoid" size="0.05 0.04 0.02" pos="0.05 0.01 0" mass="0.3"/>
        </body>
      </body>
    </body>
    <body name="drone" pos="1 0 1" euler="0.3 0 0">
      <freejoint name="base"/>
      <geom type="box" size="0.1 0.05 0.02" pos="0.02 0.01 0" mass="0.7"/>
      <body name="load" pos="0 0.01 -0.1"><joint name="rope" type="ball" damping="0.01"/>
        <geom size="0.02" pos="0.02 0 -0.1" mass="0.1"/></body>
    </body>
  </worldbody>
  <actuator><motor name="lift" jointinparent="shoulder" gear="1 -2 0.5"/>
    <motor name="flex" joint="elbow"/></actuator>
</mujoco>
"""


def row(numbers):
    return " ".join(repr(float(x)) for x in numbers)


def turned(quaternion):
    return Rotation.from_quat(np.roll(quaternion, -1))


def urdf(name):
    """An arm in URDF, with the numbers of its MJCF."""
    model = mujoco.MjModel.from_xml_string(robots.arm_mjcf(name))
    rows = []
    for b in range(1, model.nbody):
        called, mass = model.body(b).name, float(model.body_mass[b])
        turn = turned(model.body_iquat[b]).as_matrix()
        tensor = turn @ np.diag(model.body_inertia[b]) @ turn.T
        places = zip(("xx", "xy", "xz", "yy", "yz", "zz"), *np.triu_indices(3), strict=True)
        entries = " ".join(f'i{key}="{row([tensor[i, j]])}"' for key, i, j in places)
        inner = (
            f'<inertial><origin xyz="{row(model.body_ipos[b])}"/><mass value="{mass}"/>'
            f"<inertia {entries}/></inertial>"
        )
        rows.append(f'<link name="{called}">{inner if mass else ""}</link>')
        if b == 1:
            continue
        moves, joint = model.body_jntnum[b] > 0, model.body_jntadr[b]
        inner = (
            f'<axis xyz="{row(model.jnt_axis[joint])}"/>'
            '<dynamics damping="0.3" friction="0.2"/>'
            '<limit lower="-2" upper="1.5" effort="87" velocity="2"/>'
        )
        rows.append(
            f'<joint name="{called}_joint" type="{"revolute" if moves else "fixed"}">'
            f'<parent link="{model.body(model.body_parentid[b]).name}"/>'
            f'<child link="{called}"/><origin xyz="{row(model.body_pos[b])}" '
            f'rpy="{row(turned(model.body_quat[b]).as_euler("xyz"))}"/>'
            f"{inner if moves else ''}</joint>"
        )
    return f'<robot name="{name}">{"".join(rows)}</robot>'


class Pair:
    """A robot here and in MuJoCo, at one random state."""

    def __init__(self, text, seed=0):
        self.model = model = mujoco.MjModel.from_xml_string(text)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.robot = io.import_robot(text)
        self.data = data = mujoco.MjData(model)
        draw = np.random.default_rng(seed)
        mujoco.mj_integratePos(model, data.qpos, draw.normal(size=model.nv), 1.0)
        data.qvel[:] = draw.normal(size=model.nv)
        self.q, self.v = data.qpos.copy(), data.qvel.copy()
        # rates of ours = turn @ rates of MuJoCo: of a free base they are in another order, and
        # its angular velocity along the ground's axes, that of a ball along those of the
        # joint; both turn about themselves only, so that accelerations are related as rates
        self.turn = np.eye(model.nv)
        mujoco.mj_forward(model, data)
        for joint in np.flatnonzero(model.jnt_type == 1):
            at, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
            own = turned(data.qpos[at : at + 4]).as_matrix()
            self.turn[dof : dof + 3, dof : dof + 3] = own
        for joint in np.flatnonzero(model.jnt_type == 0):
            at, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
            self.q[at : at + 7] = np.roll(self.q[at : at + 7], 4)
            block = np.zeros((6, 6))
            block[:3, 3:] = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3)
            block[3:, :3] = np.eye(3)
            self.turn[dof : dof + 6, dof : dof + 6] = block
        self.q, self.v = jnp.array(self.q), jnp.array(self.turn @ self.v)

    def theirs(self, generalised):
        """A generalised force of ours in the places of theirs."""
        return self.turn.T @ np.asarray(generalised)

    def mass(self):
        found = np.zeros((self.model.nv, self.model.nv))
        for row, unit in zip(found, np.eye(self.model.nv), strict=True):
            mujoco.mj_mulM(self.model, self.data, row, unit)
        return found

    def jacobian(self, body):
        both = np.zeros((2, 3, self.model.nv))
        mujoco.mj_jacBody(self.model, self.data, both[0], both[1], body)
        return both[::-1].reshape(6, -1)


def off(found, wanted):
    return np.abs(np.asarray(found) - wanted).max() / np.abs(wanted).max()


ARMS = ("iiwa7", "ur5e", "gen3")
TEXTS = {name: robots.arm_mjcf(name) for name in ARMS} | {"odd": ODD, "balls": BALLS}


@pytest.fixture(scope="module", params=TEXTS)
def pair(request):
    return Pair(TEXTS[request.param])


def test_inertia_bias_and_jacobians_are_those_of_mujoco(pair):
    model, (q, v), robot = pair.robot.assembly, (pair.q, pair.v), pair.robot
    ours = pair.turn.T @ R.mass_matrix(model, q) @ pair.turn
    assert off(ours, pair.mass()) < 1e-12
    bias = R.bias_force(model, q, v, robot.gravity)
    assert off(pair.theirs(bias), pair.data.qfrc_bias) < 1e-12
    rows = R.jacobian(model, q)
    for body in range(1, pair.model.nbody):
        name = pair.model.body(body).name
        part, pose = robot.frames[name]
        wanted = pair.jacobian(body)
        if part is None or not wanted.any():
            continue
        arm = np.asarray(R.forward_kinematics(model, q)[part][0])[:3, :3] @ pose[:3, 3]
        found = np.array(rows[part][0])
        found[3:] += np.cross(found[:3], arm, axisa=0, axisb=0, axisc=0)
        assert off(found @ pair.turn, wanted) < 1e-12, name


def test_forward_dynamics_with_control_are_those_of_mujoco(pair):
    robot, data = pair.robot, pair.data
    control = np.linspace(-0.3, 0.4, len(robot.actuators))
    data.ctrl[:] = control
    mujoco.mj_forward(pair.model, data)
    forces = (R.Gravity(robot.gravity), *robots.actuator_forces(robot, control))
    a = R.forward_dynamics(robot.assembly, pair.q, pair.v, forces)
    assert off(a, pair.turn @ data.qacc) < 1e-10


def test_places_of_bodies_and_sites_are_those_of_mujoco():
    pair = Pair(ODD)
    poses = R.forward_kinematics(pair.robot.assembly, pair.q)
    for kind, where in (("body", pair.data.xpos), ("site", pair.data.site_xpos)):
        for k in range(len(where)):
            name = getattr(pair.model, kind)(k).name
            if name == "world":
                continue
            part, pose = pair.robot.frames[name]
            found = (np.asarray(poses[part][0]) if part else np.eye(4)) @ pose
            assert np.abs(found[:3, 3] - where[k]).max() < 1e-13, name


def test_tables_of_the_odd_robot():
    robot = Pair(ODD).robot
    assert list(robot.assembly.names) == [
        "stand", "arm:yaw", "arm:slide", "arm", "wrist", "drone", "tail",
    ]  # fmt: skip
    assert robot.joints["pitch"] == "arm" and robot.joints["yaw"] == "arm:yaw"
    assert robot.limits[2].tolist() == [-1, 2] and np.isinf(robot.limits[0]).all()
    assert robot.effort_limits[2].tolist() == [-5, 6]
    assert robot.actuators == ("turn", "hold", "run")
    assert robot.gears[0].tolist() == [50, 0, 0] and float(robot.preload[1]) == 4.0
    assert robot.control_range[:2].tolist() == [[-1, 1], [-0.5, 0.5]]
    assert float(robot.assembly["wrist"].joint.stiffness) == pytest.approx(0.4 + 12)
    up = [0.1, 0.2, 0.3, 0.4, 0, 1, 0, 0, 1, 2, 3, 0.5]
    assert robot.keyframes["up"].tolist() == up
    assert robot.unmapped == () and set(robot.shapes) == set(robot.assembly.names[3:]) | {
        "stand"
    }
    assert "6 joints" in str(robot)


def test_a_urdf_is_its_mjcf():
    """Joints, frames without mass and inertia tensors; what URDF adds."""
    text = urdf("gen3")
    with pytest.warns(UserWarning, match="frictionloss of joint shoulder_link_joint"):
        found = io.import_robot(text)
    same = io.import_robot(robots.arm_mjcf("gen3"))
    q = jnp.linspace(-1, 1, 7)
    masses = [R.mass_matrix(robot.assembly, q) for robot in (found, same)]
    assert off(masses[0], masses[1]) < 1e-9
    assert found.frames["flange"].part == "Bracelet_Link"
    assert found.limits.tolist() == 7 * [[-2, 1.5]]
    assert found.effort_limits.tolist() == 7 * [[-87, 87]]
    assert float(found.assembly["shoulder_link"].joint.damping) == 0.3
    assert found.unmapped[0].startswith("frictionloss")


def test_what_does_not_map_is_listed():
    text = """
    <mujoco><compiler autolimits="true"/><option density="1.2"/>
      <worldbody><site name="top" pos="0 0 1"/>
        <body name="a"><joint name="j" frictionloss="1"/><geom size="0.1" mass="1"/>
          <site name="tip"/>
          <body name="b" gravcomp="1"><joint name="k" type="slide"/><geom size="0.1" mass="1"/>
          </body></body></worldbody>
      <tendon><spatial name="rope"><site site="top"/><site site="tip"/></spatial></tendon>
      <equality><joint name="tied" joint1="j" joint2="k"/></equality>
      <actuator><motor name="pull" tendon="rope"/>
        <general name="slow" joint="j" dyntype="filter" dynprm="0.1"/>
        <position name="servo" joint="k" kp="2" forcerange="-1 1"/></actuator>
      <sensor><jointpos name="seen" joint="j"/></sensor>
    </mujoco>"""
    with pytest.warns(UserWarning, match="tendon rope; "):
        robot = io.import_robot(text)
    assert set(robot.unmapped) == {
        "frictionloss of joint j", "actuator pull", "actuator slow", "equality tied",
        "forcerange of actuator servo", "tendon rope", "gravcomp of body b",
        "fluid of option", "sensor seen", "contact of 2 geoms",
    }  # fmt: skip
    assert robot.actuators == ("servo",)


def test_of_a_ball_joint_springs_ranges_and_turning_motors_are_listed():
    text = """
    <mujoco><compiler autolimits="true"/><worldbody><body><joint name="hip" type="ball"
      stiffness="2" range="0 30" frictionloss="0.1"/><geom size="0.1" pos="0.1 0 0"
      contype="0" conaffinity="0"/></body></worldbody>
      <actuator><motor name="own" joint="hip" gear="1 0 0"/>
        <motor name="held" jointinparent="hip" gear="1 0 2"/>
        <velocity name="slow" jointinparent="hip" kv="1"/></actuator></mujoco>"""
    with pytest.warns(UserWarning, match="range of joint hip"):
        robot = io.import_robot(text)
    assert set(robot.unmapped) == {
        "frictionloss of joint hip", "stiffness of joint hip", "range of joint hip",
        "actuator own", "actuator slow",
    }  # fmt: skip
    assert robot.actuators == ("held",) and robot.gears.T.tolist() == [[1, 0, 2]]
    assert robot.rest.tolist() == [1, 0, 0, 0]
    with pytest.raises(ValueError, match="a free base or a ball joint, need hinges"):
        robots.computed_torque(robot, lambda t: robot.rest, 0.0, robot.rest, jnp.zeros(3))


def test_a_spherical_joint_of_a_urdf():
    """A type of its own of Bullet and MuJoCo; URDF itself has none."""
    text = """<robot name="r"><link name="a"/><link name="b"><inertial><mass value="1"/>
      <inertia ixx="1" iyy="2" izz="2" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="hip" type="spherical"><parent link="a"/><child link="b"/>
      <dynamics damping="0.3"/></joint></robot>"""
    robot = io.import_robot(text)
    assert float(robot.assembly["b"].joint.damping) == 0.3 and robot.unmapped == ()
    assert R.mass_matrix(robot.assembly, robot.rest).tolist() == np.diag([1, 2, 2]).tolist()


def test_meshes_make_pictures_and_may_be_left_out(tmp_path):
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    sj.io.export_surface(tmp_path / "tet.stl", sj.sdf.Surface(corners, faces), unit=1.0)
    text = """<mujoco><asset><mesh name="m" file="tet.stl"/></asset><worldbody>
      <body name="a" pos="0 0 1"><joint/><geom type="mesh" mesh="m" pos="0.2 0 0"/>{}</body>
      </worldbody></mujoco>"""
    (tmp_path / "bare.xml").write_text(text.format(""))
    robot = io.import_robot(tmp_path / "bare.xml")
    seen = np.asarray(robot.shapes["a"].vertices)
    assert np.abs(np.sort(seen, axis=0) - np.sort(corners + [0.2, 0, 0], axis=0)).max() < 1e-7
    assert float(robot.assembly["a"].body.mass) == pytest.approx(1e3 * 1e-3 / 6)
    with pytest.raises(ValueError, match="`a` has its mass from a mesh"):
        io.import_robot(tmp_path / "bare.xml", meshes=False)
    inertia = '<inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>'
    robot = io.import_robot(text.format(inertia), meshes=False)
    assert float(robot.assembly["a"].body.mass) == 2 and not robot.shapes
    with pytest.raises(ValueError, match="leads to"):
        io.import_robot("../bare.xml", root=tmp_path)


def test_what_cannot_be_read_says_what_to_do():
    with pytest.raises(ValueError, match="MuJoCo refuses the file"):
        io.import_robot("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    with pytest.raises(ValueError, match="no joint and no mass"):
        io.import_robot("<mujoco/>")


def test_soft_parts_stand_on_named_bodies():
    robot = Pair(ODD).robot
    finger = R.rod(
        SE3(), R.chebyshev(kappa_y=1), R.circle(6e-3), length=0.1, nodes=6,
        young_modulus=1e6, poisson_ratio=0.5, density=1e3,
    )  # fmt: skip
    parts = dict(
        finger=R.Part(finger, on="tool"), nail=R.Part(R.Link(0.1, np.ones(3)), on="finger")
    )
    whole = robots.mount(robot, **parts)
    assert whole["finger"].on == "arm" and whole["nail"].on == "finger"
    assert np.abs(whole["finger"].offset - robot.frames["tool"].pose).max() == 0
    with pytest.raises(ValueError, match="is on `hand`, need one of stand, arm"):
        robots.mount(robot, finger=dataclasses.replace(parts["finger"], on="hand"))
    with pytest.raises(ValueError, match="has a part `arm`"):
        robots.mount(robot, arm=parts["finger"])


def test_armature_costs_nothing_where_there_is_none():
    def bill(armature):
        link = R.Part(R.Link(1.0, np.ones(3)), R.Revolute(armature=armature))
        model = R.assembly(SE3(), a=link)
        return len(jax.make_jaxpr(lambda q: R.inertia(R.motion(model, q)))(jnp.ones(1)).eqns)

    assert bill(None) < bill(0.1)


def test_wrenches_leave_the_rotor_to_its_carrier():
    hinge = R.Revolute(armature=0.3)
    model = R.assembly(SE3(), a=R.Part(R.Link(1.0, np.ones(3)), hinge))
    one, a = jnp.ones(1), jnp.array([2.0])
    needed = R.inverse_dynamics(model, one, one, a)
    seen = R.joint_wrenches(model, one, one, a)["a"][2]
    assert float(needed[0] - seen) == pytest.approx(0.3 * 2.0)


def test_an_arm_is_refused_that_is_unknown():
    with pytest.raises(ValueError, match="need one of 'iiwa7', 'ur5e', 'gen3'"):
        robots.arm_mjcf("puma")
