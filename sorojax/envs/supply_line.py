"""What a command has become when it reaches the robot: late, and smoothed by a lag."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real

LATE_STEPS = 2  # of an environment, that a dead time may last at most


class SupplyLine(eqx.Module):
    """Tube and regulator between a command and the robot: a dead time, then a first-order lag.

    Attributes:
        lag: Time constant [s].
        dead_time: What passes before a command begins to act [s], at most two steps of the
            environment.
    """

    lag: Float[Array, ""] = eqx.field(converter=real)
    dead_time: Float[Array, ""] = eqx.field(converter=real, default=0.0)

    def __check_init__(self):
        do = "A regulator at the end of a metre of tube has 20 to 100 ms."
        _check.positive("SupplyLine", "lag", self.lag, "s", do)
        _check.not_negative("SupplyLine", "dead_time", self.dead_time, "s", "Or leave it out.")


class Supplied(NamedTuple):
    """`value`, what arrives now, and the `commands` on their way, the newest first."""

    value: Float[Array, " actions"]
    commands: Float[Array, "late actions"]


class Delivery(eqx.Module):
    """What arrives during one step, by the time since it began [s]."""

    value: Float[Array, " actions"]
    before: Float[Array, " actions"]
    after: Float[Array, " actions"]
    change: Float[Array, ""]
    lag: Float[Array, ""]

    def __call__(self, t: Float[Array, ""]) -> Float[Array, " actions"]:
        first, second = jnp.minimum(t, self.change), jnp.maximum(t - self.change, 0.0)
        middle = self.before + (self.value - self.before) * jnp.exp(-first / self.lag)
        return self.after + (middle - self.after) * jnp.exp(-second / self.lag)


def begun(value: Float[Array, " actions"]) -> Supplied:
    """A line that has carried one command for long."""
    return Supplied(value, jnp.broadcast_to(value[None], (LATE_STEPS + 2, *value.shape)))


def sent(
    line: SupplyLine, supplied: Supplied, command: Float[Array, " actions"], period
) -> tuple[Delivery, Supplied]:
    """What arrives during a step of `period` [s] that begins with a command, and the line at
    its end: tau p' = u(t - d) - p, exact for held commands."""
    commands = jnp.concatenate([command[None], supplied.commands[:-1]])
    late = jnp.clip(line.dead_time / period, 0.0, LATE_STEPS)
    whole = jnp.floor(late)
    change, k = (late - whole) * period, whole.astype(jnp.int32)
    delivery = Delivery(supplied.value, commands[k + 1], commands[k], change, line.lag)
    return delivery, Supplied(delivery(period), commands)


def between(fast: SupplyLine, slow: SupplyLine, share: Float[Array, "2"]) -> SupplyLine:
    """A line whose lag and dead time are so far from a fast to a slow one, 0 to 1 each."""
    lag = fast.lag + share[0] * (slow.lag - fast.lag)
    return SupplyLine(lag, fast.dead_time + share[1] * (slow.dead_time - fast.dead_time))
