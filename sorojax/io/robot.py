"""Robots from files in MJCF or URDF, with MuJoCo as the parser."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sorojax import _check
from sorojax.io._files import inside
from sorojax.io._mujoco import parser
from sorojax.math.lie import SE3
from sorojax.robots import BodyFrame, ImportedRobot
from sorojax.rod import (
    AbstractJoint,
    Assembly,
    Fixed,
    Free,
    Link,
    Part,
    Prismatic,
    Revolute,
    Spherical,
    num_coordinates,
    num_dof,
)
from sorojax.sdf import Surface

Pose = Float[np.ndarray, "4 4"]
_WHERE = "import_robot"
_FREE, _BALL, _SLIDE, _HINGE = range(4)  # numbers of MuJoCo, as those below
_IN_JOINT, _IN_PARENT = 0, 1  # the frame of an actuator's axis
_QUIET = "contact", "sensor"


def import_robot(
    source: str | os.PathLike,
    *,
    meshes: bool = True,
    root: str | os.PathLike | None = None,
) -> ImportedRobot:
    """A robot of rigid links from a file or a text in MJCF or URDF.

    Every joint becomes a part: its link holds all bodies that are welded together, with the
    mass, the centre and the inertia of the whole; a body with several joints becomes a chain
    of frames without mass. Springs, dampers and armature go to the joints, and so does what a
    position or velocity servo adds to them; motors, gears, limits, keyframes, named bodies
    and sites are told beside. Coordinates keep order and zero of the file, but of a free
    base, whose quaternion comes before its position. Rates of a ball joint or a free base are
    along the axes of the joint frame, where MuJoCo turns those of rotation with the body.
    Geoms are pictures: contact is put on by `rod.LinkContact` and `rod.LinkObstacle`.

    Args:
        source: Name of a file, or its text (all that has a "<").
        meshes: Whether to read the files of meshes; without them nothing of a mesh is drawn,
            and bodies need inertias of their own.
        root: Folder that a file must lie in; any by default.

    Returns:
        The robot: assembly, joints, actuators, frames and pictures; what it has not is named
        in `unmapped`, with a warning where that moves.

    Raises:
        ModuleNotFoundError: If MuJoCo is missing.
        ValueError: If MuJoCo refuses the text, or nothing of it has a mass.

    Example:
        >>> pendulum = '''<mujoco><worldbody><body name="bob"><joint name="hinge" axis="0 1 0"/>
        ...   <geom size="0.02" pos="0 0 -0.5" mass="1"/></body></worldbody></mujoco>'''
        >>> robot = io.import_robot(pendulum)
        >>> print(f"{float(rod.mass_matrix(robot.assembly, jnp.zeros(1))[0, 0]):.5f} kg m^2")
        0.25016 kg m^2
        >>> robot.joints, robot.unmapped
        ({'hinge': 'bob'}, ('contact of 1 geoms',))

    Reference:
        The MuJoCo documentation, XML reference, for what the entries mean.
    """
    model = _compiled(source, meshes, root)
    tree = _Tree(model)
    for body in range(1, model.nbody):
        tree.add(body)
    assembly = tree.assembly()
    unmapped = tuple(_unmapped(model))
    loud = [name for name in unmapped if not name.startswith(_QUIET)]
    if loud:
        _check.warn(
            f"{_WHERE}: the assembly has not: {'; '.join(loud)}. It moves without them."
        )
    return ImportedRobot(
        assembly,
        joints=tree.joints,
        **_joint_table(model, assembly),
        **_actuator_table(model),
        rest=_coordinates(model, model.qpos0),
        keyframes={
            _name(model, "key", k): _coordinates(model, model.key_qpos[k])
            for k in range(model.nkey)
        },
        gravity=jnp.array(model.opt.gravity),
        frames=tree.frames(),
        shapes=tree.shapes(),
        unmapped=unmapped,
    )


def _compiled(source: str | os.PathLike, meshes: bool, root: Any) -> Any:
    """The model of MuJoCo, with frames and pictures that it would drop of a URDF."""
    mujoco = parser(_WHERE)
    is_text = isinstance(source, str) and "<" in source
    path = None if is_text else inside(_WHERE, source, root)
    text = str(source) if path is None else Path(path).read_text()
    try:
        if path is None:
            spec = mujoco.MjSpec.from_string(text)
        else:
            spec = mujoco.MjSpec.from_file(str(path))
        if "<robot" in text:
            spec.compiler.fusestatic = False
            spec.compiler.discardvisual = False
        if not meshes:
            _drop_meshes(mujoco, spec)
        return spec.compile()
    except ValueError as error:
        raise ValueError(
            f"{_WHERE}: MuJoCo refuses the file: {error}. Correct it there; with meshes=False "
            "files of meshes are not looked for."
        ) from error


def _drop_meshes(mujoco: Any, spec: Any) -> None:
    def drop(entry: Any) -> None:  # by itself until MuJoCo 3.3
        entry.delete() if hasattr(entry, "delete") else spec.delete(entry)

    for body in spec.bodies:
        drawn = [geom for geom in body.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH]
        if drawn and not body.explicitinertial and body.name != "world":
            raise ValueError(
                f"the body `{body.name}` has its mass from a mesh; read the meshes, or give it "
                "an inertial"
            )
        for geom in drawn:
            drop(geom)
    for mesh in list(spec.meshes):
        drop(mesh)


class _Mass(NamedTuple):
    """A body: mass [kg], centre [m] and inertia about it [kg m^2], in the frame of a part."""

    mass: float
    center: np.ndarray
    inertia: np.ndarray


class _Tree:
    """The parts of the assembly, as bodies of the model are added in their order."""

    def __init__(self, model: Any):
        self.model, self.joints = model, {}
        self.parts: dict[str, tuple[AbstractJoint, str | None, Pose | None]] = {}
        self.masses: dict[str, list[_Mass]] = {}
        self.carried: list[tuple[str | None, Pose]] = [(None, np.eye(4))]
        drawn = [b for b in range(model.nbody) if model.body_weldid[b] == 0 and self._shows(b)]
        self.ground = _name(model, "body", drawn[0]) if drawn else None
        if self.ground is not None:
            self._part(self.ground, Fixed(), None, None)
            self.carried = [(self.ground, np.eye(4))]

    def _shows(self, body: int) -> bool:
        return self.model.body_mass[body] > 0 or bool(self._solids(body))

    def _solids(self, body: int) -> list[int]:
        """Geoms with triangles."""
        first, count = self.model.body_geomadr[body], self.model.body_geomnum[body]
        every = range(first, first + count)
        return [geom for geom in every if self.model.geom_type[geom] in _SOLIDS]

    def _part(self, name: str, joint: AbstractJoint, on: str | None, offset: Pose | None):
        self.parts[name], self.masses[name] = (joint, on, offset), []

    def add(self, body: int) -> None:
        """A body, its joints and its mass."""
        model, name = self.model, _name(self.model, "body", body)
        on, at = self.carried[model.body_parentid[body]]
        at = at @ _pose(model.body_pos[body], model.body_quat[body])
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        for joint in range(first, first + count):
            called = _name(model, "joint", joint)
            part = name if joint == first + count - 1 else f"{name}:{called}"
            made, offset, at = _joint(model, joint, at)
            self._part(part, made, on, offset)
            self.joints[called], on = part, part
        self.carried.append((on, at))
        if on is not None and model.body_mass[body] > 0:
            own = at @ _pose(model.body_ipos[body], model.body_iquat[body])
            moments = own[:3, :3] @ np.diag(model.body_inertia[body]) @ own[:3, :3].T
            self.masses[on].append(_Mass(float(model.body_mass[body]), own[:3, 3], moments))

    def assembly(self) -> Assembly:
        if not self.parts:
            raise ValueError(f"{_WHERE}: the file has no joint and no mass, need a body.")
        parts = [
            Part(_link(self.masses[name]), joint, on=on, offset=offset)
            for name, (joint, on, offset) in self.parts.items()
        ]
        return Assembly(SE3(), tuple(self.parts), tuple(parts))

    def frames(self) -> dict[str, BodyFrame]:
        """Bodies, then sites."""
        model = self.model
        found = {
            _name(model, "body", body): BodyFrame(*self.carried[body])
            for body in range(1, model.nbody)
        }
        for site in range(model.nsite):
            part, at = self.carried[model.site_bodyid[site]]
            own = at @ _pose(model.site_pos[site], model.site_quat[site])
            found.setdefault(_name(model, "site", site), BodyFrame(part, own))
        return found

    def shapes(self) -> dict[str, Surface]:
        """Triangles of each part: of geoms that touch nothing, where it has some."""
        model, by_part = self.model, {}
        for body in range(model.nbody):
            part, at = self.carried[body]
            for geom in self._solids(body):
                by_part.setdefault(part, []).append((geom, at))
        found = {}
        for part, geoms in by_part.items():
            seen = [pair for pair in geoms if not _touches(model, pair[0])] or geoms
            pieces = []
            for geom, at in seen:
                corners, triangles = _SOLIDS[model.geom_type[geom]](model, geom)
                own = at @ _pose(model.geom_pos[geom], model.geom_quat[geom])
                pieces.append((corners @ own[:3, :3].T + own[:3, 3], triangles))
            found[part] = _one_surface(pieces)
        return found


def _joint(model: Any, joint: int, at: Pose) -> tuple[AbstractJoint, Pose | None, Pose]:
    """A joint of a body that stands `at` on its carrier: the joint, the offset of its frame,
    and where the body is in the frame that it moves."""
    kind, axis, place = model.jnt_type[joint], model.jnt_axis[joint], model.jnt_pos[joint]
    if kind == _FREE:
        return Free(), None, np.eye(4)
    if kind == _BALL:
        dof = model.jnt_dofadr[joint]
        numbers = dict(damping=model.dof_damping[dof], armature=model.dof_armature[dof])
        given = {key: float(value) for key, value in numbers.items() if value}
        return Spherical(**given), at @ _moved(place), _moved(-place)
    dof, zero = model.jnt_dofadr[joint], float(model.qpos0[model.jnt_qposadr[joint]])
    stiffness, damping = (float(x) for x in _spring(model, joint))
    armature = float(model.dof_armature[dof])
    options = dict(
        axis=axis,
        stiffness=stiffness if stiffness else None,
        damping=damping if damping else None,
        armature=armature if armature else None,
    )
    if kind == _SLIDE:
        return Prismatic(**options), at @ _moved(-zero * axis), np.eye(4)
    turn = np.eye(4)
    turn[:3, :3] = _turn(np.append(np.cos(zero / 2), -np.sin(zero / 2) * axis))
    return Revolute(**options), at @ _moved(place) @ turn, _moved(-place)


def _spring(model: Any, joint: int) -> np.ndarray:
    """Stiffness and damping of a joint with its servos."""
    dof = model.jnt_dofadr[joint]
    own = np.array([model.jnt_stiffness[joint], model.dof_damping[dof]])
    for actuator in _mapped(model):
        if model.actuator_trnid[actuator, 0] == joint:
            gear = model.actuator_gear[actuator, 0]
            own -= gear**2 * _bias(model, actuator)[1:]
    return own


def _link(masses: list[_Mass]) -> Link:
    """One link of bodies that are welded together."""
    mass = sum(one.mass for one in masses)
    if mass == 0:
        return Link(0.0, np.zeros(3))
    center = sum((one.mass * one.center for one in masses), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for one in masses:
        arm = one.center - center
        inertia += one.inertia + one.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Link(mass, inertia, center)


# Tables of joints and actuators


def _joint_table(model: Any, assembly: Assembly) -> dict[str, Any]:
    """Limits of coordinates and efforts."""
    limits = np.tile([-np.inf, np.inf], (num_coordinates(assembly), 1))
    efforts = np.tile([-np.inf, np.inf], (num_dof(assembly), 1))
    for joint in _axial(model):
        if model.jnt_limited[joint]:
            limits[model.jnt_qposadr[joint]] = model.jnt_range[joint]
        if model.jnt_actfrclimited[joint]:
            efforts[model.jnt_dofadr[joint]] = model.jnt_actfrcrange[joint]
    return dict(limits=jnp.array(limits), effort_limits=jnp.array(efforts))


def _actuator_table(model: Any) -> dict[str, Any]:
    """Gears, preload and ranges of control."""
    every = _mapped(model)
    gears, preload = np.zeros((model.nv, len(every))), np.zeros(model.nv)
    span = np.tile([-np.inf, np.inf], (len(every), 1))
    for joint in _axial(model):
        rest = model.qpos_spring[model.jnt_qposadr[joint]]
        preload[model.jnt_dofadr[joint]] = model.jnt_stiffness[joint] * rest
    for column, actuator in enumerate(every):
        joint = model.actuator_trnid[actuator, 0]
        width = 3 if model.jnt_type[joint] == _BALL else 1
        dofs = slice(model.jnt_dofadr[joint], model.jnt_dofadr[joint] + width)
        gear, gain = model.actuator_gear[actuator, :width], model.actuator_gainprm[actuator, 0]
        gears[dofs, column] = gear * gain
        preload[dofs] += gear * _bias(model, actuator)[0]
        if model.actuator_ctrllimited[actuator]:
            span[column] = model.actuator_ctrlrange[actuator]
        if model.actuator_forcelimited[actuator] and not _bias(model, actuator).any():
            allowed = np.sort(model.actuator_forcerange[actuator] / gain)
            span[column] = np.clip(span[column], *allowed)
    names = tuple(_name(model, "actuator", actuator) for actuator in every)
    return dict(
        actuators=names,
        gears=jnp.array(gears),
        preload=jnp.array(preload),
        control_range=jnp.array(span),
    )


def _bias(model: Any, actuator: int) -> np.ndarray:
    """Force of an actuator without control: constant, per length and per speed."""
    affine = model.actuator_biastype[actuator] == 1
    return model.actuator_biasprm[actuator, :3] if affine else np.zeros(3)


def _axial(model: Any) -> list[int]:
    return [joint for joint in range(model.njnt) if model.jnt_type[joint] in (_SLIDE, _HINGE)]


def _mapped(model: Any) -> list[int]:
    """Actuators of a hinge or slide, with a force that is linear in control, and motors of a
    ball joint along axes of its carrier."""

    def moves(actuator: int) -> bool:
        kind = model.jnt_type[model.actuator_trnid[actuator, 0]]
        held = model.actuator_trntype[actuator] == _IN_PARENT
        motor = not _bias(model, actuator)[1:].any()
        return kind in (_SLIDE, _HINGE) or (kind == _BALL and held and motor)

    return [
        actuator
        for actuator in range(model.nactuator if hasattr(model, "nactuator") else model.nu)
        if model.actuator_trntype[actuator] in (_IN_JOINT, _IN_PARENT)
        and moves(actuator)
        and model.actuator_dyntype[actuator] == 0
        and model.actuator_gaintype[actuator] == 0
        and model.actuator_biastype[actuator] in (0, 1)
    ]


def _coordinates(model: Any, positions: np.ndarray) -> Any:
    """Coordinates of the assembly from those of MuJoCo: quaternions of free bases first."""
    q = np.array(positions, float)
    for joint in range(model.njnt):
        if model.jnt_type[joint] == _FREE:
            at = model.jnt_qposadr[joint]
            q[at : at + 7] = np.roll(q[at : at + 7], 4)
    return jnp.array(q)


# What an assembly has not


def _unmapped(model: Any):
    """Names of all that moves the robot of the file and not the assembly."""
    for joint in range(model.njnt):
        first, kind = model.jnt_dofadr[joint], model.jnt_type[joint]
        dofs = slice(first, first + {_FREE: 6, _BALL: 3}.get(kind, 1))
        rows = {"frictionloss": model.dof_frictionloss[dofs]}
        if kind == _FREE:
            rows |= {"damping": model.dof_damping[dofs], "armature": model.dof_armature[dofs]}
        if kind in (_FREE, _BALL):
            rows |= {"stiffness": model.jnt_stiffness[joint : joint + 1]}
        if kind == _BALL:
            rows |= {"range": model.jnt_limited[joint : joint + 1]}
        for field in ("dof_dampingpoly", "jnt_stiffnesspoly", "jnt_springyield"):
            if hasattr(model, field):
                values = getattr(model, field)
                place = dofs if field.startswith("dof") else slice(joint, joint + 1)
                rows[field.partition("_")[2]] = values[place]
        for what, values in rows.items():
            if np.any(values):
                yield f"{what} of joint {_name(model, 'joint', joint)}"
    mapped = _mapped(model)
    for actuator in range(len(model.actuator_trntype)):
        name = _name(model, "actuator", actuator)
        if actuator not in mapped:
            yield f"actuator {name}"
        elif model.actuator_forcelimited[actuator] and _bias(model, actuator).any():
            yield f"forcerange of actuator {name}"
        for field in ("actuator_damping", "actuator_armature", "actuator_dampingpoly"):
            if actuator in mapped and np.any(getattr(model, field, np.zeros(99))[actuator]):
                yield f"{field.partition('_')[2]} of actuator {name}"
    counts = dict(equality="neq", tendon="ntendon", flex="nflex", plugin="nplugin")
    for kind, count in counts.items():
        for k in range(getattr(model, count)):
            yield f"{kind} {_name(model, kind, k)}"
    for body in range(model.nbody):
        if model.body_gravcomp[body]:
            yield f"gravcomp of body {_name(model, 'body', body)}"
        if model.body_mocapid[body] >= 0:
            yield f"mocap body {_name(model, 'body', body)}"
    option = model.opt
    if option.density or option.viscosity:
        yield "fluid of option"
    for sensor in range(model.nsensor):
        yield f"sensor {_name(model, 'sensor', sensor)}"
    touching = sum(_touches(model, geom) for geom in range(model.ngeom))
    if touching:
        yield f"contact of {touching} geoms"


def _touches(model: Any, geom: int) -> bool:
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom])


def _name(model: Any, kind: str, index: int) -> str:
    """Name of an entry, or its kind and number."""
    kinds = dict(body="body", joint="jnt", site="site", key="key", actuator="actuator")
    kinds |= dict(equality="eq", tendon="tendon", sensor="sensor", flex="flex", plugin="plugin")
    first = getattr(model, f"name_{kinds[kind]}adr")[index]
    found = model.names[first : model.names.index(b"\0", first)].decode()
    return found or f"{kind}_{index}"


# Poses


def _pose(place: np.ndarray, quaternion: np.ndarray) -> Pose:
    found = _moved(place)
    found[:3, :3] = _turn(quaternion)
    return found


def _moved(place: np.ndarray) -> Pose:
    found = np.eye(4)
    found[:3, 3] = place
    return found


def _turn(quaternion: np.ndarray) -> Float[np.ndarray, "3 3"]:
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


# Triangles of geoms, in their frame

_AROUND, _UP = 24, 6


def _lathe(radii: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A profile from the lowest point up, turned about z."""
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    flat = radii[:, None, None] * ring[None]
    tall = np.broadcast_to(heights[:, None, None], (*flat.shape[:2], 1))
    corners = np.concatenate([flat, tall], axis=2).reshape(-1, 3)
    row, k = np.arange(len(radii) - 1)[:, None] * _AROUND, np.arange(_AROUND)[None]
    a, b = row + k, row + (k + 1) % _AROUND
    both = np.stack([a, b, b + _AROUND, a, b + _AROUND, a + _AROUND], axis=-1)
    return corners, both.reshape(-1, 3)


def _ball(radius: float, half: float) -> tuple[np.ndarray, np.ndarray]:
    """A sphere, or with a `half` length a capsule along z."""
    angle = np.linspace(0, np.pi / 2, _UP)
    low, high = -radius * np.cos(angle) - half, radius * np.sin(angle) + half
    radii = radius * np.concatenate([np.sin(angle), np.cos(angle)])
    return _lathe(radii, np.concatenate([low, high]))


def _sphere(model: Any, geom: int):
    return _ball(model.geom_size[geom, 0], 0.0)


def _capsule(model: Any, geom: int):
    return _ball(*model.geom_size[geom, :2])


def _cylinder(model: Any, geom: int):
    radius, half = model.geom_size[geom, :2]
    return _lathe(radius * np.array([0, 1, 1, 0]), half * np.array([-1, -1, 1, 1]))


def _ellipsoid(model: Any, geom: int):
    corners, triangles = _ball(1.0, 0.0)
    return corners * model.geom_size[geom], triangles


def _box(model: Any, geom: int):
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = [[s[i] for i in ends] for s in sides for ends in ((0, 1, 2), (0, 2, 3))]
    return corners * model.geom_size[geom], np.array(triangles)


def _mesh(model: Any, geom: int):
    mesh = model.geom_dataid[geom]
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    corners = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]]
    return np.array(corners, float), model.mesh_face[face : face + model.mesh_facenum[mesh]]


_SOLIDS = {2: _sphere, 3: _capsule, 4: _ellipsoid, 5: _cylinder, 6: _box, 7: _mesh}


def _one_surface(pieces: list[tuple[np.ndarray, np.ndarray]]) -> Surface:
    starts = np.cumsum([0] + [len(corners) for corners, _ in pieces])[:-1]
    triangles = [t + start for (_, t), start in zip(pieces, starts, strict=True)]
    corners = np.concatenate([corners for corners, _ in pieces])
    return Surface(corners, np.concatenate(triangles).astype(np.int32))
