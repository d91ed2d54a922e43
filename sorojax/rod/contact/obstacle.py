"""Contact of a rod with a fixed obstacle, how far bodies move in a step, and what all
contacts of rods share.
"""

import abc
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax import _check
from sorojax._types import real
from sorojax.contact.broadphase import near
from sorojax.contact.facet import surface
from sorojax.contact.law import LinePenalty
from sorojax.contact.swept import passes
from sorojax.math.compiled import jit_public
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.points import Points, moment_of, points, safe_norm, spin_cross
from sorojax.rod.forces.forces import AbstractForce
from sorojax.rod.forces.loads import AbstractPairForce
from sorojax.rod.model.link import LinkState
from sorojax.sdf.base import AbstractSdf

_SURGE = 100.0  # acceleration that a broad phase allows for within a step [m/s^2]

#: Length of a step [s]; 0.0, a Python number, asks for the moment alone and costs nothing.
StepSize = Float[Array, ""] | float


def is_now(h: StepSize) -> bool:
    """Whether no step is asked about, but the moment alone."""
    return isinstance(h, float) and h == 0.0


def travel(moment: RodState | LinkState, h: StepSize) -> Float[Array, ""] | float:
    """How far [m] any section, or the frame of a link, may move within a step of `h` [s]."""
    return twice_way(moment, h) + _SURGE * h**2


def twice_way(moment: RodState | LinkState, h: StepSize) -> Float[Array, ""] | float:
    """Twice what the fastest section, or the frame of a link, moves in `h` [s] as it moves
    now [m]."""
    if is_now(h):
        return 0.0
    if isinstance(moment, LinkState):
        velocity = (moment.base.linear_jacobian @ moment.v)[None]
    else:
        velocity = moment.linear_jacobian.reshape(-1, moment.v.shape[0]) @ moment.v
        velocity = velocity.reshape(moment.tangent.shape)
    return 2 * h * jnp.sqrt(jnp.max(jnp.sum(velocity**2, axis=1)))


def twice_turn(moment: RodState | LinkState, h: StepSize) -> Float[Array, ""] | float:
    """Twice what the section that spins fastest turns in `h` [s] as it moves now [rad]."""
    if is_now(h):
        return 0.0
    spin = moment.angular_jacobian.reshape(-1, moment.v.shape[0]) @ moment.v
    spin = spin.reshape(moment.angular_jacobian.shape[:2])
    return 2 * h * jnp.sqrt(jnp.max(jnp.sum(spin**2, axis=1)))


# Forces between surfaces that touch, on the points of the bodies that carry them


class Side(NamedTuple):
    """One of the two bodies at a set of contacts.

    Attributes:
        points: Centres of the sections that touch.
        arm: From the centres to the points of contact [m].
        sign: 1 for the body that the normal points into, -1 for the other.
        body: Its number among the bodies that the contact is asked about.
    """

    points: Points
    arm: Float[Array, "points dim"]
    sign: float
    body: int = 0


class Touch(NamedTuple):
    """Contacts between two bodies, or one body and a fixed obstacle.

    Attributes:
        gap: Distance of the surfaces [m], negative where they overlap.
        normal: Slope of the gap in the centres of the first body.
        weights: Length that each contact stands for [m].
        sides: The bodies that move.
    """

    gap: Float[Array, " points"]
    normal: Float[Array, "points dim"]
    weights: Float[Array, " points"]
    sides: tuple[Side, ...]


def energy(law: LinePenalty, touch: Touch) -> Float[Array, ""]:
    """Energy stored in the contacts [J]."""
    return touch.weights @ law.energy(touch.gap)


def press(law: LinePenalty, touch: Touch) -> list[Float[Array, " dof"]]:
    """Generalised force on each body."""
    pressure = law.pressure(touch.gap)
    velocity = None
    if law.friction is not None or law.damping is not None:
        velocity = _velocity(law, touch)
        pressure = pressure * law.approach(jnp.sum(touch.normal * velocity, axis=1))
    load = (touch.weights * pressure)[:, None] * touch.normal
    if law.friction is None or velocity is None:
        return _by_body(touch, lambda side: side.points.generalised(side.sign * load))
    sliding, size = _sliding(touch, velocity)
    load = load - (touch.weights * law.drag(pressure * size, sliding))[:, None] * sliding

    def force(side: Side):
        moment = side.sign * moment_of(side.arm, load)
        return side.points.generalised(side.sign * load, moment)

    return _by_body(touch, force)


def tangent(
    law: LinePenalty, touch: Touch
) -> tuple[Float[Array, "dof dof"], Float[Array, "dof dof"] | None]:
    """Stiffness and damping of the contacts, for implicit steppers.

    Both are symmetric and positive, over the columns of the bodies one after the other:
    the turn of the normal and the change of friction with pressure are left out.
    """
    normal_rows = _normal_rows(touch)
    weights = touch.weights
    stiffness, force = law.slope(touch.gap), law.pressure(touch.gap)
    viscous = None
    if law.friction is not None or law.damping is not None:
        velocity = _velocity(law, touch)
        approach = law.approach(jnp.sum(touch.normal * velocity, axis=1))
        stiffness = stiffness * approach
        if law.damping is not None:
            closing = jnp.where(approach > 0, law.damping * force, jnp.zeros_like(force))
            viscous = _square(normal_rows, weights * closing)
        if law.friction is not None:
            sliding, size = _sliding(touch, velocity)
            drag = weights * law.drag(force * approach * size, sliding)
            term = _friction_square(touch, normal_rows, size, drag)
            viscous = term if viscous is None else viscous + term
    return _square(normal_rows, weights * stiffness), viscous


def coupling(law: LinePenalty, touch: Touch) -> Float[Array, "dof dof"]:
    """Stiffness from friction that grows with pressure; not symmetric."""
    if law.friction is None:
        return jnp.zeros((), touch.gap.dtype)
    velocity = _velocity(law, touch)
    sliding, size = _sliding(touch, velocity)
    approach = law.approach(jnp.sum(touch.normal * velocity, axis=1))
    pressure, growth = law.pressure(touch.gap), law.slope(touch.gap)
    at, along = pressure * approach * size, growth * approach * size
    drag = jax.jvp(lambda pressure: law.drag(pressure, sliding), (at,), (along,))[1]
    load = (touch.weights * drag)[:, None] * sliding
    across = jnp.sum(_surface_rows(touch) * load[:, :, None], axis=1)
    return -(across.T @ _normal_rows(touch))


def _friction_square(touch: Touch, normal_rows, size, drag) -> Array:
    """Square of the sliding velocity per rate: of the whole, less that of its normal part."""
    rows = _surface_rows(touch)
    total = _square(rows, jnp.broadcast_to(drag[:, None], rows.shape[:2]))
    scale = jnp.where(size > 0, size, jnp.ones_like(size))
    return total - _square(normal_rows / scale[:, None], drag)


def _velocity(law: LinePenalty, touch: Touch) -> Float[Array, "points dim"]:
    """Velocity of the first surface against the second [m/s]."""
    total = jnp.zeros_like(touch.normal)
    for side in touch.sides:
        velocity = side.points.velocity
        if law.friction is not None:
            velocity = velocity + spin_cross(side.points.spin, side.arm)
        total = total + side.sign * velocity
    return total


def _sliding(touch: Touch, velocity: Array) -> tuple[Array, Array]:
    """Velocity along the surface, and the size of the normal."""
    size = safe_norm(touch.normal)
    unit = touch.normal / jnp.where(size > 0, size, jnp.ones_like(size))[:, None]
    return velocity - jnp.sum(unit * velocity, axis=1, keepdims=True) * unit, size


def _by_body(touch: Touch, term: Callable[[Side], Array]) -> list[Array]:
    """Sum of the terms of the sides of each body."""
    bodies = range(1 + max(side.body for side in touch.sides))
    return [total([term(side) for side in touch.sides if side.body == k]) for k in bodies]


def total(terms: Sequence[Array]) -> Array:
    return sum(terms[1:], start=terms[0])


def _normal_rows(touch: Touch) -> Float[Array, "points dof"]:
    """Slope of the gap per rate."""

    def along(side: Side):
        jacobian = side.points.linear_jacobian
        return side.sign * jnp.sum(touch.normal[:, :, None] * jacobian, axis=1)

    return jnp.concatenate(_by_body(touch, along), axis=1)


def _surface_rows(touch: Touch) -> Float[Array, "points dim dof"]:
    """Velocity of the first surface against the second, per rate."""

    def rows(side: Side):
        angular, arm = side.points.angular_jacobian, side.arm[:, :, None]
        if arm.shape[1] == 2:
            turn = jnp.concatenate([-arm[:, 1:], arm[:, :1]], axis=1) * angular
        else:
            turn = jnp.cross(angular, jnp.broadcast_to(arm, angular.shape), axis=1)
        return side.sign * (side.points.linear_jacobian + turn)

    return jnp.concatenate(_by_body(touch, rows), axis=2)


def _square(rows: Float[Array, "*rows dof"], weights: Float[Array, "*rows"]) -> Array:
    """rows' diag(weights) rows, over all axes but the last."""
    flat = rows.reshape(-1, rows.shape[-1])
    return flat.T @ (weights.reshape(-1)[:, None] * flat)


# Contact of a rod with a fixed obstacle, and what all contacts of rods share


_REACH = 1.05  # what a section between nodes may stretch beyond the most stretched node


class Linearised(NamedTuple):
    """A force, and about minus its derivatives in coordinates and in rates."""

    force: Float[Array, " dof"]
    stiffness: Float[Array, "dof dof"]
    damping: Float[Array, "dof dof"]


class AbstractTouching(eqx.Module):
    """What contacts of one body and of two share: forces, energy, and a stiffness that comes
    and goes, for implicit steppers. A contact that is far costs one test."""

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        law: ClassVar[LinePenalty]
    grips: ClassVar[bool] = False  # whether the stiffness has what friction gains by pressure

    @property
    @abc.abstractmethod
    def narrowest(self) -> Float[Array, ""]:
        """Least radius of what meets [m]."""

    @abc.abstractmethod
    def is_near(self, *bodies_and_step: Any) -> Bool[Array, ""]:
        """Whether anything may touch within a step of `h` [s], the last argument; `False` is
        certain."""

    @abc.abstractmethod
    def touches(self, *bodies: Any) -> tuple[Touch, ...]:
        """The contacts and the sides that take their force."""

    @abc.abstractmethod
    def passed(self, before: tuple, after: tuple) -> Bool[Array, ""]:
        """Whether anything went through anything in a step from some motions to others."""

    def stored(self, *bodies: Any) -> Float[Array, ""]:
        """Energy [J]."""
        return total([energy(self.law, touch) for touch in self.touches(*bodies)])

    def forces(self, *bodies: Any) -> list[Float[Array, " dof"]]:
        """Generalised force on each body."""

        def acting():
            return _on_bodies(self.law, self.touches(*bodies))

        none = [jnp.zeros_like(body.v) for body in bodies]
        return jax.lax.cond(self.is_near(*bodies, 0.0), acting, lambda: none)

    def linearised(self, t: Float[Array, ""], *bodies: Any) -> Linearised:
        """Force, stiffness and damping over the columns of the bodies, one after the other."""
        zero = jnp.concatenate([jnp.zeros_like(body.v) for body in bodies])
        none = jnp.zeros((*zero.shape, *zero.shape), zero.dtype)

        def full():
            touches = self.touches(*bodies)
            found = [tangent(self.law, touch) for touch in touches]
            stiffness = total([term for term, _ in found])
            if self.grips:
                stiffness += total([coupling(self.law, touch) for touch in touches])
            viscous = [term for _, term in found if term is not None]
            damping = total(viscous) if viscous else none
            force = jnp.concatenate(_on_bodies(self.law, touches))
            return Linearised(force, stiffness, damping)

        near = self.is_near(*bodies, 0.0)
        return jax.lax.cond(near, full, lambda: Linearised(zero, none, none))


def _on_bodies(law: LinePenalty, touches: tuple[Touch, ...]) -> list[Float[Array, " dof"]]:
    return [total(terms) for terms in zip(*(press(law, t) for t in touches), strict=True)]


class AbstractContact(AbstractTouching, AbstractForce):
    """A contact of one body: implement `is_near`, `touch`, `passed`, `law` and `narrowest`."""

    @abc.abstractmethod
    def touch(self, motion: RodState) -> Touch:
        """The contacts and the sides that take their force, all of one motion."""

    def touches(self, *bodies):
        return (self.touch(*bodies),)

    def __call__(self, t, motion):
        return self.forces(motion)[0]


class AbstractPairContact(AbstractTouching, AbstractPairForce):
    """A contact of two bodies: implement `is_near`, `touches`, `passed`, `law` and
    `narrowest`."""

    def __call__(self, t, first, second):
        return tuple(self.forces(first, second))


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
        gap, slope, normal = surface(self.obstacle, at.position)
        return Touch(gap - radius, slope, weights, (Side(at, -radius[:, None] * normal, 1.0),))

    def passed(self, before, after):
        (start, _, radius), (end, _, _) = (
            line(motion, self.radius, self.points, self.caps) for (motion,) in (before, after)
        )
        return jnp.any(passes(self.obstacle, start.position, end.position, radius))


@jit_public
def contact_energy(contact: AbstractContact, motion: RodState) -> Float[Array, ""]:
    """Energy stored in a contact [J].

    Args:
        contact: The contact.
        motion: State of the rod, from `motion`.

    Returns:
        Energy [J].
    """
    return contact.stored(motion)


@jit_public
def penetration(contact: AbstractContact, motion: RodState) -> Float[Array, ""]:
    """Largest overlap of the surfaces [m]; zero without contact.

    Args:
        contact: The contact.
        motion: State of the rod, from `motion`.

    Returns:
        The depth [m].
    """
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
    motion: RodState, radius: Array, count: int, caps: str
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


def reach_of(motion: RodState) -> tuple[Float[Array, " dim"], Float[Array, ""]]:
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
