"""Whether a step moved points of a body through an obstacle, or gained energy in contact."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.contact.broadphase import far
from sorojax.contact.swept import passes
from sorojax.fem.contact.obstacle import AbstractPenaltyContact, Contact
from sorojax.fem.contact.self_contact import SelfContact
from sorojax.fem.dynamics.step import Dynamics, Matter, State, TimeStep
from sorojax.fem.loads.facets import areas_of, blockwise, facet_tables
from sorojax.fem.problem import Problem, body
from sorojax.fem.relaxation import stored_energy
from sorojax.math.linalg import sparse

Nodal = Float[Array, "nodes dim"]


def passed_through(
    problem: Problem, loads: tuple, u: Float[Array, "nodes dim"]
) -> Bool[Array, ""]:
    """Whether any point jumped through the obstacle of a contact among `loads`, those of a
    step that ends at displacement `u` [m], or a facet past another one."""
    found = [_jumped(load, problem, u) for load in loads if isinstance(load, Contact)]
    for load in loads:
        if isinstance(load, SelfContact):
            found += [load.outran(problem, u), load.sank(problem, u)]
    return jnp.any(jnp.stack(found)) if found else jnp.zeros((), bool)


_GAIN = 5e-4  # of the energy before and after a step together, that it may gain


def gains(
    dynamics: Dynamics, known: Matter, state: State, step: TimeStep, new: State, u: Nodal
) -> Bool[Array, ""]:
    """Whether the energies of body, contacts and springs of friction grew by more than the
    work of the other loads and of the supports, in a step whose forces act at displacement
    `u` [m]. Not judged where an obstacle with friction moves, whose work momentum follows late.
    """
    contacts = [load for load in step.terms[0] if isinstance(load, AbstractPenaltyContact)]
    if not contacts:
        return jnp.zeros((), bool)
    problem = body(dynamics.problem)

    def energy(at: State, stored):
        v = at.velocity.ravel()
        moving = v @ sparse.product(problem.space.system, known.mass, v) / 2
        held = sum(stored(load, problem, at.displacement) for load in contacts)
        kept = known.moduli, at.strains, at.displacement, at.peaks
        return moving + stored_energy(problem, *kept) + held

    def pushing(u):
        return sum((load.potential(problem, u) for load in contacts), start=0.0)

    before = energy(state, _at_first)
    after = energy(new, lambda load, problem, u: load.stored(problem, u))
    way = new.displacement - state.displacement
    pushed = -jax.jvp(pushing, (u,), (way,))[1]
    gained = after - before - (new.work - state.work - pushed) > _GAIN * (before + after)
    return gained & ~_drags(contacts)


def _at_first(load: AbstractPenaltyContact, problem: Problem, u: Nodal):
    """Energy of a contact where a step begins [J]."""
    if not isinstance(load, Contact) or load.grip is None:
        return load.stored(problem, u)
    bare = dataclasses.replace(load, grip=None)
    held = load.slider.stored(load.grip.back - load.grip.anchor)
    return bare.stored(problem, u) + jnp.sum(areas_of(problem, load.facets) * held)


def _drags(contacts: list) -> Bool[Array, ""]:
    """Whether an obstacle with friction moves in a step."""
    moves = [
        jnp.any(load.value != load.start.place)
        for load in contacts
        if isinstance(load, Contact) and load.grip is not None and load.start is not None
    ]
    return jnp.any(jnp.stack(moves)) if moves else jnp.zeros((), bool)


def _jumped(load: Contact, problem: Problem, u) -> Bool[Array, ""]:
    assert load.began is not None and load.start is not None
    values = jnp.asarray(facet_tables(problem.mesh.element).values)
    places = jnp.stack([load.start.place, load.value])

    def points_of(ends):
        """In the frame of the obstacle, that may move."""
        points = jnp.einsum("qa,feai->efqi", values, ends)
        return (points - places[:, None, None]).reshape(2, -1, points.shape[3])

    def jumped(ends, _):
        hit = passes(load.obstacle, *points_of(ends))
        return jnp.any(hit.reshape(ends.shape[0], -1), axis=1).astype(ends.dtype)

    def idle(ends, _):
        return far(load.obstacle, points_of(ends))

    ends = jnp.stack([load.began, (problem.mesh.points + u)[load.facets]], axis=1)
    return jnp.any(blockwise(jumped, idle, ends, None, ()) > 0)
