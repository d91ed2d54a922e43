"""Given moments and forces on a rod: at a section, or per length."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.math.quadrature import gauss_legendre
from sorojax.rod.forces import AbstractForce
from sorojax.rod.motion import Motion
from sorojax.rod.points import Points, nodes, points


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


def _check_wrench(where: str, wrench, motion: Motion) -> None:
    size = motion.angular_rate.shape[1] + motion.tangent.shape[1]
    do = "Give the moment, then the force; a planar rod takes (m_z, f_x, f_y)."
    _check.shape(where, "wrench", wrench, (size,), do)
