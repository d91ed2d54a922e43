"""What contacts did along a motion of rods: how deep, how hard, and what they moved."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.math.door import door
from sorojax.rod import (
    AbstractContact,
    Assembly,
    AssemblyMotion,
    Between,
    LinkContact,
    Motion,
    On,
    Rod,
    RodContact,
    motion,
    part_motion,
    total_force,
)
from sorojax.rod.pressing import Touch
from sorojax.rod.rod_contact import touches


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


@door
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

    def at(q, v):
        here = motion(model, q, v)
        none = total_force((), jnp.zeros((), q.dtype), here)
        rows = [_seen(contact, here, none) for contact in contacts]
        return Touching(*(jnp.stack(column) for column in zip(*rows, strict=True)))

    return jax.lax.map(lambda row: at(*row), (real(q), real(v)))


def _inner(contact: Any) -> Any:
    """A contact without its place."""
    return contact.force if isinstance(contact, On | Between) else contact


def _check_kind(contact: Any) -> None:
    inner = _inner(contact)
    if not isinstance(inner, AbstractContact | RodContact | LinkContact):
        raise TypeError(
            f"touching: got a {type(inner).__name__}, need contacts. Leave other forces out."
        )


def _seen(contact: Any, here: Motion | AssemblyMotion, none: Array):
    effort = total_force((contact,), jnp.zeros((), none.dtype), here) - none
    law, found = _inner(contact).law, _touches(contact, here)
    overlap = -jnp.min(jnp.concatenate([touch.gap for touch in found]))
    push = _resultant(found[0], law)
    for touch in found[1:]:  # of two rods: the second searches the first
        push = push - _resultant(touch, law)
    return overlap, push, effort


def _touches(contact: Any, here: Any) -> tuple[Touch, ...]:
    inner = _inner(contact)
    if not isinstance(contact, On | Between):
        return (inner.touch(here),)
    names = here.assembly.names
    if isinstance(contact, On):
        return (inner.touch(part_motion(here, names.index(contact.part))),)
    first, second = (
        part_motion(here, names.index(name)) for name in (contact.first, contact.second)
    )
    if isinstance(inner, RodContact):
        return touches(inner, first, second)
    return (inner.touch(first, second),)


def _resultant(touch: Touch, law: Any) -> Float[Array, " dim"]:
    return (touch.weights * law.pressure(touch.gap)) @ touch.normal
