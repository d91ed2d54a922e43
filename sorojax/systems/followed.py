"""What a law at the tip of a rod asked for along a motion, and what it got."""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from sorojax.math.door import door
from sorojax.rod import Rollout, tip_pose
from sorojax.systems.model_control import CartesianImpedance


class Followed(NamedTuple):
    """A law and its rod at the moments of a motion.

    Attributes:
        goal: Where the tip should have been [m].
        tip: Where it was [m].
        effort: Generalised force that the law gave, over the rates of the rod.
    """

    goal: Float[Array, "moments dim"]
    tip: Float[Array, "moments dim"]
    effort: Float[Array, "moments dof"]


@door
def followed(law: CartesianImpedance, path: Rollout) -> Followed:
    """Set-points, tips and efforts of `law` along the motion `path` of its rod."""

    def at(t, q, v):
        return Followed(law.reference(t), tip_pose(law.rod, q)[:-1, -1], law.effort(t, q, v))

    return jax.vmap(at)(path.time, path.q, path.v)
