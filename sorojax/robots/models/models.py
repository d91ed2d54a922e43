"""Simulation models of the printable robots, from the parameters that draw them.

Cells of the drawing give rods their stiffness, chambers and mass (`unit_cell`); what lies
between them, plates and tips, is rigid. Positions are in the frame of the drawing; weight
acts against its last axis.
"""

import functools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sorojax import material as materials
from sorojax._edit import replace
from sorojax._types import Numbers, real
from sorojax.material import AbstractHyperelastic
from sorojax.math.host import together
from sorojax.math.lie import SE2, SE3, homogeneous, plane_rotation
from sorojax.robots.models.cell import bellows_cell, bending_cell, finger_cell
from sorojax.robots.models.rods import Body, body, column, rigid, side_by_side
from sorojax.robots.models.supply import (
    Advance,
    Model,
    Port,
    Running,
    Supply,
    stepper,
    with_pneumatics,
)
from sorojax.robots.printable import BendingActuator, Finger, Hand, Manipulator, PlanarActuator
from sorojax.rod import Assembly, Gravity, Link, Part, PartForce, assembly, chebyshev, constant
from sorojax.sdf import Box, Cylinder, HalfSpace, translate
from sorojax.systems import AssemblyBody
from sorojax.units import kPa

#: Axes of a rod that stands along z of a drawing: its x points along z, its y along x.
STANDING = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
#: Of one that lies along x and bends towards z.
LYING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
DENSITY = 1100.0  # kg/m^3; printed urethanes have 1050 to 1200
DAMPING = 3e-3  # s, of a silicone beam let go: arXiv:2201.12560, 0.05 of critical at 4 to 8 Hz


class Making(NamedTuple):
    """Settings that all models share."""

    material: AbstractHyperelastic
    supply: Supply
    damping: Any
    size: float | None
    modes: int

    @property
    def density(self) -> Array:
        density: Any = self.material.density
        return real(density)


def printed_rubber() -> AbstractHyperelastic:
    """The preset "elastic_80a" at a Poisson's ratio of 0.49, with a density.

    Returns:
        The material.
    """
    rubber = materials.presets.rubber("elastic_80a", poisson_ratio=0.49)
    return replace(rubber, lambda m: m.density, DENSITY)


def model(
    robot: Any,
    material: AbstractHyperelastic | None = None,
    *,
    supply: Supply | None = None,
    damping: Numbers = DAMPING,
    size: float | None = None,
    modes: int = 3,
) -> Model:
    """A robot as rods with the stiffness of its drawing, reservoirs and regulators.

    Turns may be large. Bellows of the planar actuator and of the manipulator stretch as their
    cell does at large strains: 2 to 3 % off solid finite elements up to 50 kPa. Cells of the
    bending actuator and of fingers answer linearly: the actuator turns by 2 % too much at
    5 kPa and 5 % at 30 kPa.
    `model(BendingActuator()).network` takes `actuator_valve.setpoint` [Pa] and gives
    `actuator_air.pressure` and `body.tip_position`.

    Args:
        robot: A `BendingActuator`, `PlanarActuator`, `Hand` or `Manipulator`.
        material: Of everything printed, with a density; `printed_rubber()` if omitted.
        supply: Tubes and regulators.
        damping: Retardation time of the material, viscosity over modulus [s].
        size: Of the boxes on which a cell is solved [m]; half its wall if omitted.
        modes: Of the bending of actuators and fingers.

    Returns:
        The network with what a board sees of it.

    Raises:
        TypeError: If there is no model of `robot`.
    """
    rubber = printed_rubber() if material is None else material
    supply = Supply() if supply is None else supply
    return _model(robot, Making(rubber, supply, damping, size, modes))


def bench(name: str, period: float = 5e-3, **options: Any) -> tuple[Advance, Running, Array]:
    """A robot by name as a valve board drives it: `advance`, its start, and the limits [Pa],
    a pair per regulator.

    Args:
        name: "bending", "planar", "hand" or "manipulator".
        period: Of every step [s].
        **options: Of `model`.

    Returns:
        `advance`, the state to start from, and the lowest and highest pressure of each port
        [Pa].

    Raises:
        ValueError: If there is no such robot.
    """
    kinds = {
        "bending": BendingActuator,
        "planar": PlanarActuator,
        "hand": Hand,
        "manipulator": Manipulator,
    }
    if name not in kinds:
        raise ValueError(f"robots.bench: got {name!r}, need one of {', '.join(kinds)}.")
    made = model(kinds[name](), **options)
    return *stepper(made, period), jnp.stack([made.low, made.high], axis=1)


@functools.singledispatch
def _model(robot: Any, making: Making) -> Model:
    raise TypeError(
        f"robots.model: got a {type(robot).__name__}, need a BendingActuator, "
        "PlanarActuator, Hand or Manipulator."
    )


@_model.register
def _(robot: BendingActuator, making: Making) -> Model:
    cell, half = bending_cell(robot, making.material, making.size), robot.pitch / 2
    zero, middle = jnp.zeros_like(half), cell.center[1]
    # walls turn the slab about the gap between them: half a pitch at each end has no such gap
    made = body(
        SE2(),
        chebyshev(kappa_z=making.modes, sigma_x=1),
        column(cell),
        robot.length - robot.pitch,
        making.material,
        damping=making.damping,
        plane=2,
    )
    front = Box(
        jnp.stack([robot.length - half, -robot.width, -half]),
        jnp.stack([robot.length, robot.width, 2 * robot.height]),
    )
    end = jnp.stack([robot.length, zero, middle])
    tip = _flat(rigid(robot.body() & front, end, LYING, making.density))
    whole = assembly(
        SE2(),
        actuator=Part(made.rod, offset=_placed(jnp.eye(2), jnp.stack([half, middle]))),
        tip=Part(tip, on="actuator", offset=_placed(jnp.eye(2), jnp.stack([half, zero]))),
    )
    port = Port(("actuator",), made.chambers.rest[0], -10 * kPa, 100 * kPa)
    return with_pneumatics(_moving(whole, actuator=made), {"actuator": port}, making.supply)


@_model.register
def _(robot: PlanarActuator, making: Making) -> Model:
    cell = bellows_cell(robot.bellows, making.material, making.size)
    b, half = robot.bellows, robot.spacing / 2
    length, zero = b.num_folds * b.pitch, jnp.zeros_like(half)
    # local y of the rod points against x of the drawing, to which it stands upright
    places = jnp.stack([jnp.stack([half, zero]), jnp.stack([-half, zero])])
    made = body(
        SE2(),
        constant("kappa_z", "sigma_x", "sigma_y"),
        side_by_side(cell, places, length),
        length,
        making.material,
        damping=making.damping,
    )
    plate = rigid(_end_plate(robot), [0.0, 0.0, b.cap + length], STANDING, making.density)
    upright = _placed(jnp.array([[0.0, -1.0], [1.0, 0.0]]), [0.0, b.cap])
    whole = assembly(
        SE2(), bellows=Part(made.rod, offset=upright), plate=Part(_flat(plate), on="bellows")
    )
    port = Port(("bellows",), made.chambers.rest, -10 * kPa, 50 * kPa, count=2)
    return with_pneumatics(_moving(whole, bellows=made), {"bellows": port}, making.supply)


@_model.register
def _(robot: Hand, making: Making) -> Model:
    four = _finger(robot.finger, robot.socket_depth, making)
    # the thumb leaves the side of the palm askew
    thumb = _finger(robot.thumb, robot.socket_depth / jnp.sin(robot.thumb_angle), making)
    parts, bodies, ports = {}, {}, {}
    for name, (place, angle) in robot.places().items():
        one = thumb if name == "thumb" else four
        turn = _about_z(angle) @ STANDING
        base = _placed(turn @ STANDING, place + turn @ one.base)
        parts[name] = Part(one.body.rod, offset=base)
        parts[f"{name}_tip"] = Part(one.tip, on=name)
        bodies[name] = one.body
        ports[name] = Port(
            (name,), one.body.chambers.rest[0], -10 * kPa, 60 * kPa, dead=one.dead
        )
    return with_pneumatics(_moving(assembly(SE3(), **parts), **bodies), ports, making.supply)


@_model.register
def _(robot: Manipulator, making: Making) -> Model:
    b, zero = robot.bellows, jnp.zeros_like(robot.center_distance)
    cell, one = together(
        lambda: bellows_cell(b, making.material, making.size),
        lambda: _finger(robot.finger, robot.finger.bellows.cap, making),
    )
    length, angles = b.num_folds * b.pitch, 2 * np.pi / 3 * jnp.arange(3.0)
    around = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    made = body(
        SE3(),
        constant("kappa_y", "kappa_z", "sigma_x", "sigma_y", "sigma_z"),
        side_by_side(cell, robot.center_distance * around, length),
        length,
        making.material,
        damping=making.damping,
    )
    end = jnp.stack([zero, zero, b.cap + length])
    plate = rigid(_upper_plate(robot), end, STANDING, making.density)
    upright = _placed(STANDING, jnp.stack([zero, zero, b.cap]))
    parts = {"arm": Part(made.rod, offset=upright), "plate": Part(plate, on="arm")}
    bodies = {"arm": made}
    for k in range(3):
        turn = _about_z(angles[k] + np.pi / 3)
        foot = turn @ (jnp.stack([robot.finger_distance, zero, robot.finger_foot]) + one.base)
        base = _placed(STANDING.T @ turn @ STANDING, STANDING.T @ (foot - end))
        parts |= {f"finger_{k}": Part(one.body.rod, on="plate", offset=base)}
        parts |= {f"finger_{k}_tip": Part(one.tip, on=f"finger_{k}")}
        bodies[f"finger_{k}"] = one.body
    fingers = tuple(f"finger_{k}" for k in range(3))
    ports = {
        "arm": Port(("arm",), made.chambers.rest, -10 * kPa, 30 * kPa, count=3),
        "gripper": Port(
            fingers, 3 * one.body.chambers.rest[0], -30 * kPa, 60 * kPa, dead=3 * one.dead
        ),
    }
    return with_pneumatics(_moving(assembly(SE3(), **parts), **bodies), ports, making.supply)


class StandingFinger(NamedTuple):
    """A finger from where it leaves its socket: base [m] in its drawing, dead volume [m^3]."""

    body: Body
    tip: Any
    base: Array
    dead: Array


def _finger(finger: Finger, start, making: Making) -> StandingFinger:
    b, cell = finger.bellows, finger_cell(finger, making.material, making.size)
    end, zero = b.length - b.cap, jnp.zeros_like(b.cap)
    made = body(
        SE3(),
        chebyshev(kappa_y=1, kappa_z=making.modes, sigma_x=1),
        column(cell),
        end - start,
        making.material,
        damping=making.damping,
    )
    base = jnp.stack([cell.center[0], zero, start])
    axis = base.at[2].set(end)
    beyond = HalfSpace(jnp.stack([zero, zero, end]), [0.0, 0.0, -1.0])
    tip = rigid(finger.solid() & beyond, axis, STANDING, making.density)
    return StandingFinger(made, tip, base, cell.gas * jnp.maximum(start - b.cap, 0.0))


def _end_plate(robot: PlanarActuator):
    b, t = robot.bellows, robot.plate_thickness
    x, low = robot.spacing / 2 + b.outer_radius, b.length - b.cap / 2
    return Box([-x, -b.outer_radius, low], [x, b.outer_radius, low + t], robot.fillet)


def _upper_plate(robot: Manipulator):
    t, zero = robot.plate_thickness, jnp.zeros_like(robot.plate_thickness)
    middle = jnp.stack([zero, zero, robot.length - t / 2])
    return translate(Cylinder(robot.plate_radius, t, robot.fillet), middle) - translate(
        Cylinder(robot.core_radius, 2 * t), middle
    )


def _moving(whole: Assembly, **bodies: Body) -> AssemblyBody:
    listed: list[Any] = [Gravity()]
    for name, one in bodies.items():
        listed += [PartForce(name, force) for force in (*one.forces, one.chambers)]
    return AssemblyBody(whole, tuple(listed))


def _flat(link: Link) -> Link:
    """A link that moves in the plane of its x and y."""
    assert link.center is not None
    return Link(link.mass, link.inertia[2, 2], link.center[:2])


def _placed(rotation, position) -> Array:
    return homogeneous(real(rotation), real(position))


def _about_z(angle) -> Array:
    angle = real(angle)
    return jnp.eye(3, dtype=angle.dtype).at[:2, :2].set(plane_rotation(angle))
