"""Paths through waypoints, of a point or of several signals at once."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.systems.source import AbstractReference


class Waypoints(AbstractReference):
    """Straight from waypoint to waypoint; two at the same time make a jump.

    Attributes:
        times: Of the waypoints [s], none before the one in front of it.
        values: One row each, held before the first and after the last.
        smooth: Stop at every waypoint, without a jump of rate or acceleration.
    """

    times: Float[Array, " points"] = eqx.field(converter=real)
    values: Float[Array, "points ..."] = eqx.field(converter=real)
    smooth: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        do = "Give one row of values per time."
        _check.shape("Waypoints", "times", self.times, self.values.shape[:1], do)
        if _check.is_concrete(self.times) and bool(jnp.any(jnp.diff(self.times) < 0)):
            raise ValueError(
                f"Waypoints: `times` are {self.times} s, need each at or after the one before. "
                "Sort the waypoints."
            )

    def __call__(self, t):
        last = self.times.shape[0] - 1
        after = jnp.clip(jnp.searchsorted(self.times, t, side="right"), 1, last)
        start, length = self.times[after - 1], self.times[after] - self.times[after - 1]
        share = (t - start) / jnp.where(length > 0, length, jnp.ones_like(length))
        share = jnp.where(length > 0, jnp.clip(share, 0, 1), jnp.ones_like(share))
        share = share**3 * (10 + share * (6 * share - 15)) if self.smooth else share
        return self.values[after - 1] + share * (self.values[after] - self.values[after - 1])
