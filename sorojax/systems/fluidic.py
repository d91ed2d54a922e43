"""Pneumatics: a gas volume and the valve that feeds it.

Ports carry gauge pressure [Pa]; the gas law is written in absolute pressure.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.systems.block import AbstractBlock, Input, Output

ATMOSPHERE = 101325.0  # Pa
AIR = 287.05  # J/(kg K)


class Reservoir(AbstractBlock):
    """A well-mixed gas of changing volume, fed by mass flow.

    With absolute pressure p, n = `exponent` and V' = volume_rate + compliance p':
    p' = n (R T m' - p V') / V, so that a sealed reservoir keeps p V^n. The state is the
    absolute pressure.

    Attributes:
        start_pressure: Gauge pressure at the start [Pa].
        dead_volume: Volume of tubes and fittings, added to the input [m^3].
        exponent: Polytropic exponent: 1 isothermal, 1.4 fast (adiabatic air) [-].
        temperature: [K].
        gas_constant: Specific gas constant [J/(kg K)].
        atmosphere: Absolute pressure outside [Pa].
        ports: Number of independent chambers; None for a single scalar one.
    """

    start_pressure: Float[Array, "*ports"] = eqx.field(converter=real, default=0.0)
    dead_volume: Float[Array, "*ports"] = eqx.field(converter=real, default=0.0)
    exponent: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    temperature: Float[Array, ""] = eqx.field(converter=real, default=293.15)
    gas_constant: Float[Array, ""] = eqx.field(converter=real, default=AIR)
    atmosphere: Float[Array, ""] = eqx.field(converter=real, default=ATMOSPHERE)
    ports: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        do = "Pressures at ports are gauge: 0 Pa is the atmosphere."
        absolute = self.start_pressure + self.atmosphere
        _check.positive("Reservoir", "start_pressure + atmosphere", absolute, "Pa", do)
        _check.positive("Reservoir", "temperature", self.temperature, "K", "Add 273.15.")

    @property
    def inputs(self):
        shape = _ports(self.ports)
        return {
            "mass_flow": Input("kg/s", shape, default=0.0),
            "volume": Input("m^3", shape),
            "volume_rate": Input("m^3/s", shape, default=0.0),
            "compliance": Input("m^3/Pa", shape, default=0.0),
        }

    @property
    def outputs(self):
        return {"pressure": Output("Pa", _ports(self.ports))}

    def initial_state(self):
        return jnp.broadcast_to(self.start_pressure + self.atmosphere, _ports(self.ports))

    def output(self, name, t, state, inputs):
        return state - self.atmosphere

    def vector_field(self, t, state, inputs):
        volume = inputs["volume"] + self.dead_volume
        supply = self.gas_constant * self.temperature * inputs["mass_flow"]
        stretch = self.exponent * state * inputs["compliance"]
        return self.exponent * (supply - state * inputs["volume_rate"]) / (volume + stretch)


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
