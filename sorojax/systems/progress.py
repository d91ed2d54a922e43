"""Progress of an adaptive run, told to the listener of the framework."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.math import told


class Meter(dfx.AbstractProgressMeter):
    """Reports every hundredth of the time from `start` to `end`, of a run whose steps may
    lead further, at most to `far`; of lanes that run at once their mean."""

    start: Float[Array, ""]
    far: Float[Array, ""]
    end: Float[Array, ""]
    label: str = eqx.field(static=True, default="simulate")

    def init(self):
        return jnp.zeros_like(self.end)

    def step(self, state, progress):
        passed = jax.lax.stop_gradient(progress * (self.far - self.start))
        share = jnp.minimum(passed / (self.end - self.start), 1.0).astype(state.dtype)
        # one number for all lanes, so that the condition stays one under `vmap`
        share, last = told.mean_of_lanes(share), told.largest_of_lanes(state)
        due = (share >= last + 0.01) | ((share >= 1.0) & (last < 1.0))
        jax.lax.cond(due, lambda x: told.tell(self.label, x), lambda _: None, share)
        return jnp.where(due, share, last)

    def close(self, state):
        pass
