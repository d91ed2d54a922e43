"""Rotation in space about any axis."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.sdf.bars import check_direction
from sorojax.sdf.base import AbstractSdf, Box, Exactness
from sorojax.sdf.scalar import norm
from sorojax.sdf.transform import AbstractWrapped


class Turned(AbstractWrapped):
    """A solid turned by `angle` [rad] about `axis` through `center` [m]."""

    shape: AbstractSdf
    axis: Float[Array, "3"] = eqx.field(converter=real)
    angle: Float[Array, ""] = eqx.field(converter=real)
    center: Float[Array, "3"] = eqx.field(converter=real)

    def __check_init__(self):
        if self.shape.dim != 3:
            raise ValueError(
                f"turn: the shape is {self.shape.dim}-D, need 3-D. Use `rotate` in the plane."
            )
        _check.shape("turn", "axis", self.axis, (3,), "Give (x, y, z).")
        _check.shape("turn", "center", self.center, (3,), "Give (x, y, z).")
        check_direction("turn", self.axis)

    @property
    def exactness(self) -> Exactness:
        return self.shape.exactness

    def _matrix(self) -> Float[Array, "3 3"]:
        u = self.axis / norm(*(self.axis[i] for i in range(3)))
        c, s = jnp.cos(self.angle), jnp.sin(self.angle)
        zero = jnp.zeros_like(c)
        cross = jnp.stack([zero, -u[2], u[1], u[2], zero, -u[0], -u[1], u[0], zero])
        outer = u[:, None] * u[None, :]
        return c * jnp.eye(3, dtype=c.dtype) + s * cross.reshape(3, 3) + (1 - c) * outer

    def distance(self, *x):
        r = self._matrix()
        d = tuple(c - self.center[i] for i, c in enumerate(x))
        local = (
            self.center[j] + r[0, j] * d[0] + r[1, j] * d[1] + r[2, j] * d[2] for j in range(3)
        )
        return self.shape.distance(*local)

    def level_box(self, level) -> Box:
        r = self._matrix()
        shift = self.center - jnp.sum(r * self.center[None, :], axis=1)
        return turned_box(self.shape.level_box(level), r, shift)


def turned_box(box: Box, matrix: Float[Array, "dim dim"], shift: Array) -> Box:
    """Box around the image of `box` under x -> matrix x + shift; open sides stay open."""
    lower, upper = box

    def side(towards, away):
        # 0 * inf is a NaN: an axis that does not take part adds nothing.
        picked = jnp.where(matrix > 0, towards[None], away[None])
        return jnp.sum(jnp.where(matrix == 0, 0, matrix * picked), axis=1) + shift

    return side(lower, upper), side(upper, lower)


def turn(shape: AbstractSdf, axis: Numbers, angle: Numbers, center=(0.0, 0.0, 0.0)) -> Turned:
    """A solid turned by `angle` [rad] about `axis` through `center` [m]."""
    return Turned(shape, axis, angle, center)
