"""Contact of rods with rigid links of any shape, and of links with fixed obstacles."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.contact.broadphase import near
from sorojax.contact.facet import surface
from sorojax.contact.law import LinePenalty
from sorojax.contact.swept import passes
from sorojax.rod.contact.obstacle import (
    AbstractContact,
    AbstractPairContact,
    Side,
    Touch,
    check_line,
    line,
    reach_of,
    travel,
    twice_turn,
)
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.moving import levers
from sorojax.rod.dynamics.points import safe_norm, spin_cross
from sorojax.rod.model.link import LinkState
from sorojax.sdf.base import AbstractSdf


class LinkPoints(eqx.Module):
    """Points that move with a link, read like the `Points` of a rod.

    Attributes:
        motion: The link.
        position: Where they are [m].
    """

    motion: LinkState
    position: Float[Array, "points dim"]

    @property
    def angular_jacobian(self) -> Float[Array, "points rot dof"]:
        """Angular velocity per rate (planar: about z)."""
        one = self.motion.base.angular_jacobian
        return jnp.broadcast_to(one, (self.position.shape[0], *one.shape))

    @property
    def linear_jacobian(self) -> Float[Array, "points dim dof"]:
        """Velocity per rate."""
        base = self.motion.base
        return base.linear_jacobian[None] + levers(self._arms) @ base.angular_jacobian

    @property
    def velocity(self) -> Float[Array, "points dim"]:
        """[m/s]."""
        moved = self.motion.base.linear_jacobian @ self.motion.v
        return moved[None] + spin_cross(self.spin, self._arms)

    @property
    def spin(self) -> Float[Array, "points rot"]:
        """Angular velocity [rad/s]."""
        one = self.motion.base.angular_jacobian @ self.motion.v
        return jnp.broadcast_to(one, (self.position.shape[0], *one.shape))

    def generalised(
        self,
        force: Float[Array, "points dim"],
        moment: Float[Array, "points rot"] | None = None,
    ) -> Float[Array, " dof"]:
        """Generalised force of forces [N] and moments [N m] on the points."""
        base = self.motion.base
        turn = jnp.einsum("pdr,pd->r", levers(self._arms), force)
        turn = turn if moment is None else turn + jnp.sum(moment, axis=0)
        return turn @ base.angular_jacobian + jnp.sum(force, axis=0) @ base.linear_jacobian

    @property
    def _arms(self) -> Float[Array, "points dim"]:
        return self.position - self.motion.base.position[None]


class LinkContact(AbstractPairContact):
    """Contact of a rod with a rigid link: `PairForce("finger", "box", LinkContact(...))`.

    The stiffness has what friction gains with pressure, and is not symmetric: a grip needs it,
    where pressure and friction hold each other.

    Attributes:
        shape: Of the link, in its frame.
        radius: Radius of the rod [m], or one per point.
        law: Force per length of the rod; a round end counts as one radius of length.
        points: Number of points along the rod. Take about one per half radius.
        caps: Which ends of the rod are half balls: "tip", "both" or "none".
    """

    grips: ClassVar[bool] = True

    shape: AbstractSdf
    radius: Float[Array, "*points"] = eqx.field(converter=real)
    law: LinePenalty
    points: int = eqx.field(static=True, default=32)
    caps: str = eqx.field(static=True, default="tip")

    def __check_init__(self):
        check_line(self, self.radius)

    @property
    def narrowest(self):
        return jnp.min(self.radius)

    def is_near(self, first, second, h):
        _check_kinds(first, second)
        centre, reach = reach_of(first)
        local = (centre - second.base.position) @ second.base.directors
        reach = reach + jnp.max(self.radius) + travel(first, h) + travel(second, h)
        lever = safe_norm(local[None])[0] + reach
        return near(self.shape, local, reach + lever * twice_turn(second, h))

    def touch(self, first: Any, second: Any) -> Touch:
        """The contacts, with the sides (rod, link)."""
        at, weights, radius = line(first, self.radius, self.points, self.caps)
        turn, place = second.base.directors, second.base.position
        gap, slope, normal = surface(self.shape, (at.position - place[None]) @ turn)
        arm = -radius[:, None] * (normal @ turn.T)
        there: Any = LinkPoints(second, at.position + arm)
        sides = Side(at, arm, 1.0), Side(there, jnp.zeros_like(arm), -1.0, 1)
        return Touch(gap - radius, slope @ turn.T, weights, sides)

    def touches(self, first, second):
        return (self.touch(first, second),)

    def passed(self, before, after):
        radius = line(before[0], self.radius, self.points, self.caps)[2]
        ways = [self._inside(*bodies) for bodies in (before, after)]
        return jnp.any(passes(self.shape, *ways, radius))

    def _inside(self, rod: Any, link: Any) -> Float[Array, "points dim"]:
        """Points of the rod in the frame of the link [m]."""
        at, _, _ = line(rod, self.radius, self.points, self.caps)
        return (at.position - link.base.position[None]) @ link.base.directors


class LinkObstacle(AbstractContact):
    """Contact of points of a rigid link with an obstacle that does not move.

    `PartForce("box", LinkObstacle(floor, corners, lengths, law))`.

    Attributes:
        obstacle: Its signed distance, in the world frame.
        points: Of the surface of the link, in its frame [m].
        lengths: What each stands for, of an edge that touches [m].
        law: Force per length.
    """

    obstacle: AbstractSdf
    points: Float[Array, "points dim"] = eqx.field(converter=real)
    lengths: Float[Array, " points"] = eqx.field(converter=real)
    law: LinePenalty

    def __check_init__(self):
        do = "Give a length for each point, e.g. that of the rim over the number of points."
        _check.shape("LinkObstacle", "lengths", self.lengths, self.points.shape[:1], do)
        _check.positive("LinkObstacle", "lengths", self.lengths, "m", do)

    @property
    def narrowest(self):
        return jnp.min(self.lengths)

    def is_near(self, motion, h):
        link: Any = motion
        reach = jnp.max(safe_norm(self.points)) + travel(motion, h)
        return near(self.obstacle, link.base.position, reach)

    def passed(self, before, after):
        return jnp.any(passes(self.obstacle, self._places(*before), self._places(*after)))

    def _places(self, link: Any) -> Float[Array, "points dim"]:
        return link.base.position[None] + self.points @ link.base.directors.T

    def touch(self, motion):
        link: Any = motion
        there = self._places(link)
        gap, normal, _ = surface(self.obstacle, there)
        at: Any = LinkPoints(link, there)
        side = Side(at, jnp.zeros_like(there), 1.0)
        return Touch(gap, normal, self.lengths, (side,))


def _check_kinds(first: Any, second: Any) -> None:
    if not (isinstance(first, RodState) and isinstance(second, LinkState)):
        raise ValueError(
            f"LinkContact: got a {type(first).__name__} and a {type(second).__name__}, need a "
            "rod and then a link. Write PairForce(rod, link, LinkContact(...)); two rods have "
            "RodContact."
        )
