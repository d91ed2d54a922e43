"""Given moments and forces on a rod: at a section, or per length."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.math.quadrature import gauss_legendre
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.points import Points, nodes, points, safe_norm
from sorojax.rod.forces.forces import AbstractForce, gravity_or_earth


class PointWrench(AbstractForce):
    """A wrench on the section at `s`.

    Attributes:
        wrench: Moment [N m], then force [N]: (m_z, f_x, f_y) for a planar rod.
        s: Where, in [0, 1].
        follower: Whether the components turn with the section; otherwise it is dead.
    """

    wrench: Float[Array, " twist"] = eqx.field(converter=real)
    s: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    follower: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        _check.between("PointWrench", "s", self.s, -1e-12, 1 + 1e-12, "-", "0 is the base.")

    def __call__(self, t, motion):
        _check_wrench("PointWrench", self.wrench, motion)
        at = points(motion, self.s[None])
        return _apply(at, self.wrench[None], self.follower)


def _density(value: Any) -> Any:
    return value if callable(value) else real(value)


class LineWrench(AbstractForce):
    """A wrench per length of the unstrained rod.

    Attributes:
        wrench: Moment [N], then force [N/m], constant or a function of s in [0, 1].
        follower: Whether the components turn with the sections; otherwise it is dead.
    """

    wrench: Float[Array, " twist"] | Callable[[Array], Array] = eqx.field(converter=_density)
    follower: bool = eqx.field(static=True, default=False)

    def __call__(self, t, motion):
        s = jnp.asarray(gauss_legendre(motion.rod.quadrature)[0], motion.q.dtype)
        if callable(self.wrench):
            loads = jax.vmap(self.wrench)(s)
        else:
            loads = jnp.broadcast_to(self.wrench, (s.shape[0], *self.wrench.shape))
        _check_wrench("LineWrench", loads[0], motion)
        return _apply(nodes(motion), motion.operators.weights[:, None] * loads, self.follower)


def _apply(at: Points, loads: Float[Array, "points twist"], follower: bool) -> Array:
    rot = at.motion.angular_rate.shape[1]
    moment, force = loads[:, :rot], loads[:, rot:]
    if follower:
        axes = at.directors
        force = jnp.sum(axes * force[:, None, :], axis=2)
        if rot == 3:
            moment = jnp.sum(axes * moment[:, None, :], axis=2)
    return at.generalised(force, moment)


def _check_wrench(where: str, wrench, motion: RodState) -> None:
    size = motion.angular_rate.shape[1] + motion.tangent.shape[1]
    do = "Give the moment, then the force; a planar rod takes (m_z, f_x, f_y)."
    _check.shape(where, "wrench", wrench, (size,), do)


# A fluid around a rod: buoyancy and drag


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
