"""Friction: how much traction a pressure can hold, and true stick up to that limit.

A new law is a class with `limit`, exported by `sorojax.contact`.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real


class AbstractFriction(eqx.Module):
    """A friction law: the traction up to which a point holds, and at which it slides."""

    @abc.abstractmethod
    def limit(self, pressure: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Greatest tangential traction under a normal pressure, which is never negative: both
        per area [Pa], or per length of a rod [N/m]. It is zero without pressure."""

    def middle(
        self, pressure: Float[Array, "*points"], normal: Float[Array, "*points dim"]
    ) -> Float[Array, "*points dim"] | None:
        """Middle of the ball of tractions, of radius `limit`, that points can put on their
        obstacle without sliding: tangential, and not outside the ball. None for zero."""
        return None


class Coulomb(AbstractFriction):
    """The traction is at most `coefficient` [-] times the pressure."""

    coefficient: Float[Array, ""] = eqx.field(converter=real)

    def __check_init__(self):
        do = "Leave friction out for none."
        _check.positive("contact.Coulomb", "coefficient", self.coefficient, "-", do)

    def limit(self, pressure):
        return self.coefficient * pressure


class DirectionalCoulomb(AbstractFriction):
    """Another coefficient [-] one way than back, as of bristles, scales or hooks.

    The tractions that hold fill a ball in place of one round zero: `forward` times the pressure
    against sliding along `direction`, `backward` times the pressure against sliding back, and
    the root of their product sideways.

    Attributes:
        forward, backward: Coefficients of sliding along the direction and back [-].
        direction: Of easy or hard sliding, in the frame of the obstacle; of any length. Its
            part along the normal does not count.

    References:
        Goyal, Ruina, Papadopoulos, Planar sliding with dry friction, part 1, Wear 143, 1991:
        limit surfaces of friction that are convex and hold zero.
    """

    forward: Float[Array, ""] = eqx.field(converter=real)
    backward: Float[Array, ""] = eqx.field(converter=real)
    direction: Float[Array, " dim"] = eqx.field(converter=real)

    def __check_init__(self):
        name = "contact.DirectionalCoulomb"
        for side in ("forward", "backward"):
            _check.positive(name, side, getattr(self, side), "-", "Use 1e-3 for almost none.")
        length = jnp.linalg.norm(self.direction)
        _check.positive(name, "length of `direction`", length, "-", "Give where it points.")

    def limit(self, pressure):
        return (self.forward + self.backward) / 2 * pressure

    def middle(self, pressure, normal):
        along = self.direction / jnp.linalg.norm(self.direction)
        along = _across(jnp.broadcast_to(along, normal.shape), normal)
        return ((self.forward - self.backward) / 2 * pressure)[..., None] * along


def friction_law(given: AbstractFriction | Numbers | None) -> AbstractFriction | None:
    """The law that a user means: a number is the coefficient of Coulomb's."""
    if given is None or isinstance(given, AbstractFriction):
        return given
    return Coulomb(given)


# True stick: a slider in a row with a spring and a dashpot


class Grip(NamedTuple):
    """State of friction at each point, in the frame of the obstacle.

    Attributes:
        anchor: Where the spring has no force [m].
        pressure, normal: Those that friction is taken at, the first in Pa.
        drag: Stiffness of the dashpot over a step [Pa/m].
        back: Where the point was when the step began, and the dashpot has no force [m].
    """

    anchor: Float[Array, "*points dim"]
    pressure: Float[Array, "*points"]
    normal: Float[Array, "*points dim"]
    drag: Float[Array, "*points"]
    back: Float[Array, "*points dim"]


class SpringSlider(eqx.Module):
    """Friction per reference area, of at most what the `law` allows.

    A point hangs on a spring of `stiffness` [Pa/m] that slides when the limit is reached:
    held points come to rest, they do not creep. A dashpot beside the spring, which alone
    reaches the limit at `velocity` [m/s], stops them from ringing.

    Given the pressure the increment of a step has a potential, so tangents are symmetric. Its
    work on the way of a step is at most what the springs lose, whatever the step, where
    forces act in its second half.

    References:
        Wriggers, Computational Contact Mechanics, 2006, section 6.2, for the return of the
        spring to the limit.
        Simo, Hughes, Computational Inelasticity, 1998, section 1.7, for the return in the
        middle of a step.
    """

    law: AbstractFriction
    stiffness: Float[Array, ""] = eqx.field(converter=real)
    velocity: Float[Array, ""] = eqx.field(converter=real, default=1e-3)

    def __check_init__(self):
        for name, unit in (("stiffness", "Pa/m"), ("velocity", "m/s")):
            do = "The stiffness of the penalty suits the stiffness, 1e-3 m/s the velocity."
            _check.positive("contact.SpringSlider", name, getattr(self, name), unit, do)

    def energy(self, grip: Grip, position: Float[Array, "*points dim"]) -> Float[Array, "..."]:
        """Potential of a step per area [J/m^2]; friction is minus its slope."""
        whole, away = self._trial(grip, position)
        limit, middle, beyond = self._ball(grip.pressure, grip.normal, whole, away)
        held, length = _within(beyond, limit / whole)
        spring = jnp.where(limit > 0, whole, jnp.zeros_like(whole))  # none without pressure
        square = jnp.sum(away**2, axis=-1)
        slid = limit * (length - limit / (2 * whole))
        if middle is not None:
            slid = slid + jnp.sum(middle * (away - middle / (2 * whole[..., None])), axis=-1)
        return jnp.where(held, spring * square / 2, slid)

    def traction(
        self, grip: Grip, position: Float[Array, "*points dim"]
    ) -> Float[Array, "*points dim"]:
        """Force of the obstacle on the points per area [Pa]."""
        whole, away = self._trial(grip, position)
        limit, middle, beyond = self._ball(grip.pressure, grip.normal, whole, away)
        held, length = _within(beyond, limit / whole)
        spring = jnp.where(limit > 0, whole, jnp.zeros_like(whole))
        if middle is None:
            return -jnp.where(held, spring, limit / length)[..., None] * away
        slid = middle + (limit / length)[..., None] * beyond
        return -jnp.where(held[..., None], spring[..., None] * away, slid)

    def loading(
        self, grip: Grip, position: Float[Array, "*points dim"]
    ) -> Float[Array, "*points"]:
        """Pull of spring and dashpot over the limit: points hold below 1 and slide above;
        infinite without pressure."""
        whole, away = self._trial(grip, position)
        limit, middle, _ = self._ball(grip.pressure, grip.normal, whole, away)
        touches = limit > 0
        square, radius = whole**2 * jnp.sum(away**2, axis=-1), jnp.where(touches, limit, 1.0)
        if middle is None:
            return jnp.where(touches, jnp.sqrt(square) / radius, jnp.inf)
        # the pull is on the ball of `loading` times the middle and the radius
        along = whole * jnp.sum(away * middle, axis=-1)
        room = jnp.where(touches, limit**2 - jnp.sum(middle**2, axis=-1), 1.0)
        return jnp.where(touches, (jnp.sqrt(along**2 + room * square) - along) / room, jnp.inf)

    def stretch(
        self,
        grip: Grip,
        position: Float[Array, "*points dim"],
        share: Float[Array, ""] | float = 1.0,
    ) -> Float[Array, "*points dim"]:
        """Length of the spring [m] after a step in which points were at `position` after a
        `share` of it, when forces acted."""
        before = _across(grip.back - grip.anchor, grip.normal)
        pull = grip.drag[..., None] * before - self.traction(grip, position)
        return before + (pull / (self.stiffness + grip.drag)[..., None] - before) / share

    def bounded(
        self,
        stretch: Float[Array, "*points dim"],
        pressure: Float[Array, "*points"],
        normal: Float[Array, "*points dim"],
    ) -> Float[Array, "*points dim"]:
        """A `stretch` [m] that a `pressure` [Pa] can hold: a spring beyond slides back."""
        limit, middle, beyond = self._ball(pressure, normal, self.stiffness, stretch)
        longest = limit / self.stiffness
        held, length = _within(beyond, longest)
        share = jnp.where(held, jnp.ones_like(length), longest / length)[..., None]
        return stretch - beyond + share * beyond if middle is not None else share * stretch

    def stored(self, stretch: Float[Array, "*points dim"]) -> Float[Array, "..."]:
        """Energy in a spring of length `stretch` [m] per area [J/m^2]."""
        return self.stiffness / 2 * jnp.sum(stretch**2, axis=-1)

    def _ball(self, pressure, normal, stiffness, away):
        """Radius and middle of the ball of tractions that hold, and `away` from its middle."""
        middle = self.law.middle(pressure, normal)
        beyond = away
        if middle is not None:
            beyond = away - middle / jnp.broadcast_to(stiffness, pressure.shape)[..., None]
        return self.law.limit(pressure), middle, beyond

    def _trial(self, grip: Grip, position):
        """Stiffness of spring and dashpot together, and how far the point is from where
        they have no force."""
        whole = self.stiffness + grip.drag
        centre = (self.stiffness * grip.anchor + grip.drag[..., None] * grip.back) / whole[
            ..., None
        ]
        return whole, _across(position - centre, grip.normal)


def _within(stretch, longest) -> tuple[Array, Array]:
    """Whether springs are no longer than `longest`, and the length [m] of longer ones, one for
    all others, whose root may have no derivative."""
    square = jnp.sum(stretch**2, axis=-1)
    held = square <= longest**2
    return held, jnp.sqrt(jnp.where(held, jnp.ones_like(square), square))


def no_grip(position: Float[Array, "*points dim"]) -> Grip:
    """The grip of points that do not touch."""
    zero = jnp.zeros_like(position)
    return Grip(position, zero[..., 0], zero, zero[..., 0], position)


def _across(vector, normal):
    return vector - jnp.sum(vector * normal, axis=-1, keepdims=True) * normal
