"""Progress of a compiled run, told to the listener of the framework."""

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _progress


def tell(share) -> None:
    """Report that `share` of a simulation is done, from inside a compiled program."""
    jax.debug.callback(lambda x: _progress.report("simulate", float(x), 1.0), share)


class Meter(dfx.AbstractProgressMeter):
    """Reports every hundredth of the time from `start` to `end`, of a run whose steps may
    lead further, at most to `far`."""

    start: Float[Array, ""]
    far: Float[Array, ""]
    end: Float[Array, ""]

    def init(self):
        return jnp.zeros_like(self.end)

    def step(self, state, progress):
        passed = progress * (self.far - self.start)
        share = jnp.minimum(passed / (self.end - self.start), 1.0).astype(state.dtype)
        due = (share >= state + 0.01) | ((share >= 1.0) & (state < 1.0))
        jax.lax.cond(due, tell, lambda _: None, share)
        return jnp.where(due, share, state)

    def close(self, state):
        pass
