"""Contact between two rods of an assembly, or of a rod with one that is held."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax import _check
from sorojax._types import real
from sorojax.contact.line import LinePenalty
from sorojax.contact.swept import crosses
from sorojax.rod.closest import closest, curve, ends
from sorojax.rod.contact_force import AbstractContact, Linearised, line, reach_of
from sorojax.rod.link import LinkMotion
from sorojax.rod.loads import AbstractPairForce
from sorojax.rod.motion import Motion
from sorojax.rod.points import Points
from sorojax.rod.pressing import Side, Touch, energy, press, tangent
from sorojax.rod.self_contact import meeting
from sorojax.rod.travel import travel


class RodContact(AbstractPairForce):
    """Contact between two rods: `Between("left", "right", RodContact(...))`.

    Points of each meet the closest point of the other, with half of the force each, so
    neither is the master.

    Attributes:
        radii: Of the first and of the second rod [m].
        law: Force per length.
        points: Number of points along each rod. Take two or more per radius where rods
            cross.
        caps: Which ends are half balls: "tip", "both" for free rods, or "none".
    """

    radii: Float[Array, "2"] = eqx.field(converter=real)
    law: LinePenalty
    points: int = eqx.field(static=True, default=64)
    caps: str = eqx.field(static=True, default="tip")

    def __check_init__(self):
        do = "Give the radius of each rod, (first, second)."
        _check.shape("RodContact", "radii", self.radii, (2,), do)
        _check.positive("RodContact", "radii", self.radii, "m", do)

    def __call__(self, t, first, second):
        first, second = rod_of(first), rod_of(second)

        def forces():
            return _forces(self.law, *touches(self, first, second))

        none = jnp.zeros_like(first.v), jnp.zeros_like(second.v)
        far = jnp.zeros((), first.q.dtype)
        return jax.lax.cond(self.is_near(first, second, far), forces, lambda: none)

    @property
    def narrowest(self) -> Float[Array, ""]:
        return jnp.min(self.radii)

    def is_near(
        self, first: Motion | LinkMotion, second: Motion | LinkMotion, h: Array
    ) -> Bool[Array, ""]:
        """Whether the rods may touch within a step of `h` [s]; `False` is certain."""
        first, second = rod_of(first), rod_of(second)
        (a, reach_a), (b, reach_b) = reach_of(first), reach_of(second)
        reach = reach_a + reach_b + jnp.sum(self.radii)
        reach = reach + travel(first, h) + travel(second, h)
        return jnp.sum((a - b) ** 2) <= reach**2

    def linearised(
        self, t: Float[Array, ""], first: Motion | LinkMotion, second: Motion | LinkMotion
    ) -> Linearised:
        """Force, stiffness and damping over the columns of both, one after the other."""
        first, second = rod_of(first), rod_of(second)
        split, total = first.v.shape[0], first.v.shape[0] + second.v.shape[0]
        none = jnp.zeros((total, total), first.v.dtype)

        def full():
            stiffness = damping = none
            one, two = touches(self, first, second)
            for touch, shift in ((one, 0), (two, split)):
                term, viscous = tangent(self.law, touch)
                stiffness = stiffness + _swap(term, shift)
                damping = damping if viscous is None else damping + _swap(viscous, shift)
            forces = jnp.concatenate(_forces(self.law, one, two))
            return Linearised(forces, stiffness, damping)

        is_near = self.is_near(first, second, jnp.zeros((), first.q.dtype))
        return jax.lax.cond(is_near, full, lambda: Linearised(none[0], none, none))

    def stored(self, first: Motion | LinkMotion, second: Motion | LinkMotion) -> Array:
        """Energy [J]."""
        one, two = touches(self, rod_of(first), rod_of(second))
        return energy(self.law, one) + energy(self.law, two)

    def passed(self, before: tuple, after: tuple) -> Bool[Array, ""]:
        """Whether the rods went through each other from one pair of motions to another."""
        lines = (ends(motion, self.points) for motion in (*before, *after))
        first, second, first_after, second_after = lines
        return crosses(first, first_after, second, second_after, jnp.sum(self.radii))


class HeldRod(AbstractContact):
    """Contact of a rod with another rod that does not move.

    Attributes:
        pair: Radii of the moving and of the held rod, law and points.
        held: Where the held rod is.
    """

    pair: RodContact
    held: Motion

    @property
    def law(self) -> LinePenalty:  # type: ignore[override]
        return self.pair.law

    @property
    def narrowest(self):
        return self.pair.narrowest

    def is_near(self, motion, h):
        return self.pair.is_near(motion, self.held, h)

    def passed(self, before, after):
        return self.pair.passed((*before, self.held), (*after, self.held))

    def touch(self, motion):
        one, two = touches(self.pair, motion, self.held)
        mine, its = one.sides[0], two.sides[1]
        at = Points(motion, jnp.concatenate([mine.points.rows, its.points.rows]))
        side = Side(at, jnp.concatenate([mine.arm, its.arm]), 1.0)
        normal = jnp.concatenate([one.normal, -two.normal])
        gap, weights = (jnp.concatenate([getattr(x, k) for x in (one, two)]) for k in _FIELDS)
        return Touch(gap, normal, weights, (side,))


_FIELDS = ("gap", "weights")


def touches(pair: RodContact, first: Motion, second: Motion) -> tuple[Touch, Touch]:
    """Contacts of the points of the first rod, then of the second; each has the sides
    (searching rod, searched rod)."""
    return _search(pair, 0, first, second), _search(pair, 1, second, first)


def _search(pair: RodContact, index: int, mine: Motion, other: Motion) -> Touch:
    at, weights, radius = line(mine, pair.radii[index], pair.points, pair.caps)
    found = closest(other, curve(other, pair.points), at.position)
    return meeting(at, found, radius, pair.radii[1 - index], weights / 2)


def rod_of(body: Motion | LinkMotion) -> Motion:
    """The motion of a part that must be a rod."""
    if not isinstance(body, Motion):
        raise ValueError(
            "RodContact: one of the parts is a rigid link, need two rods. Give the shape of "
            "a link that does not move as an obstacle: On(name, ObstacleContact(...))."
        )
    return body


def _forces(law: LinePenalty, one: Touch, two: Touch) -> tuple[Array, Array]:
    """Generalised force on the first and on the second rod."""
    on_first, on_second = press(law, one)
    again_second, again_first = press(law, two)
    return on_first + again_first, on_second + again_second


def _swap(matrix: Array, shift: int) -> Array:
    """Columns of the searching rod last where it is the second one."""
    return jnp.roll(matrix, (shift, shift), (0, 1)) if shift else matrix
