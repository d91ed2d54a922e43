"""Simulation models of the printable robots, from the parameters that draw them.

Cells of the drawing give rods their stiffness, chambers and mass (`unit_cell`); what lies
between them, plates and tips, is rigid. Positions are in the frame of the drawing; weight
acts against its last axis.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check, material as materials
from sorojax._display import displayed, number
from sorojax._edit import replace
from sorojax._types import Numbers, real
from sorojax.material import AbstractHyperelastic
from sorojax.math.compiled import Split
from sorojax.math.host import together
from sorojax.math.lie import SE2, SE3, homogeneous
from sorojax.math.ode.explicit import AbstractMethod, finite, repeated
from sorojax.math.ode.steppers import AbstractStepper, GeneralisedAlpha, start
from sorojax.robots.models.cell import bellows_cell, bending_cell, finger_cell
from sorojax.robots.models.rods import Body, body, column, rigid, side_by_side
from sorojax.robots.printable import BendingActuator, Finger, Hand, Manipulator, PlanarActuator
from sorojax.rod import (
    Assembly,
    Gravity,
    Link,
    On,
    Part,
    Rod,
    assembly,
    chebyshev,
    constant,
    num_dof,
    rest,
)
from sorojax.rod.dynamics.rollout import second_order
from sorojax.sdf import Box, Cylinder, HalfSpace, translate
from sorojax.systems import (
    AbstractBlock,
    AssemblyBody,
    Coupled,
    FemBody,
    Network,
    Regulator,
    Reservoir,
    Rosenbrock2,
    sum_of,
)
from sorojax.systems.integrate.march import Rate
from sorojax.units import kPa

# A body with its air: reservoirs and regulators wired to an assembly, as a board sees it.


class Supply(eqx.Module):
    """Tubes and proportional regulators, one per port.

    The defaults are of the size of a small bench: 1 m of tube of 4 mm and a regulator of
    10 l/min; identify your own.

    Attributes:
        bandwidth: Of the regulator on its chamber at rest [rad/s].
        max_flow: Largest mass flow, in and out [kg/s].
        tube_volume: Between a regulator and its chamber [m^3].
        leakage: Rate at which a port loses gauge pressure [1/s].
        exponent: Polytropic exponent of the gas: 1 isothermal [-].
    """

    bandwidth: Float[Array, ""] = eqx.field(converter=real, default=2 * np.pi * 12)
    max_flow: Float[Array, ""] = eqx.field(converter=real, default=2e-4)
    tube_volume: Float[Array, ""] = eqx.field(converter=real, default=12.6e-6)
    leakage: Float[Array, ""] = eqx.field(converter=real, default=0.01)
    exponent: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    def __check_init__(self):
        _check.positive("Supply", "bandwidth", self.bandwidth, "rad/s", "12 Hz is usual.")
        _check.positive("Supply", "max_flow", self.max_flow, "kg/s", "10 l/min is 2e-4.")


class Port(NamedTuple):
    """One or several equal regulators and what they feed.

    Attributes:
        parts: Rods, or chambers of a block, that it fills together.
        volume: Gas in all of them at rest [m^3], one number or one per regulator.
        low, high: Gauge pressures that they bear [Pa].
        count: Number of regulators of a rod with that many chambers; None for one.
        dead: Gas that no motion moves, besides the tube [m^3].
    """

    parts: tuple[str, ...]
    volume: Float[Array, "*count"]
    low: float
    high: float
    count: int | None = None
    dead: float | Array = 0.0


@displayed
class Model(eqx.Module):
    """A robot as a network that takes set-points and returns pressures.

    Attributes:
        network: Blocks `body`, and `NAME_air` and `NAME_valve` of every port.
        ports: Names of the ports.
        counts: Number of regulators of each; None for a scalar one.
        low, high: Gauge pressures [Pa] that each regulator may ask for, all ports in a row.
    """

    network: Network
    ports: tuple[str, ...] = eqx.field(static=True)
    counts: tuple[int | None, ...] = eqx.field(static=True)
    low: Float[Array, " regulators"] = eqx.field(converter=real)
    high: Float[Array, " regulators"] = eqx.field(converter=real)

    def _text(self) -> str:
        ports = ", ".join(
            name if count is None else f"{name} ({count})"
            for name, count in zip(self.ports, self.counts, strict=True)
        )
        return (
            f"Model: a network of {len(self.network.blocks)} blocks, ports {ports}\n"
            f"  set-points from {number(self.low, 'Pa')} to {number(self.high, 'Pa')}"
        )

    @property
    def assembly(self) -> Assembly:
        body = self.network.blocks["body"]
        assert isinstance(body, AssemblyBody)
        return body.assembly

    def inputs(self, setpoint: Float[Array | np.ndarray, " regulators"]) -> dict[str, Array]:
        """Set-points [Pa] of all regulators in a row as inputs of the network."""
        found, at = {}, 0
        for name, count in zip(self.ports, self.counts, strict=True):
            many = 1 if count is None else count
            value = setpoint[at : at + many]
            found[f"{name}_valve.setpoint"] = value[0] if count is None else value
            at += many
        return found

    def pressure(self, state: Any) -> Float[Array, " regulators"]:
        """Gauge pressures [Pa] of all ports in a row."""
        found = []
        for name in self.ports:
            air = self.network.blocks[f"{name}_air"]
            told = air.output("pressure", jnp.zeros(()), state[f"{name}_air"], {})
            found.append(jnp.atleast_1d(told))
        return jnp.concatenate(found)


def supplied(
    body: AbstractBlock, ports: Mapping[str, Port], supply: Supply | None = None
) -> Model:
    """A body with a reservoir and a regulator at every port.

    Args:
        body: An `AssemblyBody`, a `FemBody`, or any block that takes `PART_pressure` and gives
            `PART_volume` and `PART_volume_rate` of every part that a port names.
        ports: By name.
        supply: Tubes and regulators; `Supply()` if omitted.
    """
    supply = Supply() if supply is None else supply
    blocks: dict[str, Any] = {"body": body}
    wires: dict[str, str] = {}
    for name, port in ports.items():
        dead = supply.tube_volume + port.dead
        air = Reservoir(
            dead_volume=dead, exponent=supply.exponent, ports=port.count,
            leakage=supply.leakage,
        )  # fmt: skip
        volume = jnp.max(port.volume) + dead
        gain = supply.bandwidth * volume / (air.gas_constant * air.temperature)
        valve = Regulator(gain, max_flow=supply.max_flow, ports=port.count)
        blocks |= {f"{name}_air": air, f"{name}_valve": valve}
        wires[f"{name}_air.mass_flow"] = f"{name}_valve.mass_flow"
        wires[f"{name}_valve.pressure"] = f"{name}_air.pressure"
        for part in port.parts:
            wires[f"body.{part}_pressure"] = f"{name}_air.pressure"
        for kind, unit in (
            ("volume", "m^3"), ("volume_rate", "m^3/s"), ("compliance", "m^3/Pa")
        ):  # fmt: skip
            sources = [
                f"body.{part}_{kind}" for part in port.parts if f"{part}_{kind}" in body.outputs
            ]
            if not sources:  # solids have no compliance of their own
                continue
            if len(sources) > 1:
                blocks[f"{name}_{kind}"] = sum_of([1.0] * len(sources), unit=unit)
                for letter, source in zip("abcdefgh", sources, strict=False):
                    wires[f"{name}_{kind}.{letter}"] = source
                sources = [f"{name}_{kind}.value"]
            wires[f"{name}_air.{kind}"] = sources[0]
    exposed = tuple(f"{name}_valve.setpoint" for name in ports)
    counts = tuple(port.count for port in ports.values())
    low, high = (
        [x for port in ports.values() for x in [bound(port)] * (port.count or 1)]
        for bound in (lambda port: port.low, lambda port: port.high)
    )
    return Model(Network(blocks, wires, exposed), tuple(ports), counts, low, high)


class Running(NamedTuple):
    """A model at one moment: the state of its network, the memory of the method, and for how
    many calls it has had that."""

    state: Any
    memory: Any
    age: int = 0


Advance = Callable[[Running, Any, float], tuple[Running, Array]]


def stepper(
    model: Model,
    period: float,
    *,
    substeps: int = 2,
    renew: int = 4,
    method: AbstractMethod | None = None,
) -> tuple[Advance, Running]:
    """A model of a robot as a compiled function that a valve board drives step by step.

    `advance(running, setpoint, dt) -> (running, pressures)` takes set-points and gives gauge
    pressures [Pa], one per regulator. The network is integrated by a Rosenbrock method of order
    2, or as `Coupled` where there are finite elements.

    Args:
        model: The robot.
        period: Time of every call [s]; `dt` must equal it.
        substeps: Steps of the method in one call.
        renew: Calls that share a Jacobian, of methods that may use an old one.
        method: By default `Coupled()` for finite elements, `Rosenbrock2(refresh=True)` for
            others.

    Returns:
        `advance`, and what it starts from.

    Raises:
        ValueError: If `period` is not positive; by `advance`, if `dt` is not `period`.
        RuntimeError: By `advance`, if a step does not converge.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> tube = rod.thread_chambers(finger, rod.Straight([3 * mm, 0]), 20e-6)
        >>> body = systems.AssemblyBody(rod.assembly(SE2(), finger=rod.Part(finger)),
        ...                             (rod.On("finger", tube), rod.Damping(0.05)))
        >>> port = robots.Port(("finger",), volume=2e-6, low=0.0, high=50 * kPa)
        >>> advance, running = robots.stepper(robots.supplied(body, {"air": port}), 0.02)
        >>> for _ in range(5):
        ...     running, pressure = advance(running, [10 * kPa], 0.02)
        >>> print(f"{float(pressure[0]) / kPa:.1f} kPa")
        10.0 kPa
    """
    method = _method(model.network) if method is None else method
    _check.positive("stepper", "period", period, "s", "5 ms is period=5e-3.")
    h, zero, fixed = real(period / substeps), jnp.zeros(()), Split(model)

    @eqx.filter_jit
    def begin(fixed, state, setpoint):
        model = fixed.whole()
        return method.begin(Rate(model.network, model.inputs(setpoint)), zero, state, h)

    @eqx.filter_jit
    def move(fixed, state, memory, setpoint):
        model = fixed.whole()
        rate = Rate(model.network, model.inputs(setpoint))
        state, memory, good = repeated(method, rate, zero, state, h, substeps, memory)
        return state, memory, model.pressure(state), good & finite(state)

    def advance(running, setpoint, dt):
        if abs(dt - period) > 1e-9 * period:
            raise ValueError(
                f"stepper: asked for {dt:g} s, made for {period:g} s. Make one for this step."
            )
        state, memory, age = running
        asked = jnp.asarray(setpoint, h.dtype)
        if age >= renew and not (method.keeps or method.carries):
            memory, age = begin(fixed, state, asked), 0
        state, memory, pressure, good = move(fixed, state, memory, asked)
        if not good:
            raise RuntimeError(
                f"stepper: the robot does not get through {period:g} s at set-points of "
                f"{np.asarray(setpoint)} Pa. Make more `substeps`."
            )
        return Running(state, memory, age + 1), pressure

    state, none = model.network.initial_state(), jnp.zeros(len(model.low))
    start = Running(state, begin(fixed, state, none))
    advance(start, none, period)  # compiles
    return advance, start


def _method(network: Network) -> AbstractMethod:
    solid = any(isinstance(block, FemBody) for block in network.blocks.values())
    return Coupled() if solid else Rosenbrock2(refresh=True)


# A rod behind valves: the smallest model that a board can drive


class RodBehindValves(NamedTuple):
    """Coordinates, rates, and pressures [Pa] of a rod at one moment."""

    q: Float[Array, " coordinates"]
    v: Float[Array, " dof"]
    pressure: Float[Array, " ports"]


def rod_stepper(
    rod: Rod,
    forces: Callable[[Float[Array, " ports"]], tuple[Any, ...]],
    ports: int = 1,
    *,
    lag: float = 0.03,
    stepper: AbstractStepper | None = None,
) -> tuple[Callable[..., tuple[RodBehindValves, Array]], RodBehindValves]:
    """`advance(state, setpoint [Pa], dt [s]) -> (state, pressure [Pa])`, compiled, as a valve
    board takes it, and the rod at rest to start from.

    Args:
        rod: The rod.
        forces: What acts on it under given pressures.
        ports: Number of pressures.
        lag: Time constant of the valves [s].
        stepper: `GeneralisedAlpha()` if omitted.
    """
    _check.positive("rod_stepper", "lag", lag, "s", "Small regulators take 0.03.")
    step, delay = GeneralisedAlpha() if stepper is None else stepper, real(lag)

    @jax.jit
    def advance(state: RodBehindValves, setpoint, dt):
        q, v, pressure = state
        pressure = pressure + (setpoint - pressure) * (1 - jnp.exp(-dt / delay))
        problem = second_order(rod, q, forces(pressure))
        zero = jnp.zeros_like(delay)
        new = step.step(problem, zero, dt, start(problem, zero, q, v))
        return RodBehindValves(new.q, new.v, pressure), pressure

    q = rest(rod)
    begin = RodBehindValves(q, jnp.zeros(num_dof(rod), q.dtype), jnp.zeros(ports, q.dtype))
    jax.block_until_ready(advance(begin, begin.pressure, 0.005))  # compiles
    return advance, begin


# Models of each printable robot


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
        return real(self.material.density)


def printed_rubber() -> AbstractHyperelastic:
    """The preset "elastic_80a" at a Poisson's ratio of 0.49, with a density."""
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

    Raises:
        ValueError: If there is no such robot.
    """
    kinds = {"bending": BendingActuator, "planar": PlanarActuator, "hand": Hand,
             "manipulator": Manipulator}  # fmt: skip
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
        SE2(), chebyshev(kappa_z=making.modes, sigma_x=1), column(cell),
        robot.length - robot.pitch, making.material, damping=making.damping, plane=2,
    )  # fmt: skip
    front = Box(
        jnp.stack([robot.length - half, -robot.width, -half]),
        jnp.stack([robot.length, robot.width, 2 * robot.height]),
    )
    end = jnp.stack([robot.length, zero, middle])
    tip = _flat(rigid(robot.body() & front, end, LYING, making.density))
    whole = assembly(
        SE2(), actuator=Part(made.rod, offset=_placed(jnp.eye(2), jnp.stack([half, middle]))),
        tip=Part(tip, on="actuator", offset=_placed(jnp.eye(2), jnp.stack([half, zero]))),
    )  # fmt: skip
    port = Port(("actuator",), made.chambers.rest[0], -10 * kPa, 100 * kPa)
    return supplied(_moving(whole, actuator=made), {"actuator": port}, making.supply)


@_model.register
def _(robot: PlanarActuator, making: Making) -> Model:
    cell = bellows_cell(robot.bellows, making.material, making.size)
    b, half = robot.bellows, robot.spacing / 2
    length, zero = b.num_folds * b.pitch, jnp.zeros_like(half)
    # local y of the rod points against x of the drawing, to which it stands upright
    places = jnp.stack([jnp.stack([half, zero]), jnp.stack([-half, zero])])
    made = body(
        SE2(), constant("kappa_z", "sigma_x", "sigma_y"), side_by_side(cell, places, length),
        length, making.material, damping=making.damping,
    )  # fmt: skip
    plate = rigid(_end_plate(robot), [0.0, 0.0, b.cap + length], STANDING, making.density)
    upright = _placed(jnp.array([[0.0, -1.0], [1.0, 0.0]]), [0.0, b.cap])
    whole = assembly(
        SE2(), bellows=Part(made.rod, offset=upright), plate=Part(_flat(plate), on="bellows")
    )
    port = Port(("bellows",), made.chambers.rest, -10 * kPa, 50 * kPa, count=2)
    return supplied(_moving(whole, bellows=made), {"bellows": port}, making.supply)


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
    return supplied(_moving(assembly(SE3(), **parts), **bodies), ports, making.supply)


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
        SE3(), constant("kappa_y", "kappa_z", "sigma_x", "sigma_y", "sigma_z"),
        side_by_side(cell, robot.center_distance * around, length), length, making.material,
        damping=making.damping,
    )  # fmt: skip
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
    return supplied(_moving(assembly(SE3(), **parts), **bodies), ports, making.supply)


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
        SE3(), chebyshev(kappa_y=1, kappa_z=making.modes, sigma_x=1), column(cell),
        end - start, making.material, damping=making.damping,
    )  # fmt: skip
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
        listed += [On(name, force) for force in (*one.forces, one.chambers)]
    return AssemblyBody(whole, tuple(listed))


def _flat(link: Link) -> Link:
    """A link that moves in the plane of its x and y."""
    assert link.center is not None
    return Link(link.mass, link.inertia[2, 2], link.center[:2])


def _placed(rotation, position) -> Array:
    return homogeneous(real(rotation), real(position))


def _about_z(angle) -> Array:
    c, s = jnp.cos(real(angle)), jnp.sin(real(angle))
    o = jnp.zeros_like(c)
    return jnp.stack([jnp.stack(row) for row in ([c, -s, o], [s, c, o], [o, o, o + 1])])
