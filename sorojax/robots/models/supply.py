"""A body with its air: reservoirs and regulators wired to an assembly, as a board sees it,
and such models step by step, for a board to drive."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed, number
from sorojax._jax.jit import once
from sorojax._types import real
from sorojax.math.compiled import Split
from sorojax.math.ode.explicit import AbstractMethod, finite, repeated
from sorojax.math.ode.steppers import AbstractStepper, GeneralisedAlpha, start
from sorojax.rod import Assembly, Rod, num_dof, rest
from sorojax.rod.dynamics.rollout import second_order
from sorojax.systems import (
    AbstractBlock,
    AssemblyBody,
    Coupled,
    Network,
    Regulator,
    Reservoir,
    Rosenbrock2,
    sum_of,
)
from sorojax.systems.integrate.coupled import bodies_of
from sorojax.systems.integrate.march import Rate


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
            pressure = air.output("pressure", jnp.zeros(()), state[f"{name}_air"], {})
            found.append(jnp.atleast_1d(pressure))
        return jnp.concatenate(found)


def with_pneumatics(
    body: AbstractBlock, ports: Mapping[str, Port], supply: Supply | None = None
) -> Model:
    """A body with a reservoir and a regulator at every port.

    Args:
        body: An `AssemblyBody`, a `FemBody`, or any block that takes `PART_pressure` and gives
            `PART_volume` and `PART_volume_rate` of every part that a port names.
        ports: By name.
        supply: Tubes and regulators; `Supply()` if omitted.

    Returns:
        The network with its supply.
    """
    supply = Supply() if supply is None else supply
    blocks: dict[str, Any] = {"body": body}
    wires: dict[str, str] = {}
    for name, port in ports.items():
        dead = supply.tube_volume + port.dead
        air = Reservoir(
            dead_volume=dead, exponent=supply.exponent, ports=port.count, leakage=supply.leakage
        )
        volume = jnp.max(port.volume) + dead
        gain = supply.bandwidth * volume / (air.gas_constant * air.temperature)
        valve = Regulator(gain, max_flow=supply.max_flow, ports=port.count)
        blocks |= {f"{name}_air": air, f"{name}_valve": valve}
        wires[f"{name}_air.mass_flow"] = f"{name}_valve.mass_flow"
        wires[f"{name}_valve.pressure"] = f"{name}_air.pressure"
        for part in port.parts:
            wires[f"body.{part}_pressure"] = f"{name}_air.pressure"
        for kind, unit in (
            ("volume", "m^3"),
            ("volume_rate", "m^3/s"),
            ("compliance", "m^3/Pa"),
        ):
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
    """A model at one moment: the `state` of its network, the `memory` of the method, and its
    `age`, for how many calls it has had that."""

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
        ...                             (rod.PartForce("finger", tube), rod.Damping(0.05)))
        >>> port = robots.Port(("finger",), volume=2e-6, low=0.0, high=50 * kPa)
        >>> advance, running = robots.stepper(robots.with_pneumatics(body, {"air": port}), 0.02)
        >>> for _ in range(5):
        ...     running, pressure = advance(running, [10 * kPa], 0.02)
        >>> print(f"{float(pressure[0]) / kPa:.1f} kPa")
        10.0 kPa
    """
    if method is None:
        method = Coupled() if bodies_of(model.network) else Rosenbrock2(refresh=True)
    _check.positive("stepper", "period", period, "s", "5 ms is period=5e-3.")
    h, zero, fixed = real(period / substeps), jnp.zeros(()), Split(model)
    # the products of many cells run faster by the compiler's own loops
    compiled = eqx.filter_jit if bodies_of(model.network) else once

    @compiled
    def begin(fixed, state, setpoint):
        model = fixed.whole()
        return method.begin(Rate(model.network, model.inputs(setpoint)), zero, state, h)

    @compiled
    def move(fixed, state, memory, setpoint):
        model = fixed.whole()
        rate = Rate(model.network, model.inputs(setpoint))
        state, memory, good = repeated(method, rate, zero, state, h, substeps, memory)
        return state, memory, model.pressure(state), good & finite(state)

    def advance(running, setpoint, dt):
        check_period("stepper", dt, period)
        state, memory, age = running
        asked = jnp.asarray(setpoint, h.dtype)
        if age >= renew and not (method.keeps or method.carries):
            memory, age = begin(fixed, state, asked), 0
        state, memory, pressure, good = move(fixed, state, memory, asked)
        check_moved("stepper", good, period, setpoint)
        return Running(state, memory, age + 1), pressure

    state, none = model.network.initial_state(), jnp.zeros(len(model.low))
    start = Running(state, begin(fixed, state, none))
    advance(start, none, period)  # compiles
    return advance, start


def check_period(where: str, dt: float, period: float) -> None:
    """Raise a `ValueError` if a call is to advance by another time than it was made for."""
    if abs(dt - period) > 1e-9 * period:
        raise ValueError(
            f"{where}: asked for {dt:g} s, made for {period:g} s. Make one for this step."
        )


def check_moved(where: str, good: Array, period: float, setpoint: Any) -> None:
    """Raise a `RuntimeError` unless all is `good` after a call."""
    if not good:
        raise RuntimeError(
            f"{where}: the robot does not get through {period:g} s at set-points of "
            f"{np.asarray(setpoint)} Pa. Make more `substeps`."
        )


# A rod behind valves: the smallest model that a board can drive


class RodBehindValves(NamedTuple):
    """Coordinates `q`, rates `v`, and `pressure` [Pa] by port of a rod at one moment."""

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

    Returns:
        `advance`, and the state to start from.
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
