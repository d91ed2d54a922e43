"""Stiffness as a function of density.

References:
    Bendsoe, Sigmund, Topology Optimization, 2003.
    Stolpe, Svanberg, "An alternative interpolation scheme for minimum compliance topology
    optimization", Struct. Multidisc. Optim. 22, 2001.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real


class Simp(eqx.Module):
    """least + (1 - least) density^penalty, as a factor of the full stiffness.

    Attributes:
        penalty: Exponent; 3 makes grey material uneconomic.
        least: Factor of the void, so that the tangent has an inverse.
    """

    penalty: Float[Array, ""] = eqx.field(converter=real, default=3.0)
    least: Float[Array, ""] = eqx.field(converter=real, default=1e-9)

    def __call__(self, density: Float[Array, " cells"]) -> Float[Array, " cells"]:
        # 0^penalty has no finite derivative of all orders
        safe = jnp.maximum(density, 1e-12)
        return self.least + (1 - self.least) * safe**self.penalty


class Ramp(eqx.Module):
    """least + (1 - least) density / (1 + q (1 - density)): has a slope at zero density.

    Attributes:
        q: 0 is linear; 8 is about as severe as `Simp(3)`.
        least: Factor of the void.
    """

    q: Float[Array, ""] = eqx.field(converter=real, default=8.0)
    least: Float[Array, ""] = eqx.field(converter=real, default=1e-9)

    def __call__(self, density: Float[Array, " cells"]) -> Float[Array, " cells"]:
        return self.least + (1 - self.least) * density / (1 + self.q * (1 - density))
