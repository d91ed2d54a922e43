"""Contacts along a motion of rods: their overlaps, normal forces and generalised forces."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._jax.jit import once
from sorojax._types import real
from sorojax.rod import (
    AbstractContact,
    Assembly,
    LinkContact,
    PairForce,
    PartForce,
    Rod,
    RodContact,
    motion,
    part_motion,
)
from sorojax.rod.contact.obstacle import Touch
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.tree import columns_of, each
from sorojax.rod.forces.loads import parts_of
from sorojax.rod.model.assembly import index_of, num_dof, slices


class ContactHistory(eqx.Module):
    """Contacts at some moments.

    Attributes:
        overlap: Greatest overlap of each contact [m]; below zero the distance that is left.
        push: Resultant of the normal forces on the body, the first one of a pair [N].
        effort: Generalised force of each contact, friction included, over the rates of the
            model, or of those of its parts that were asked for: of a link that is free to
            move, the force and moment on it.
    """

    overlap: Float[Array, "moments contacts"]
    push: Float[Array, "moments contacts dim"]
    effort: Float[Array, "moments contacts dof"]


def contact_history(
    model: Rod | Assembly,
    contacts: tuple[Any, ...],
    q: Float[Array, "moments coordinates"],
    v: Float[Array, "moments dof"],
    parts: Sequence[str] | None = None,
) -> ContactHistory:
    """Overlaps and forces of `contacts` along a motion.

    Args:
        model: The rod or assembly.
        contacts: As given to its verbs: contacts of a rod, `PartForce(part, contact)` and
            `PairForce(first, second, contact)`.
        q: Coordinates, e.g. of a rod's trajectory.
        v: Rates; they set the friction.
        parts: Of an assembly, those over whose rates to tell the efforts, one part after
            the other; all if omitted. Few compile faster.

    Returns:
        Overlaps and forces at every moment.

    Raises:
        TypeError: If one of `contacts` is no contact.
        ValueError: If the model has no part of such a name.
    """
    for contact in contacts:
        _check_kind(contact)
    rates = tuple(range(num_dof(model)))
    if parts is not None:
        if isinstance(model, Rod):
            raise ValueError(
                f"touching: got the parts {list(parts)} of a rod, which has none. "
                "Leave them out."
            )
        places = [slices(model)[index_of(model, name)] for name in parts]
        rates = tuple(k for at in places for own in (at.joint_v, at.rod_v) for k in rates[own])
    return _along(model, contacts, rates, real(q), real(v))


@once
def _along(model, contacts, rates: tuple[int, ...], q, v) -> ContactHistory:
    def at(q, v):
        here = motion(model, q, v)
        rows = each(_seen, [_seated(contact, here, rates) for contact in contacts])
        return ContactHistory(*(jnp.stack(column) for column in zip(*rows, strict=True)))

    return jax.lax.map(lambda row: at(*row), (q, v))


def _inner(contact: Any) -> Any:
    """A contact without its place."""
    return contact.force if isinstance(contact, PartForce | PairForce) else contact


def _check_kind(contact: Any) -> None:
    inner = _inner(contact)
    if not isinstance(inner, AbstractContact | RodContact | LinkContact):
        raise TypeError(
            f"touching: got a {type(inner).__name__}, need contacts. Leave other forces out."
        )


def _seated(contact: Any, here: Any, rates: tuple[int, ...]) -> tuple[Any, ...]:
    """A contact, the columns per rate of the bodies that it is on, an effort of nothing, and
    these bodies."""
    inner, nothing = _inner(contact), jnp.zeros(len(rates), here.v.dtype)
    if isinstance(here, RodState):
        return inner, (jnp.eye(len(rates), dtype=here.v.dtype),), nothing, here
    places = [here.assembly.names.index(name) for name in parts_of(contact)]
    columns = columns_of(here, np.array(rates, int))
    own = tuple(columns[k] for k in places)
    return inner, own, nothing, *(part_motion(here, k) for k in places)


def _seen(contact: Any, own: tuple[Array | None, ...], effort: Array, *bodies: Any):
    load = contact(jnp.zeros((), effort.dtype), *bodies)
    for part, columns in zip((load,) if len(bodies) == 1 else load, own, strict=True):
        effort = effort if columns is None else effort + part @ columns
    found = contact.touches(*bodies)
    overlap = -jnp.min(jnp.concatenate([touch.gap for touch in found]))
    push = _resultant(found[0], contact.law)
    for touch in found[1:]:  # of two rods: the second searches the first
        push = push - _resultant(touch, contact.law)
    return overlap, push, effort


def _resultant(touch: Touch, law: Any) -> Float[Array, " dim"]:
    return (touch.weights * law.pressure(touch.gap)) @ touch.normal
