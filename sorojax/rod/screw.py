"""The screw: one coordinate turns and advances."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.rod.joint import AbstractJoint


class Screw(AbstractJoint):
    """About z of the joint frame by `turn` and along it by `advance`, per coordinate; in space.

    A bolt has `turn=1` and as `advance` its pitch over 2 pi. Slide (`turn=0`) and hinge
    (`advance=0`) are screws too, so that one compiled program moves all three.

    Attributes:
        turn: [rad].
        advance: [m].
        damping: Effort per rate of the coordinate, for `turn=1` [N m s/rad].
    """

    turn: Float[Array, ""] = eqx.field(converter=real)
    advance: Float[Array, ""] = eqx.field(converter=real)
    damping: Float[Array, ""] = eqx.field(converter=real, default=0.0)

    def __check_init__(self):
        known = _check.is_concrete(self.turn) and _check.is_concrete(self.advance)
        if known and float(self.turn) == 0 and float(self.advance) == 0:
            raise ValueError(
                "Screw: `turn` and `advance` are 0, need one that moves. A part that does not "
                "move has the joint Fixed()."
            )

    def num_dof(self, group):
        return 1

    def axes(self, group, dtype):
        return jnp.zeros((6, 1), dtype).at[2].set(self.turn).at[5].set(self.advance)

    def pose(self, group, q):
        c, s = jnp.cos(self.turn * q[0]), jnp.sin(self.turn * q[0])
        rows = jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
        turned = jnp.eye(3, dtype=q.dtype).at[:2, :2].set(rows)
        return turned, jnp.zeros(3, q.dtype).at[2].set(self.advance * q[0])

    def matrices(self, group, dtype):
        return jnp.zeros((1, 1), dtype), self.damping.astype(dtype)[None, None]

    def effort(self, q, v):
        return -self.damping * v
