"""The contacts among the forces on a rod, apart from the others, for steppers."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.math.steppers import ContactTerms
from sorojax.rod.contact_force import AbstractContact, Linearised
from sorojax.rod.forces import AbstractForce, total_force
from sorojax.rod.motion import Motion

_SURGE = 100.0  # acceleration that a broad phase allows for within a step [m/s^2]


def has_contact(forces: tuple[AbstractForce, ...]) -> bool:
    """Whether a contact is listed, so that a stepper must treat it apart."""
    return any(isinstance(force, AbstractContact) for force in forces)


def contact_terms(
    forces: tuple[AbstractForce, ...],
    at: Callable[[Array, Array], Motion],
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

    def free(t, q, v):
        moment = at(q, v)
        mass, coriolis = inertia(moment)
        return mass, total_force(plain, t, moment) - coriolis, moment

    def force(t, q, v):
        moment = at(q, v)
        return linearised(contacts, t, moment)

    return ContactTerms(free, lambda moment, h: near(contacts, moment, h), force)


def near(
    contacts: tuple[AbstractContact, ...], moment: Motion, h: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether any contact may act within a step of `h` [s] about `moment`."""
    margin = travel(moment, h)
    answer = contacts[0].is_near(moment, margin)
    for contact in contacts[1:]:
        answer = answer | contact.is_near(moment, margin)
    return answer


def travel(moment: Motion, h: Float[Array, ""]) -> Float[Array, ""]:
    """How far [m] any section may move within a step of `h`."""
    velocity = moment.linear_jacobian.reshape(-1, moment.v.shape[0]) @ moment.v
    fastest = jnp.sqrt(jnp.max(jnp.sum(velocity.reshape(moment.tangent.shape) ** 2, axis=1)))
    return 2 * h * fastest + _SURGE * h**2


def linearised(
    contacts: tuple[AbstractContact, ...], t: Float[Array, ""], motion: Motion
) -> Linearised:
    """Sum of one or more contacts with their stiffness and damping."""
    total = contacts[0].linearised(t, motion)
    for contact in contacts[1:]:
        term = contact.linearised(t, motion)
        total = Linearised(*(a + b for a, b in zip(total, term, strict=True)))
    return total
