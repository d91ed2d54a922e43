"""What contacts did along a motion of rods: how deep, how hard, and what they moved."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.math.jit import once
from sorojax.rod import (
    AbstractContact,
    Assembly,
    Between,
    LinkContact,
    Motion,
    On,
    Rod,
    RodContact,
    motion,
    part_motion,
)
from sorojax.rod.alike import each
from sorojax.rod.pressing import Touch
from sorojax.rod.rod_contact import touches
from sorojax.rod.tree import part_columns


class Touching(eqx.Module):
    """Contacts at some moments.

    Attributes:
        overlap: Greatest overlap of each contact [m]; below zero the distance that is left.
        push: Resultant of the normal forces on the body, the first one of a pair [N].
        effort: Generalised force of each contact, friction included, over the rates of the
            model: of a link that is free to move, the force and moment on it.
    """

    overlap: Float[Array, "moments contacts"]
    push: Float[Array, "moments contacts dim"]
    effort: Float[Array, "moments contacts dof"]


def touching(
    model: Rod | Assembly,
    contacts: tuple[Any, ...],
    q: Float[Array, "moments coordinates"],
    v: Float[Array, "moments dof"],
) -> Touching:
    """Overlaps and forces of `contacts` along a motion.

    Args:
        model: The rod or assembly.
        contacts: As given to its verbs: contacts of a rod, `On(part, contact)` and
            `Between(first, second, contact)`.
        q: Coordinates, e.g. of a `Rollout`.
        v: Rates; they set the friction.

    Raises:
        TypeError: If one of `contacts` is no contact.
    """
    for contact in contacts:
        _check_kind(contact)
    return _along(model, contacts, real(q), real(v))


@once
def _along(model, contacts, q, v) -> Touching:
    def at(q, v):
        here = motion(model, q, v)
        rows = each(_seen, [_seated(contact, here) for contact in contacts])
        return Touching(*(jnp.stack(column) for column in zip(*rows, strict=True)))

    return jax.lax.map(lambda row: at(*row), (q, v))


def _inner(contact: Any) -> Any:
    """A contact without its place."""
    return contact.force if isinstance(contact, On | Between) else contact


def _check_kind(contact: Any) -> None:
    inner = _inner(contact)
    if not isinstance(inner, AbstractContact | RodContact | LinkContact):
        raise TypeError(
            f"touching: got a {type(inner).__name__}, need contacts. Leave other forces out."
        )


def _seated(contact: Any, here: Any) -> tuple[Any, ...]:
    """A contact, the bodies that it is on, and their columns per rate of the model."""
    inner = _inner(contact)
    if isinstance(here, Motion):
        return inner, jnp.eye(here.v.shape[0], dtype=here.v.dtype), here
    names = (contact.part,) if isinstance(contact, On) else (contact.first, contact.second)
    places, columns = [here.assembly.names.index(name) for name in names], part_columns(here)
    own = jnp.concatenate([columns[k] for k in places])
    return inner, own, *(part_motion(here, k) for k in places)


def _seen(contact: Any, own: Array, *bodies: Any):
    load = contact(jnp.zeros((), own.dtype), *bodies)
    effort = (load if len(bodies) == 1 else jnp.concatenate(load)) @ own
    is_pair = isinstance(contact, RodContact)
    found = touches(contact, *bodies) if is_pair else (contact.touch(*bodies),)
    overlap = -jnp.min(jnp.concatenate([touch.gap for touch in found]))
    push = _resultant(found[0], contact.law)
    for touch in found[1:]:  # of two rods: the second searches the first
        push = push - _resultant(touch, contact.law)
    return overlap, push, effort


def _resultant(touch: Touch, law: Any) -> Float[Array, " dim"]:
    return (touch.weights * law.pressure(touch.gap)) @ touch.normal
