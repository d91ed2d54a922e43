"""Valves: an opening that lags its command and lets gas through by pressure."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.systems.block import AbstractBlock, Input, Output
from sorojax.systems.fluidic import AIR, ATMOSPHERE


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
