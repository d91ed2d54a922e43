"""A fluid around a rod: buoyancy and drag."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.rod.forces import AbstractForce, gravity_or_earth
from sorojax.rod.points import nodes, safe_norm


class Buoyancy(AbstractForce):
    """Weight of the displaced fluid, upwards.

    Attributes:
        density: Of the fluid [kg/m^3].
        acceleration: Of gravity [m/s^2]; by default 9.81 against the last axis.
    """

    density: Float[Array, ""] = eqx.field(converter=real)
    acceleration: Float[Array, " dim"] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        _check.positive("Buoyancy", "density", self.density, "kg/m^3", "Water has 1000.")

    def __call__(self, t, motion):
        g = gravity_or_earth(self.acceleration, motion)
        volume = motion.operators.mass / motion.rod.material.density
        loads = -self.density * volume[:, None] * g[None, :]
        return loads.reshape(-1) @ motion.linear_jacobian.reshape(-1, motion.q.shape[0])


class Drag(AbstractForce):
    """Resistance of a fluid, per length, across and along the rod.

    Quadratic: density * diameter * C |v| v / 2 with each part of the velocity, the
    coefficient along the rod taken on the circumference; linear: `viscous` times the
    velocity. In a fluid at rest every part takes energy from the rod.

    Attributes:
        density: Of the fluid [kg/m^3].
        diameter: Width of the rod [m].
        across: Drag coefficient of the velocity across the rod [-].
        along: Friction coefficient of the velocity along it, about 0.01 [-].
        viscous: Linear coefficient [N s/m^2]; None costs nothing.
        flow: Velocity of the fluid [m/s]; at rest if None.

    Reference:
        Taylor, Analysis of the swimming of long and narrow animals, Proc. R. Soc. A 214,
        1952, for the split into both parts.
    """

    density: Float[Array, ""] = eqx.field(converter=real)
    diameter: Float[Array, "*quad"] = eqx.field(converter=real)
    across: Float[Array, ""] = eqx.field(converter=real, default=1.1)
    along: Float[Array, ""] = eqx.field(converter=real, default=0.01)
    viscous: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    flow: Float[Array, " dim"] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        _check.positive("Drag", "density", self.density, "kg/m^3", "Water has 1000.")
        _check.positive("Drag", "diameter", self.diameter, "m", "Give the width of the rod.")

    def __call__(self, t, motion):
        at = nodes(motion)
        velocity = at.velocity
        if self.flow is not None:
            velocity = velocity - self.flow[None]
        stretch = safe_norm(motion.tangent)[:, None]
        axis = motion.tangent / stretch
        lengthwise = jnp.sum(axis * velocity, axis=1, keepdims=True) * axis
        crosswise = velocity - lengthwise
        width = self.density * jnp.broadcast_to(self.diameter, stretch.shape[:1])[:, None] / 2
        force = self.across * safe_norm(crosswise)[:, None] * crosswise
        force = force + jnp.pi * self.along * safe_norm(lengthwise)[:, None] * lengthwise
        force = width * force
        if self.viscous is not None:
            force = force + self.viscous * velocity
        return -at.generalised(motion.operators.weights[:, None] * stretch * force)
