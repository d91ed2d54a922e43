"""The contacts among the forces on an assembly, separated from the others, for steppers."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from sorojax.math.ode.steppers import ContactTerms
from sorojax.rod.contact.links import LinkContact
from sorojax.rod.contact.obstacle import AbstractContact
from sorojax.rod.contact.rods import RodContact
from sorojax.rod.contact.terms import (
    Parts,
    any_of,
    contact_terms,
    has_contact,
    passed_by,
    reached,
    terms_of,
)
from sorojax.rod.dynamics.composite import part_columns
from sorojax.rod.dynamics.tree import AssemblyState, each, part_motion
from sorojax.rod.forces.loads import Load, PairForce, PartForce, check, total_force
from sorojax.rod.model.assembly import index_of
from sorojax.rod.model.rod import Rod

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
            (contact, jnp.concatenate([columns[k] for k in parts]),
             *(part_motion(moment, k) for k in parts))
            for parts, contact in where
        ]  # fmt: skip
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
