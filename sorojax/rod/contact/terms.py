"""The contacts among the forces on a rod or an assembly, apart from other
forces, for steppers."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.math.ode.steppers import ContactTerms
from sorojax.rod.contact.links import LinkContact
from sorojax.rod.contact.obstacle import AbstractContact, Linearised, twice_turn, twice_way
from sorojax.rod.contact.rods import RodContact
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.tree import AssemblyState, each, part_columns, part_motion
from sorojax.rod.forces.forces import AbstractForce, total_force as total_rod_force
from sorojax.rod.forces.loads import Load, PairForce, PartForce, check, total_force
from sorojax.rod.model.assembly import index_of
from sorojax.rod.model.rod import Rod

# twice the turn [rad], and twice the way over the length of a rod, that make a step long
_TURN, _SHARE = 0.6, 0.02
_SWIFT = 0.2  # twice the way over the narrowest radius that makes it swift


def has_contact(forces: tuple[AbstractForce, ...]) -> bool:
    """Whether a contact is listed, so that a stepper must treat it apart."""
    return any(isinstance(force, AbstractContact) for force in forces)


def contact_terms(
    forces: tuple[AbstractForce, ...],
    at: Callable[[Array, Array], RodState],
    inertia: Callable[[Any], tuple[Array, Array]],
) -> ContactTerms:
    """The listed contacts, and the equations without them.

    Args:
        forces: Generalised forces, contacts among them.
        at: (q, v) -> motion.
        inertia: motion -> (mass matrix, Coriolis force).
    """
    plain = tuple(force for force in forces if not isinstance(force, AbstractContact))
    contacts = tuple(force for force in forces if isinstance(force, AbstractContact))

    def force(t, q, v):
        moment = at(q, v)
        return linearised(contacts, t, moment)

    def passed(before, after, h):
        return any_of([passed_by(contact, h, (before,), (after,)) for contact in contacts])

    def stored(moment):
        return sum(contact.stored(moment) for contact in contacts)

    def near(moment, h):
        rows = [reached(contact, h, moment) for contact in contacts]
        return tuple(any_of(flags) for flags in zip(*rows, strict=True))

    parts = Parts(lambda t, moment: total_rod_force(plain, t, moment), passed, stored)
    return terms_of(parts, near, force, at, inertia)


class Parts(NamedTuple):
    """The parts of `ContactTerms`.

    Attributes:
        plain: (t, motion) -> the forces without contacts.
        passed: (motion before, motion after, h) -> whether anything went through anything.
        stored: motion -> energy in contacts.
    """

    plain: Callable[[Array, Any], Array]
    passed: Callable[[Any, Any, Array], Array]
    stored: Callable[[Any], Any]


def terms_of(
    parts: Parts,
    near: Callable,
    force: Callable,
    at: Callable[[Array, Array], Any],
    inertia: Callable[[Any], tuple[Array, Array]],
    symmetric: bool = True,
) -> ContactTerms:
    """The terms by (q, v), from those by motion."""

    def free(t, q, v):
        moment = at(q, v)
        mass, coriolis = inertia(moment)
        return mass, parts.plain(t, moment) - coriolis, moment

    def passed(before, after, h):
        return parts.passed(*still((at(*before), at(*after))), h)

    def energy(q, v, near):
        moment = still(at(q, v))
        mass, _ = inertia(moment)
        none = jnp.zeros((), q.dtype)
        stored = jax.lax.cond(near, lambda: still(parts.stored(moment)), lambda: none)
        return still(v @ mass @ v / 2), stored

    def plain(t, q, v):
        return still(parts.plain(t, at(q, v)))

    return ContactTerms(free, near, force, passed, energy, plain, symmetric)


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
    contact = still(contact)
    is_near = contact.is_near(*before, h) | contact.is_near(*after, h)
    return jax.lax.cond(
        is_near, lambda: contact.passed(before, after), lambda: jnp.zeros((), bool)
    )


def any_of(flags: Sequence[Array]) -> Bool[Array, ""]:
    return jnp.any(jnp.stack(flags))


def still(tree: Any) -> Any:
    """`tree` without derivatives."""
    numbers, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.lax.stop_gradient(numbers), rest)


def linearised(
    contacts: tuple[AbstractContact, ...], t: Float[Array, ""], motion: RodState
) -> Linearised:
    """Sum of one or more contacts with their stiffness and damping."""
    total = contacts[0].linearised(t, motion)
    for contact in contacts[1:]:
        term = contact.linearised(t, motion)
        total = Linearised(*(a + b for a, b in zip(total, term, strict=True)))
    return total


PAIRS = (RodContact, LinkContact)


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
    if isinstance(model, Rod):
        return contact_terms(forces, at, inertia) if has_contact(forces) else None
    check(model, forces)
    touching = [force for force in forces if _is_contact(force)]
    if not touching:
        return None
    plain = tuple(force for force in forces if not _is_contact(force))
    where = [(_parts(model, force), force.force) for force in touching]

    def near(moment: AssemblyState, h):
        def one(contact, *bodies):
            return reached(contact, h, *bodies)

        rows = [(contact, *(part_motion(moment, k) for k in parts)) for parts, contact in where]
        return tuple(any_of(flags) for flags in zip(*each(one, rows), strict=True))

    def force(t, q, v) -> Any:
        moment = at(q, v)
        columns = part_columns(moment)

        def one(contact, own, *bodies):
            term = contact.linearised(t, *bodies)
            return (
                term.force @ own,
                own.T @ term.stiffness @ own,
                own.T @ term.damping @ own,
            )

        rows = [
            (
                contact,
                jnp.concatenate([columns[k] for k in parts]),
                *(part_motion(moment, k) for k in parts),
            )
            for parts, contact in where
        ]
        return tuple(_sum(parts) for parts in zip(*each(one, rows), strict=True))

    def passed(before, after, h):
        def one(contact, before, after):
            return passed_by(contact, h, before, after)

        rows = [
            (contact, *(tuple(part_motion(end, k) for k in parts) for end in (before, after)))
            for parts, contact in where
        ]
        return any_of(each(one, rows))

    def stored(moment):
        rows = [(contact, *(part_motion(moment, k) for k in parts)) for parts, contact in where]
        return sum(each(lambda contact, *bodies: contact.stored(*bodies), rows))

    grips = any(isinstance(contact, LinkContact) for _, contact in where)
    terms = Parts(lambda t, moment: total_force(plain, t, moment), passed, stored)
    return terms_of(terms, near, force, at, inertia, symmetric=not grips)


def any_contact(forces: tuple[Load, ...]) -> bool:
    """Whether a contact is listed, on a rod or on a part."""
    return any(_is_contact(force) for force in forces)


def _is_contact(force: Load) -> bool:
    inner = force.force if isinstance(force, PartForce | PairForce) else force
    return isinstance(inner, (AbstractContact, *PAIRS))


def _parts(model: Any, force: PartForce | PairForce) -> tuple[int, ...]:
    names = (force.part,) if isinstance(force, PartForce) else (force.first, force.second)
    return tuple(index_of(model, name) for name in names)


def _sum(parts: tuple[Array, ...]) -> Array:
    return sum(parts[1:], start=parts[0])
