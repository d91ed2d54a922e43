"""The contacts among the forces on a rod or an assembly, apart from other
forces, for steppers."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax._edit import without_derivatives
from sorojax.math.ode.steppers import ContactTerms
from sorojax.rod.contact.obstacle import (
    AbstractTouching,
    Linearised,
    total,
    twice_turn,
    twice_way,
)
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.tree import each, part_columns, part_motion
from sorojax.rod.forces.loads import Load, PairForce, PartForce, check, total_force
from sorojax.rod.model.assembly import index_of
from sorojax.rod.model.rod import Rod

# twice the turn [rad], and twice the way over the length of a rod, that make a step long
_TURN, _SHARE = 0.6, 0.02
_SWIFT = 0.2  # twice the way over the narrowest radius that makes it swift


def reached(contact: Any, h: Float[Array, ""], *bodies: Any) -> tuple[Array, Array, Array]:
    """Whether a contact may act within a step of `h` [s]; whether the step is so long that it
    may gain energy by itself; and whether it is, against the size of what meets, in contact."""
    ways = sum((twice_way(body, h) for body in bodies), start=0 * h)
    is_long = any_of([long(body, h) for body in bodies])
    return contact.is_near(*bodies, h), is_long, ways > _SWIFT * contact.narrowest


def long(moment: Any, h: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether any section turns, or moves, far within a step of `h` [s]."""
    turns = jnp.asarray(twice_turn(moment, h) > _TURN)
    if not isinstance(moment, RodState):
        return turns
    return turns | (twice_way(moment, h) > _SHARE * moment.rod.length)


def passed_by(
    contact: Any, h: Float[Array, ""], before: tuple, after: tuple
) -> Bool[Array, ""]:
    """Whether in a step of `h` [s] one body of a contact went through the other, at one test
    if they are far."""
    contact = without_derivatives(contact)
    is_near = contact.is_near(*before, h) | contact.is_near(*after, h)
    return jax.lax.cond(
        is_near, lambda: contact.passed(before, after), lambda: jnp.zeros((), bool)
    )


def any_of(flags: Sequence[Array]) -> Bool[Array, ""]:
    return jnp.any(jnp.stack(flags))


def contacts_of(
    model: Any, forces: tuple[Any, ...], at: Callable, inertia: Callable
) -> ContactTerms | None:
    """The contacts among the forces on a rod or assembly; None without any.

    Args:
        model: The rod or assembly.
        forces: Generalised forces.
        at: (q, v) -> motion.
        inertia: motion -> (mass matrix, Coriolis force).
    """
    single = isinstance(model, Rod)
    if not single:
        check(model, forces)
    touching = [force for force in forces if _is_contact(force)]
    if not touching:
        return None
    plain = tuple(force for force in forces if not _is_contact(force))
    contacts = [_inner(force) for force in touching]
    places = [() if single else _parts(model, force) for force in touching]

    def bodies(moment) -> list[tuple]:
        if single:
            return [(moment,)] * len(contacts)
        return [tuple(part_motion(moment, k) for k in parts) for parts in places]

    def every(one: Callable, *columns: Any) -> list[Any]:
        rows = list(zip(contacts, *columns, strict=True))
        return [one(*row) for row in rows] if single else each(one, rows)

    def near(moment, h) -> Any:
        rows = every(lambda contact, own: reached(contact, h, *own), bodies(moment))
        return tuple(any_of(flags) for flags in zip(*rows, strict=True))

    def force(t, q, v) -> Any:
        moment = at(q, v)

        def one(contact, own, columns=None):
            term = contact.linearised(t, *own)
            if columns is None:
                return tuple(term)
            matrices = (columns.T @ x @ columns for x in (term.stiffness, term.damping))
            return (term.force @ columns, *matrices)

        columns = []
        if not single:
            parts = part_columns(moment)
            columns = [[jnp.concatenate([parts[k] for k in on]) for on in places]]
        terms = every(one, bodies(moment), *columns)
        return Linearised(*(total(column) for column in zip(*terms, strict=True)))

    def free(t, q, v):
        moment = at(q, v)
        mass, coriolis = inertia(moment)
        return mass, total_force(plain, t, moment) - coriolis, moment

    def passed(before, after, h):
        ends = without_derivatives((at(*before), at(*after)))
        rows = every(lambda contact, *ends: passed_by(contact, h, *ends), *map(bodies, ends))
        return any_of(rows)

    def energy(q, v, near):
        moment = without_derivatives(at(q, v))
        mass, _ = inertia(moment)

        def stored():
            rows = every(lambda contact, own: contact.stored(*own), bodies(moment))
            return without_derivatives(total(rows))

        in_contacts = jax.lax.cond(near, stored, lambda: jnp.zeros((), q.dtype))
        return without_derivatives(v @ mass @ v / 2), in_contacts

    def others(t, q, v):
        return without_derivatives(total_force(plain, t, at(q, v)))

    grips = any(contact.grips for contact in contacts)
    return ContactTerms(free, near, force, passed, energy, others, not grips)


def any_contact(forces: tuple[Load, ...]) -> bool:
    """Whether a contact is listed, on a rod or on a part."""
    return any(_is_contact(force) for force in forces)


def _inner(force: Load) -> Any:
    return force.force if isinstance(force, PartForce | PairForce) else force


def _is_contact(force: Load) -> bool:
    return isinstance(_inner(force), AbstractTouching)


def _parts(model: Any, force: PartForce | PairForce) -> tuple[int, ...]:
    names = (force.part,) if isinstance(force, PartForce) else (force.first, force.second)
    return tuple(index_of(model, name) for name in names)
