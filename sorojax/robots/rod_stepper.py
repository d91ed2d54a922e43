"""A rod behind valves: the smallest model that a board can drive."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.math.steppers import AbstractStepper, GeneralisedAlpha, start
from sorojax.rod import Rod, num_dof, rest
from sorojax.rod.rollout import second_order


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
