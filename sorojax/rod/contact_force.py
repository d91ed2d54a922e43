"""Contact of a rod with a fixed obstacle, and what all contacts of rods share."""

import abc
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax import _check
from sorojax._types import real
from sorojax.contact.ball import near
from sorojax.contact.line import LinePenalty
from sorojax.contact.swept import passes
from sorojax.math.door import door
from sorojax.rod.forces import AbstractForce
from sorojax.rod.motion import Motion
from sorojax.rod.points import Points, points
from sorojax.rod.pressing import Side, Touch, energy, press, tangent
from sorojax.rod.travel import travel
from sorojax.sdf.base import AbstractSdf

_REACH = 1.05  # what a section between nodes may stretch beyond the most stretched node


class Linearised(NamedTuple):
    """A force, and about minus its derivatives in coordinates and in rates."""

    force: Float[Array, " dof"]
    stiffness: Float[Array, "dof dof"]
    damping: Float[Array, "dof dof"]


class AbstractContact(AbstractForce):
    """A contact: implicit steppers ask for its stiffness, which comes and goes.

    Implement `is_near`, `touch`, `passed`, `law` and `narrowest`; a contact that is far costs
    one test.
    """

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        law: ClassVar[LinePenalty]

    @property
    @abc.abstractmethod
    def narrowest(self) -> Float[Array, ""]:
        """Least radius of what meets [m]."""

    @abc.abstractmethod
    def is_near(self, motion: Motion, h: Float[Array, ""]) -> Bool[Array, ""]:
        """Whether anything may touch within a step of `h` [s]; `False` is certain."""

    @abc.abstractmethod
    def touch(self, motion: Motion) -> Touch:
        """The contacts and the sides that take their force, all of one motion."""

    @abc.abstractmethod
    def passed(self, before: tuple[Motion], after: tuple[Motion]) -> Bool[Array, ""]:
        """Whether anything went through anything in a step from one motion to another."""

    def stored(self, motion: Motion) -> Float[Array, ""]:
        """Energy [J]."""
        return energy(self.law, self.touch(motion))

    def __call__(self, t, motion):
        def force():
            return sum_sides(press(self.law, self.touch(motion)))

        none = jnp.zeros_like(motion.v)
        return jax.lax.cond(self.is_near(motion, _now(motion)), force, lambda: none)

    def linearised(self, t: Float[Array, ""], motion: Motion) -> Linearised:
        """The force with its stiffness and damping."""
        zero = jnp.zeros_like(motion.v)
        none = jnp.zeros((zero.shape[0],) * 2, zero.dtype)

        def full():
            touch = self.touch(motion)
            count = len(touch.sides)
            stiffness, damping = tangent(self.law, touch)
            damping = none if damping is None else _fold(damping, count)
            force = sum_sides(press(self.law, touch))
            return Linearised(force, _fold(stiffness, count), damping)

        is_near = self.is_near(motion, _now(motion))
        return jax.lax.cond(is_near, full, lambda: Linearised(zero, none, none))


class ObstacleContact(AbstractContact):
    """Contact of a rod with an obstacle that does not move.

    The force follows the slope of the field, so at the concave edge of a union only one of
    its faces pushes: list floor and wall as two contacts.

    Attributes:
        obstacle: Its signed distance, in the world frame.
        radius: Radius of the rod [m], or one per point.
        law: Force per length; a round end counts as one radius of length.
        points: Number of points along the rod. Take about one per half radius.
        caps: Which ends are half balls: "tip", "both" for a free rod, or "none".
    """

    obstacle: AbstractSdf
    radius: Float[Array, "*points"] = eqx.field(converter=real)
    law: LinePenalty
    points: int = eqx.field(static=True, default=32)
    caps: str = eqx.field(static=True, default="tip")

    def __check_init__(self):
        check_line(self, self.radius)

    @property
    def narrowest(self):
        return jnp.min(self.radius)

    def is_near(self, motion, h):
        centre, reach = reach_of(motion)
        reach = reach + jnp.max(self.radius) + travel(motion, h)
        return near(self.obstacle, centre, reach)

    def touch(self, motion):
        at, weights, radius = line(motion, self.radius, self.points, self.caps)
        gap, slope = jax.vmap(jax.value_and_grad(self.obstacle))(at.position)
        size = jnp.sqrt(jnp.sum(slope**2, axis=1, keepdims=True))
        arm = -radius[:, None] * slope / jnp.where(size > 0, size, jnp.ones_like(size))
        return Touch(gap - radius, slope, weights, (Side(at, arm, 1.0),))

    def passed(self, before, after):
        (start, _, radius), (end, _, _) = (
            line(motion, self.radius, self.points, self.caps) for (motion,) in (before, after)
        )
        return jnp.any(passes(self.obstacle, start.position, end.position, radius))


@door
def contact_energy(contact: AbstractContact, motion: Motion) -> Float[Array, ""]:
    """Energy stored in a contact [J]."""
    return contact.stored(motion)


@door
def penetration(contact: AbstractContact, motion: Motion) -> Float[Array, ""]:
    """Largest overlap of the surfaces [m]; zero without contact."""
    gap = contact.touch(motion).gap
    return jnp.maximum(-jnp.min(gap), jnp.zeros((), gap.dtype))


def check_line(contact, radius: Array) -> None:
    """Refuse a radius or a number of points that makes no sense."""
    where = type(contact).__name__
    _check.positive(where, "radius", radius, "m", "Give the radius of the rod.")
    if contact.points < 2:
        raise ValueError(
            f"{where}: got points={contact.points}, need 2 or more along the rod. One per "
            "half radius resolves a contact patch."
        )
    if contact.caps not in ("tip", "both", "none"):
        raise ValueError(f'{where}: got caps="{contact.caps}", need "tip", "both" or "none".')
    if radius.ndim > 0:
        count = len(stations(contact.points, contact.caps))
        do = f"Give one number, or one for each of {contact.points} points and the round ends."
        _check.shape(where, "radius", radius, (count,), do)


def line(
    motion: Motion, radius: Array, count: int, caps: str
) -> tuple[Points, Float[Array, " points"], Float[Array, " points"]]:
    """Midpoints of `count` parts, then the round ends; their lengths and radii.

    Midpoints, not Gauss points: a load that is compact inside the rod is then integrated
    with an error that falls faster than any power of the spacing.
    """
    s = stations(count, caps)
    radius = jnp.broadcast_to(radius, s.shape).astype(motion.q.dtype)
    weights = motion.rod.length * jnp.full(count, 1 / count, motion.q.dtype)
    return points(motion, s), jnp.concatenate([weights, radius[count:]]), radius


def stations(count: int, caps: str) -> np.ndarray:
    """Places in [0, 1] of the points of a line, its round ends last."""
    ends = {"tip": [1.0], "both": [1.0, 0.0], "none": []}[caps]
    return np.concatenate([(np.arange(count) + 0.5) / count, ends])


def reach_of(motion: Motion) -> tuple[Float[Array, " dim"], Float[Array, ""]]:
    """Centre and radius [m] of a ball that holds the centre line.

    About the middle of the arc length: no other point needs to be known.
    """
    half = motion.rod.length / 2
    rod = motion.rod
    stretches = any(not name.startswith("kappa") for name in rod.basis.active)
    if stretches or rod.rest_strain is not None:
        square = jnp.max(jnp.sum(motion.tangent**2, axis=1))
        half = half * _REACH * jnp.sqrt(square)
    return points(motion, np.array([0.5])).position[0], half


def sum_sides(forces: tuple[Array, ...]) -> Float[Array, " dof"]:
    total = forces[0]
    for force in forces[1:]:
        total = total + force
    return total


def _now(motion: Motion) -> Float[Array, ""]:
    return jnp.zeros((), motion.q.dtype)


def _fold(matrix: Array, count: int) -> Float[Array, "dof dof"]:
    """Sum over the sides of a matrix in the columns of one side after the other."""
    if count == 1:
        return matrix
    dof = matrix.shape[0] // count
    return jnp.sum(matrix.reshape(count, dof, count, dof), axis=(0, 2))
