"""The optimality-criteria method: the baseline for compliance under one volume constraint.

Reference: Sigmund, "A 99 line topology optimization code written in Matlab", Struct.
Multidisc. Optim. 21, 2001.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.design.mma import Values

_FAR = 60.0  # beyond every gain: how far the logarithm of the price may go
_EXACT, _MOST = 1e-14, 100  # change of the logarithm of the price at which to stop, and steps


class OptimalityCriteria(eqx.Module):
    """Scales each variable by how much it gains against what it costs.

    One constraint, taken as linear; the objective should fall with every variable.

    Attributes:
        lower, upper: Bounds of the variables.
        move: Largest change of a variable in a step.
        damping: Exponent of the scaling; 0.3 for mechanisms.
    """

    lower: Float[Array, "..."] = eqx.field(converter=real, default=0.0)
    upper: Float[Array, "..."] = eqx.field(converter=real, default=1.0)
    move: Float[Array, ""] = eqx.field(converter=real, default=0.2)
    damping: Float[Array, ""] = eqx.field(converter=real, default=0.5)

    def init(self, x: Float[Array, " n"], constraints: int) -> None:
        """No state.

        Raises:
            ValueError: If there is not exactly one constraint.
        """
        if constraints != 1:
            raise ValueError(
                f"OptimalityCriteria: got {constraints} constraints, need one. Use MMA."
            )

    def update(self, x: Float[Array, " n"], values: Values, state: None):
        """The next design; None is the state."""
        return _update(self, x, values), None


@jax.jit
def _update(method: OptimalityCriteria, x, values: Values):
    cost = values.slopes[0]
    gain = jnp.maximum(-values.gradient, 1e-10 * jnp.max(jnp.abs(values.gradient))) / cost
    least = jnp.maximum(method.lower, x - method.move)
    most = jnp.minimum(method.upper, x + method.move)

    logs = jnp.log(gain)
    full = x * jnp.exp(method.damping * logs)

    def proposal(log_price):
        return jnp.clip(full * jnp.exp(-method.damping * log_price), least, most)

    def excess(log_price):
        """Of the constraint, and its slope: variables at a limit do not move."""
        new = proposal(log_price)
        free = (new > least) & (new < most)
        slope = -method.damping * jnp.sum(jnp.where(free, cost * new, jnp.zeros_like(new)))
        return values.constraints[0] + cost @ (new - x), slope

    def improve(state):
        price, low, high, _, count = state
        value, slope = excess(price)
        low, high = jnp.where(value > 0, price, low), jnp.where(value > 0, high, price)
        step = price - value / slope
        new = jnp.where((step >= low) & (step <= high), step, (low + high) / 2)
        return new, low, high, jnp.abs(new - price) <= _EXACT * (1 + jnp.abs(new)), count + 1

    low, high = jnp.min(logs) - _FAR, jnp.max(logs) + _FAR
    start = ((jnp.min(logs) + jnp.max(logs)) / 2, low, high, jnp.asarray(False), 0)
    end = jax.lax.while_loop(lambda state: ~state[3] & (state[4] < _MOST), improve, start)
    return proposal(end[0])
