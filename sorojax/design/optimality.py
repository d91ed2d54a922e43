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


@eqx.filter_jit
def _update(method: OptimalityCriteria, x, values: Values):
    cost = values.slopes[0]
    gain = jnp.maximum(-values.gradient, 1e-10 * jnp.max(jnp.abs(values.gradient))) / cost
    least = jnp.maximum(method.lower, x - method.move)
    most = jnp.minimum(method.upper, x + method.move)

    logs = jnp.log(gain)
    full = x * jnp.exp(method.damping * logs)

    def proposal(log_price):
        return jnp.clip(full * jnp.exp(-method.damping * log_price), least, most)

    def halve(_, span):
        middle = (span[0] + span[1]) / 2
        heavy = values.constraints[0] + cost @ (proposal(middle) - x) > 0
        return jnp.where(heavy, middle, span[0]), jnp.where(heavy, span[1], middle)

    span = (jnp.min(logs) - 60.0, jnp.max(logs) + 60.0)
    low, high = jax.lax.fori_loop(0, 80, halve, span)
    return proposal((low + high) / 2)
