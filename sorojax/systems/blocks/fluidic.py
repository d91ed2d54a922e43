"""Pneumatics: a gas volume and the valve that feeds it.

Ports carry gauge pressure [Pa]; the gas law is written in absolute pressure.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.math.status import Status
from sorojax.systems.blocks.block import AbstractBlock, Input, Output

ATMOSPHERE = 101325.0  # Pa
AIR = 287.05  # J/(kg K)
_THIN = 1e3  # Pa, absolute: below it no pump draws its whole flow
_NOISE = 10.0  # Pa that errors of steps may carry a pressure below vacuum


class Reservoir(AbstractBlock):
    """A well-mixed gas of changing volume, fed by mass flow.

    With absolute pressure p, n = `exponent` and V' = volume_rate + compliance p':
    p' = (n (R T m' - p V') - n leakage (p - atmosphere) V) / V, so that a sealed reservoir
    without leak keeps p V^n. The state is the absolute pressure. Where it is below 1 kPa, flow
    out falls with it, to none at vacuum, whatever the wire carries.

    Where no rate of the volume is at hand, `bandwidth` a makes one: z' = -a (z + a V) and
    V' = z + a V, exact for slow volumes and late by 1/a. It adds a pole at -a.

    Attributes:
        start_pressure: Gauge pressure at the start [Pa].
        dead_volume: Volume of tubes and fittings, added to the input [m^3].
        exponent: Polytropic exponent: 1 isothermal, 1.4 fast (adiabatic air) [-].
        temperature: [K].
        gas_constant: Specific gas constant [J/(kg K)].
        atmosphere: Absolute pressure outside [Pa].
        ports: Number of independent chambers; None for a single scalar one.
        leakage: Rate at which a rigid isothermal reservoir loses gauge pressure [1/s]; printed
            chambers have 1e-5 to 3e-2.
        volume: Volume of a rigid vessel [m^3], which then has no port for it.
        bandwidth: Of the rate of the volume [rad/s], which then has no port.
        start_volume: Input volume at the start [m^3], for `bandwidth` only.

    Reference:
        Caasenbrood, Pogromsky, Nijmeijer, Sorotoki, 2024, eq. 25 to 27, with the sign of the
        filter mended.
    """

    start_pressure: Float[Array, "*ports"] = eqx.field(converter=real, default=0.0)
    dead_volume: Float[Array, "*ports"] = eqx.field(converter=real, default=0.0)
    exponent: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    temperature: Float[Array, ""] = eqx.field(converter=real, default=293.15)
    gas_constant: Float[Array, ""] = eqx.field(converter=real, default=AIR)
    atmosphere: Float[Array, ""] = eqx.field(converter=real, default=ATMOSPHERE)
    ports: int | None = eqx.field(static=True, default=None)
    leakage: Float[Array, "*ports"] = eqx.field(converter=real, default=0.0)
    volume: Float[Array, "*ports"] | None = eqx.field(converter=optional_real, default=None)
    bandwidth: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    start_volume: Float[Array, "*ports"] | None = eqx.field(
        converter=optional_real, default=None
    )

    def __check_init__(self):
        do = "Pressures at ports are gauge: 0 Pa is the atmosphere."
        absolute = self.start_pressure + self.atmosphere
        _check.positive("Reservoir", "start_pressure + atmosphere", absolute, "Pa", do)
        _check.positive("Reservoir", "temperature", self.temperature, "K", "Add 273.15.")
        if self.bandwidth is not None and (
            self.start_volume is None or self.volume is not None
        ):
            raise ValueError(
                "Reservoir: `bandwidth` differentiates a volume that changes, need its value "
                "at the start and no fixed `volume`. Give start_volume=, or leave `bandwidth` "
                "out."
            )

    @property
    def inputs(self):
        shape = _ports(self.ports)
        ports = {"mass_flow": Input("kg/s", shape, default=0.0)}
        if self.volume is None:
            ports["volume"] = Input("m^3", shape)
            if self.bandwidth is None:  # the filtered rate holds what yielding walls add
                ports["volume_rate"] = Input("m^3/s", shape)
                ports["compliance"] = Input("m^3/Pa", shape, default=0.0)
        return ports

    @property
    def outputs(self):
        return {"pressure": Output("Pa", _ports(self.ports))}

    def initial_state(self):
        shape = _ports(self.ports)
        pressure = jnp.broadcast_to(self.start_pressure + self.atmosphere, shape)
        if self.bandwidth is None or self.start_volume is None:
            return pressure
        delay = jnp.broadcast_to(-self.bandwidth * self.start_volume, shape)
        return {"pressure": pressure, "filter": delay}

    def output(self, name, t, state, inputs):
        return self._pressure(state) - self.atmosphere

    def vector_field(self, t, state, inputs):
        pressure = self._pressure(state)
        if self.volume is not None:
            return self._rate(pressure, inputs, self.volume, 0.0, 0.0)
        volume = inputs["volume"]
        if self.bandwidth is None:
            growth, compliance = inputs["volume_rate"], inputs["compliance"]
            return self._rate(pressure, inputs, volume, growth, compliance)
        growth = state["filter"] + self.bandwidth * volume
        rate = self._rate(pressure, inputs, volume, growth, 0.0)
        return {"pressure": rate, "filter": -self.bandwidth * growth}

    def path_status(self, path):
        above = jnp.all(jax.lax.stop_gradient(self._pressure(path)) > -_NOISE)
        return Status.where(above, Status.successful, Status.outside_model)

    def _pressure(self, state):
        return state if self.bandwidth is None else state["pressure"]

    def _rate(self, pressure, inputs, volume, growth, compliance):
        whole = volume + self.dead_volume
        flow = inputs["mass_flow"]
        left = jnp.where(pressure > 0, pressure / _THIN, jnp.zeros_like(pressure))
        flow = jnp.where((flow < 0) & (pressure < _THIN), left * flow, flow)
        supply = self.gas_constant * self.temperature * flow
        lost = self.leakage * (pressure - self.atmosphere) * whole
        stretch = self.exponent * pressure * compliance
        return self.exponent * (supply - lost - pressure * growth) / (whole + stretch)


class Regulator(AbstractBlock):
    """A proportional pressure regulator: PI from the pressure error to a mass flow.

    nu = proportional e + integral of (integral_gain e), e = setpoint - pressure, limited to
    +- max_flow. The integral is drawn back by the part that the limit cut off.

    Attributes:
        proportional: [kg/(s Pa)].
        integral_gain: [kg/(s^2 Pa)].
        max_flow: Largest mass flow, in and out [kg/s].
        ports: Number of independent valves; None for a single scalar one.
    """

    proportional: Float[Array, ""] = eqx.field(converter=real)
    integral_gain: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    max_flow: Float[Array, ""] = eqx.field(converter=real, default=math.inf)
    ports: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        do = "A small bench regulator has about 1e-8 kg/(s Pa)."
        _check.positive("Regulator", "proportional", self.proportional, "kg/(s Pa)", do)

    @property
    def inputs(self):
        shape = _ports(self.ports)
        return {"setpoint": Input("Pa", shape), "pressure": Input("Pa", shape)}

    @property
    def outputs(self):
        needs = frozenset({"setpoint", "pressure"})
        return {"mass_flow": Output("kg/s", _ports(self.ports), needs)}

    def initial_state(self):
        return jnp.zeros(_ports(self.ports), self.proportional.dtype)

    def output(self, name, t, state, inputs):
        return self._flows(state, inputs)[0]

    def vector_field(self, t, state, inputs):
        limited, wanted = self._flows(state, inputs)
        error = inputs["setpoint"] - inputs["pressure"]
        excess = (limited - wanted) / self.proportional
        return self.integral_gain * (error + excess)

    def _flows(self, state, inputs) -> tuple[Array, Array]:
        """Mass flow within and without the limit."""
        error = inputs["setpoint"] - inputs["pressure"]
        wanted = self.proportional * error + state
        return jnp.clip(wanted, -self.max_flow, self.max_flow), wanted


def _ports(count: int | None) -> tuple[int, ...]:
    return () if count is None else (count,)


# Valves: an opening that lags its command and lets gas through by pressure


class Valve(AbstractBlock):
    """An orifice between two gauge pressures, opened by a command from 0 to 1.

    The opening follows its command with a lag, after a delay of first-order stages. The flow
    is that of ISO 6358: m' = C rho p_up sqrt(T0 / T) below the critical pressure ratio b,
    times sqrt(1 - ((r - b) / (1 - b))^2) above it; from upstream to downstream, backwards
    where the pressures are the other way round.

    Attributes:
        conductance: Sonic conductance C of the open valve [m^3/(s Pa)].
        critical_ratio: b, 0.5 of an orifice, 0.2 to 0.4 of valves [-].
        lag: Time constant of the opening [s].
        delay: Dead time before it [s], as `stages` lags in series; 0 for none.
        temperature: Upstream [K].
        laminar_ratio: Where 1 - r is smaller the flow is linear, as its slope would be
            infinite at equal pressures [-].
        stages: Number of lags that make the delay.

    Reference:
        ISO 6358-1:2013, with the linear flow of ISO 6358-3 near equal pressures.
    """

    conductance: Float[Array, ""] = eqx.field(converter=real)
    critical_ratio: Float[Array, ""] = eqx.field(converter=real, default=0.3)
    lag: Float[Array, ""] = eqx.field(converter=real, default=5e-3)
    delay: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    temperature: Float[Array, ""] = eqx.field(converter=real, default=293.15)
    laminar_ratio: Float[Array, ""] = eqx.field(converter=real, default=1e-3)
    stages: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        do = "A small bench valve has about 1e-9 m^3/(s Pa) and 5 ms."
        _check.positive("Valve", "conductance", self.conductance, "m^3/(s Pa)", do)
        _check.positive("Valve", "lag", self.lag, "s", do)
        ratio = self.critical_ratio
        _check.between("Valve", "critical_ratio", ratio, 0, 1, "", "Valves have 0.2 to 0.5.")
        if self.stages > 0:
            _check.positive("Valve", "delay", self.delay, "s", "Or take stages=0.")

    @property
    def inputs(self):
        return {
            "command": Input(None),
            "upstream": Input("Pa"),
            "downstream": Input("Pa", (), 0.0),
        }

    @property
    def outputs(self):
        needs = frozenset({"upstream", "downstream"})
        return {"mass_flow": Output("kg/s", (), needs), "opening": Output(None)}

    def initial_state(self):
        zero = jnp.zeros_like(self.lag)
        return {"opening": zero, "late": jnp.zeros(self.stages, self.lag.dtype)}

    def output(self, name, t, state, inputs):
        opening = jnp.clip(state["opening"], 0, 1)
        if name == "opening":
            return opening
        return opening * self._flow(inputs["upstream"], inputs["downstream"])

    def vector_field(self, t, state, inputs):
        command = jnp.clip(inputs["command"], 0, 1)
        chain = jnp.concatenate([command[None], state["late"]])
        late = jnp.diff(-chain) * (self.stages / self.delay) if self.stages else state["late"]
        return {"opening": (chain[-1] - state["opening"]) / self.lag, "late": late}

    def _flow(self, upstream, downstream):
        high = jnp.maximum(upstream, downstream) + ATMOSPHERE
        low = jnp.minimum(upstream, downstream) + ATMOSPHERE
        density = 1e5 / (AIR * 293.15)  # at 100 kPa and 20 degrees, as C is defined
        choked = density * self.conductance * high * jnp.sqrt(293.15 / self.temperature)
        drop, linear = 1 - low / high, self.laminar_ratio
        safe = self._share(1 - jnp.maximum(drop, linear))
        share = jnp.where(drop < linear, self._share(1 - linear) * drop / linear, safe)
        return jnp.sign(upstream - downstream) * choked * share

    def _share(self, ratio):
        """Share of the choked flow at a pressure ratio."""
        x = (ratio - self.critical_ratio) / (1 - self.critical_ratio)
        return jnp.sqrt(1 - jnp.clip(x, 0, 1) ** 2)
