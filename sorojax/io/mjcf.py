"""Rods and assemblies to files in MJCF: a rod as a chain of rigid segments, fitted at rest."""

import os
import xml.etree.ElementTree as ET
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from sorojax.io import _files
from sorojax.math.compiled import jit_public
from sorojax.math.lie import SE2
from sorojax.math.quadrature import gauss_legendre, interpolation_rows
from sorojax.rod import (
    AbstractDamping,
    AbstractElastic,
    Assembly,
    Fixed,
    Free,
    Gravity,
    Link,
    Part,
    PartForce,
    Prismatic,
    Revolute,
    Rod,
    Spherical,
    columns,
    forward_kinematics,
    jacobian,
    mass_matrix,
    motion,
    operators,
)
from sorojax.rod.dynamics.fields import Operators, rigidities
from sorojax.rod.forces import loads
from sorojax.rod.forces.forces import gravity_or_earth
from sorojax.rod.forces.loads import Load, tangent_stiffness

Pose = Float[np.ndarray, "4 4"]
_WHERE = "export_mjcf"
_OFF = 0.05  # of the lowest frequency, beyond which it is told
_STEP = 2e-3  # s, the default of MuJoCo
_LEAST = 1e-9  # kg of a frame, as MuJoCo moves nothing without mass


class ChainFit(NamedTuple):
    """How the chain of a rod was fitted, and compares with it, both at rest.

    Attributes:
        stiffness: Factor on the stiffness of the section, by strain.
        damping_time: Damper over spring of its joints [s], by strain.
        frequency: Lowest of the clamped rod [Hz].
        chain_frequency: The same of the chain [Hz].
    """

    stiffness: dict[str, float]
    damping_time: dict[str, float]
    frequency: float
    chain_frequency: float


class ExportedMjcf(NamedTuple):
    """What `export_mjcf` wrote.

    Attributes:
        text: Content of the file.
        chains: How each rod was fitted, by the name of its part.
        unmapped: What the model and its forces have and the file has not.
    """

    text: str
    chains: dict[str, ChainFit]
    unmapped: tuple[str, ...]


def export_mjcf(
    path: str | os.PathLike,
    model: Rod | Assembly,
    forces: tuple[Load, ...] = (),
    *,
    segments: int = 16,
    root: str | os.PathLike | None = None,
) -> ExportedMjcf:
    """Write a rod, or an assembly of rods and links, as a model of MuJoCo.

    A rod becomes `segments` bodies between joints in the middle of its n cells, with one hinge
    per curvature and one slide per stretch or shear that it has. A spring of stiffness k bears
    what its cell does, 1 / k = integral of ds / EI over it, times a factor for each strain so
    that the tip gives way to a load there as that of the rod does; dampers decay the first mode
    of each strain as in the rod. Bodies have the mass, centre and inertia of their piece of the
    rod, and stand as it does without strain. Bodies are named `part_0`, `part_1`, ...,
    joints `part_0_kappa_z`, and the end of a rod is the site `part_tip`; a single rod is
    `rod`. Capsules are pictures, and touch nothing. The time step is short enough for an
    explicit method.

    Args:
        path: File name.
        model: The rod or assembly; a planar one moves in the plane z = 0.
        forces: Its `Gravity`, dampings and elastic laws, as those of a reduced rod, by their
            slope at rest. Others are named in `unmapped`.
        segments: Bodies per rod.
        root: Folder that the file must lie in, links followed.

    Returns:
        The text, how each chain compares with its rod, and what is not in the file: forces of
        other kinds, closures, and a chain whose lowest frequency is off by more than 5 %.

    Raises:
        ValueError: If a joint is neither fixed, revolute, prismatic, spherical nor a free
            base, `segments` is below 2, or the path leaves `root`.

    Example:
        >>> finger = rod.rod(sj.SE3(), rod.chebyshev(kappa_y=4, kappa_z=4), rod.circle(6 * mm),
        ...                  length=0.12, young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> made = io.export_mjcf("finger.xml", finger, (rod.Gravity(), rod.Damping(0.01)))
        >>> fit = made.chains["rod"]
        >>> print(f"{fit.frequency:.2f} Hz, in the chain {fit.chain_frequency:.2f} Hz")
        3.68 Hz, in the chain 3.68 Hz

    Reference:
        The MuJoCo documentation, XML reference; midpoint rule for the cells.
    """
    file = _files.inside(_WHERE, path, root)
    if segments < 2:
        raise ValueError(f"{_WHERE}: `segments` is {segments}, need 2 or more. Take 10 to 30.")
    if isinstance(model, Rod):
        listed = loads.plain(forces, model.group)
        forces = tuple(f if isinstance(f, Gravity) else PartForce("rod", f) for f in listed)
        model = Assembly(model.group, ("rod",), (Part(model),))
    writer = _Writer(model, forces, segments)
    text = writer.text()
    _files.write(file, lambda stream: stream.write(text.encode()))
    return ExportedMjcf(text, writer.chains, tuple(writer.unmapped))


class _Writer:
    """The tree of the file, as parts are added in their order."""

    def __init__(self, model: Assembly, forces: tuple[Load, ...], segments: int):
        self.model, self.segments, self.step = model, segments, _STEP
        self.chains: dict[str, ChainFit] = {}
        self.unmapped: list[str] = []
        self.tree = ET.Element("mujoco")
        ET.SubElement(self.tree, "compiler", angle="radian", autolimits="true")
        self.option = ET.SubElement(self.tree, "option", gravity=_row(self._gravity(forces)))
        default = ET.SubElement(self.tree, "default")
        ET.SubElement(default, "geom", contype="0", conaffinity="0", rgba="0.9 0.6 0.4 1")
        world = ET.SubElement(self.tree, "worldbody")
        self.rods: dict[str, _Chain] = {}
        self.bodies = {}
        for name, part in zip(model.names, model.parts, strict=True):
            self._add(name, part, world, self._of_part(forces, name))
        self.unmapped += [f"closure {name}" for name in model.loops]

    def text(self) -> str:
        self.option.set("timestep", f"{self.step:.3g}")
        self.option.set("integrator", "implicitfast")
        ET.indent(self.tree)
        return ET.tostring(self.tree, encoding="unicode") + "\n"

    def _gravity(self, forces: tuple[Load, ...]) -> np.ndarray:
        total, dim = np.zeros(3), self.model.group.space_dim
        for force in forces:
            if isinstance(force, Gravity):
                total[:dim] += gravity_or_earth(force.acceleration, dim, float)
        return total

    def _of_part(self, forces: tuple[Load, ...], name: str) -> tuple[Any, ...]:
        """Dampings and elastic laws of a rod; others are told, once."""
        found = []
        for force in forces:
            inner = force.force if isinstance(force, PartForce) else force
            here = force.part == name if isinstance(force, PartForce) else True
            if isinstance(inner, Gravity) and not isinstance(force, PartForce):
                continue
            if isinstance(inner, AbstractDamping | AbstractElastic):
                found += [inner] if here and isinstance(self.model[name].body, Rod) else []
                continue
            on = f" on {force.part}" if isinstance(force, PartForce) else ""
            told = f"{type(inner).__name__}{on}"
            if told not in self.unmapped:
                self.unmapped.append(told)
        return tuple(found)

    def _add(self, name: str, part: Part, world: ET.Element, forces: tuple[Any, ...]) -> None:
        """A part under what carries it."""
        on, at = world, np.eye(4) if part.offset is None else _lifted(part.offset)
        if part.on in self.rods:
            on, rest = self.rods[part.on].place(float(part.s))
            at = rest @ at
        elif part.on is not None:
            on = self.bodies[part.on]
        body = self.bodies[name] = _body(on, name, at)
        self._joint(name, part, body, on is world)
        if isinstance(part.body, Link):
            self._link(name, part.body, body)
            return
        chain = _Chain(name, part.body, forces, self.segments)
        chain.write(body)
        self.rods[name], self.chains[name] = chain, chain.fit
        self.step = min(self.step, 1 / chain.fastest)
        slow, fast = chain.fit.frequency, chain.fit.chain_frequency
        if abs(fast / slow - 1) > _OFF:
            self.unmapped.append(
                f"lowest frequency of {name}: {slow:.4g} Hz, in its chain {fast:.4g} Hz"
            )

    def _joint(self, name: str, part: Part, body: ET.Element, grounded: bool) -> None:
        joint, planar = part.joint, isinstance(self.model.group, SE2)
        if isinstance(joint, Fixed):
            return
        if isinstance(joint, Free) and grounded and not planar:
            ET.SubElement(body, "freejoint", name=name)
            return
        if not isinstance(joint, Revolute | Prismatic | Spherical):
            raise ValueError(
                f"{_WHERE}: the joint of `{name}` is a {type(joint).__name__}, need Fixed, "
                "Revolute, Prismatic, Spherical, or Free in space on the ground. Give it "
                "another one."
            )
        ball = isinstance(joint, Spherical)
        turns = isinstance(joint, Revolute) or ball
        axis = np.array([0.0, 0.0, 1.0] if turns else [1.0, 0.0, 0.0])
        numbers = {"damping": joint.damping, "armature": joint.armature}
        if not ball:
            numbers["stiffness"] = joint.stiffness
            if joint.axis is not None and not (planar and turns):
                axis = np.pad(np.asarray(joint.axis, float), (0, 3 - len(joint.axis)))
        given = {key: _row([value]) for key, value in numbers.items() if value is not None}
        if ball and not planar:
            ET.SubElement(body, "joint", {"name": name, "type": "ball", **given})
            return
        kind = "hinge" if turns else "slide"
        ET.SubElement(body, "joint", {"name": name, "type": kind, "axis": _row(axis), **given})

    def _link(self, name: str, link: Link, body: ET.Element) -> None:
        mass = float(link.mass)
        inertia = np.asarray(link.inertia, float)
        if mass == 0:
            self.unmapped.append(f"frame {name} without mass: {_LEAST:g} kg in the file")
            mass, inertia = _LEAST, np.full(3, _LEAST * 1e-4)
        if inertia.ndim < 2:
            inertia = np.diag(np.broadcast_to(inertia, 3))
        center = np.zeros(3)
        if link.center is not None:
            center[: len(link.center)] = link.center
        _inertial(body, mass, center, inertia)


class _Rest(NamedTuple):
    """A rod at rest: poses of sections, Jacobian of the tip, stiffness, damping and mass."""

    poses: Float[Array, "points h h"]
    tip: Float[Array, "twist dof"]
    matrices: tuple[Float[Array, "dof dof"], ...]
    constants: Operators
    rigidities: dict[str, Float[Array, " quad"]]


@jit_public
def _at_rest(rod: Rod, forces: tuple[Any, ...], s: Float[Array, " points"]) -> _Rest:
    """All that is asked of a rod, in one program."""
    zero, constants = jnp.zeros(rod.basis.num_dof, rod.length.dtype), operators(rod)
    stiffness = tangent_stiffness(forces, motion(rod, zero, constants=constants))
    damping = loads.damping_matrix(forces, rod, constants)
    matrices = stiffness, damping, mass_matrix(rod, zero)
    tip = jacobian(rod, zero, jnp.ones(1))[0]
    poses = forward_kinematics(rod, zero, s)
    return _Rest(poses, tip, matrices, constants, rigidities(rod))


class _Chain:
    """A rod as bodies that joints hold together in the middle of its cells.

    Attributes:
        name: Of the part.
        edges: Where pieces begin and end, in [0, 1]: joints are at all but the first and last.
        frames: Poses of the pieces at rest, in the frame of the rod.
        masses: Mass, centre and inertia of each piece, in its frame.
        springs, dampers: Of each joint, by strain.
        fit: How it compares with the rod.
        fastest: Greatest angular frequency [rad/s].
    """

    def __init__(self, name: str, rod: Rod, forces: tuple[Any, ...], count: int):
        self.name, self.rod, self.count = name, rod, count
        middles = (np.arange(count) + 0.5) / count
        self.edges = np.concatenate([[0.0], middles, [1.0]])
        starts, sizes = self.edges[:-1, None], np.diff(self.edges)[:, None]
        self._inner = starts + sizes * gauss_legendre(4)[0]
        self._rest = jax.tree.map(
            np.asarray, _at_rest(rod, forces, jnp.append(self.edges, self._inner))
        )
        poses = np.stack([_lifted(pose) for pose in self._rest.poses])
        self.frames, self.tip = poses[: count + 1], poses[count + 1]
        self._sections = poses[count + 2 :].reshape(count + 1, -1, 4, 4)
        self.masses = [self._piece(k) for k in range(count + 1)]
        self.elements: list[ET.Element] = []
        self._fit()

    def _along(self, values: Any, s: np.ndarray) -> np.ndarray:
        """What is known at the nodes, at `s`."""
        rows = np.asarray(interpolation_rows(self.rod.quadrature, s))
        return rows @ np.asarray(values, float).T

    def _piece(self, k: int) -> tuple[float, np.ndarray, np.ndarray]:
        """Mass [kg], centre [m] and inertia about it [kg m^2], in the frame of the piece."""
        constants, s = self._rest.constants, self._inner[k]
        share = float(self.rod.length) * np.diff(self.edges)[k] * gauss_legendre(4)[1]
        mass = share * self._along(constants.mass / constants.weights, s)
        rotary = share[:, None] * self._along(constants.rotary / constants.weights, s)
        sections = np.linalg.inv(self.frames[k]) @ self._sections[k]
        places = sections[:, :3, 3]
        if constants.mass_offset is not None:
            off = self._along(constants.mass_offset, s)
            places = places + np.einsum(
                "pij,pj->pi", sections[:, :3, 1 : 1 + off.shape[1]], off
            )
        total = mass.sum()
        center = mass @ places / total
        arms = places - center
        inertia = np.einsum("p,pk,pk->", mass, arms, arms) * np.eye(3)
        inertia -= np.einsum("p,pi,pj->ij", mass, arms, arms)
        for turn, moments in zip(sections[:, :3, :3], rotary, strict=True):
            inertia += turn @ np.diag(np.broadcast_to(moments, 3)) @ turn.T
        return total, center, inertia

    def _cells(self, strain: str) -> np.ndarray:
        """Stiffness of each joint by the section alone."""
        rigidity, (x, w) = self._rest.rigidities[strain], gauss_legendre(4)
        s = (np.arange(self.count)[:, None] + x[None]) / self.count
        soft = self._along(1 / rigidity, s.ravel()).reshape(s.shape) @ w
        return self.count / (float(self.rod.length) * soft)

    def _columns(self, strain: str, point: np.ndarray) -> Float[np.ndarray, "6 joints"]:
        """Twist of a point per motion of each joint, at rest."""
        axes = self.frames[1:, :3, "xyz".index(strain[-1])]
        if strain.startswith("sigma"):
            return np.concatenate([np.zeros_like(axes), axes], axis=1).T
        arms = point - self.frames[1:, :3, 3]
        return np.concatenate([axes, np.cross(axes, arms)], axis=1).T

    def _inertia(self, strains: tuple[str, ...]) -> np.ndarray:
        """Mass matrix of the chain at rest."""
        size = self.count * len(strains)
        total = np.zeros((size, size))
        for k, (mass, center, inertia) in enumerate(self.masses):
            turn = self.frames[k][:3, :3]
            point = turn @ center + self.frames[k][:3, 3]
            each = [self._columns(s, point) * (np.arange(self.count) < k) for s in strains]
            rows = np.concatenate(each, axis=1)
            total += mass * rows[3:].T @ rows[3:]
            total += rows[:3].T @ turn @ inertia @ turn.T @ rows[:3]
        return total

    def _fit(self) -> None:
        rod, strains = self.rod, self.rod.basis.active
        stiffness, damping, mass = self._rest.matrices
        tip = _twists(self._rest.tip)
        soft, factors, times = np.linalg.inv(stiffness), {}, {}
        self.springs, self.dampers = {}, {}
        for strain in strains:
            own = columns(rod.basis, strain)
            wanted = tip[:, own] @ soft[own, own] @ tip[:, own].T
            plain, moved = self._cells(strain), self._columns(strain, self.tip[:3, 3])
            found = (moved / plain) @ moved.T
            factors[strain] = _compliance(found, wanted, float(rod.length))
            shape = scipy.linalg.eigh(stiffness[own, own], mass[own, own])[1][:, 0]
            times[strain] = float(
                shape @ damping[own, own] @ shape / (shape @ stiffness[own, own] @ shape)
            )
            self.springs[strain] = factors[strain] * plain
            self.dampers[strain] = times[strain] * self.springs[strain]
        lowest = scipy.linalg.eigh(stiffness, mass, eigvals_only=True)[0]
        springs = np.diag(np.concatenate([self.springs[strain] for strain in strains]))
        every = np.sqrt(scipy.linalg.eigh(springs, self._inertia(strains), eigvals_only=True))
        turns = np.array([np.sqrt(lowest), every[0]]) / (2 * np.pi)
        self.fit = ChainFit(factors, times, *map(float, turns))
        self.fastest = float(every[-1])

    def write(self, base: ET.Element) -> None:
        """The pieces below the body of the part, which is the first of them."""
        radius = float(np.sqrt(np.mean(np.asarray(self.rod.section.area)) / np.pi))
        body, on = base, np.eye(4)
        for k, (mass, center, inertia) in enumerate(self.masses):
            if k:
                body = _body(body, f"{self.name}_{k - 1}", np.linalg.inv(on) @ self.frames[k])
                self._joints(k - 1, body)
            on = self.frames[k]
            self.elements.append(body)
            _inertial(body, mass, center, inertia)
            ends = self.frames[k + 1] if k < self.count else self.tip
            end = (np.linalg.inv(on) @ ends)[:3, 3]
            ET.SubElement(
                body, "geom", type="capsule", size=_row([radius]), fromto=_row([0, 0, 0, *end])
            )
        at = np.linalg.inv(on) @ self.tip
        ET.SubElement(body, "site", {"name": f"{self.name}_tip", **_place(at)})

    def _joints(self, j: int, body: ET.Element) -> None:
        """Slides, then hinges: those along axes that the hinges have not turned."""
        for strain in sorted(self.rod.basis.active, key=lambda name: name.startswith("kappa")):
            ET.SubElement(
                body,
                "joint",
                name=f"{self.name}_{j}_{strain}",
                type="hinge" if strain.startswith("kappa") else "slide",
                axis=_row(np.eye(3)["xyz".index(strain[-1])]),
                stiffness=_row([self.springs[strain][j]]),
                damping=_row([self.dampers[strain][j]]),
            )

    def place(self, s: float) -> tuple[ET.Element, Pose]:
        """The body that holds a section, and the pose of the section in its frame."""
        k = min(int(np.searchsorted(self.edges, s, side="right")) - 1, self.count)
        zero = jnp.zeros(self.rod.basis.num_dof, self.rod.length.dtype)
        pose = _lifted(forward_kinematics(self.rod, zero, [s])[0])
        return self.elements[k], np.linalg.inv(self.frames[k]) @ pose


def _compliance(found: np.ndarray, wanted: np.ndarray, length: float) -> float:
    """Factor on stiffness that makes `found` as soft at the tip as `wanted`: to forces where
    they move it, to moments otherwise."""
    moves = np.trace(wanted[3:, 3:]) > 1e-6 * length**2 * np.trace(wanted[:3, :3])
    block = slice(3, 6) if moves else slice(0, 3)
    return float(np.trace(found[block, block]) / np.trace(wanted[block, block]))


# Poses and entries of the file


def _lifted(pose: Any) -> Pose:
    """A pose of the plane in space; one of space as it is."""
    pose = np.asarray(pose, float)
    if pose.shape == (4, 4):
        return pose
    found = np.eye(4)
    found[:2, :2], found[:2, 3] = pose[:2, :2], pose[:2, 2]
    return found


def _twists(rows: Any) -> Float[np.ndarray, "6 n"]:
    """Twists of the plane in space; those of space as they are."""
    rows = np.asarray(rows, float)
    if rows.shape[0] == 6:
        return rows
    found = np.zeros((6, rows.shape[1]))
    found[2:5] = rows
    return found


def _body(on: ET.Element, name: str, at: Pose) -> ET.Element:
    return ET.SubElement(on, "body", {"name": name, **_place(at)})


def _place(at: Pose) -> dict[str, str]:
    quaternion = np.roll(Rotation.from_matrix(at[:3, :3]).as_quat(), 1)
    return {"pos": _row(at[:3, 3]), "quat": _row(quaternion)}


def _inertial(body: ET.Element, mass: float, center: np.ndarray, inertia: np.ndarray) -> None:
    six = [inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    ET.SubElement(body, "inertial", mass=_row([mass]), pos=_row(center), fullinertia=_row(six))


def _row(numbers: Any) -> str:
    return " ".join(f"{float(x):.12g}" for x in numbers)
