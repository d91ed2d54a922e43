"""A fixed-step integrator that stays stable, and loses energy only, in stiff contact."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from sorojax.math.dense import solve_symmetric
from sorojax.math.steppers import (
    AbstractStepper,
    ImplicitMidpoint,
    Kinematic,
    SecondOrder,
    move,
)

_SHORTER = 0.4  # of a Newton step that did not help


class ContactMidpoint(AbstractStepper):
    """Implicit midpoint whose normal contact forces act at the end of the step.

    A force that is convex in the coordinates does no work on a step when it is taken at its
    end; friction and damping are taken at the midpoint velocity, against which they work.
    Without contact this is the implicit midpoint rule.

    A step without contact is tried first; only if its midpoint comes near is it solved with
    contact, so far obstacles cost one test per step. Batched by vmap, every step is solved
    with contact.

    Attributes:
        passes: Newton passes per step without contact.
        contact_passes: Newton passes per step near contact.

    Reference:
        Kane, Repetto, Ortiz, Marsden, Finite element analysis of nonsmooth contact, Comput.
        Methods Appl. Mech. Engrg. 180, 1999, for contact at the end of a step.
    """

    passes: int = eqx.field(static=True, default=2)
    contact_passes: int = eqx.field(static=True, default=12)

    def step(self, problem, t, h, state):
        contact = problem.contact
        if contact is None:
            return ImplicitMidpoint(self.passes).step(problem, t, h, state)
        new, moment = state.a, None
        for _ in range(self.passes):
            new, moment = _free(problem, t, h, state, new)

        def touch():
            return _solve_touching(problem, t, h, state, new, self.contact_passes)

        new = jax.lax.cond(contact.near(moment, h), touch, lambda: new)
        half = state.v + h / 2 * new
        return Kinematic(move(problem, state.q, h * half), state.v + h * new, new)


def _free(problem: SecondOrder, t, h, state: Kinematic, new: Array):
    """A Newton pass for the mean acceleration, without contact, and the midpoint."""
    assert problem.contact is not None
    half = state.v + h / 2 * new
    middle = move(problem, state.q, h / 2 * half)
    mass, force, moment = problem.contact.free(t + h / 2, middle, half)
    implicit = mass + h / 2 * problem.damping + h**2 / 4 * problem.stiffness
    return new - solve_symmetric(implicit, mass @ new - force), moment


class _Search(NamedTuple):
    """Best mean acceleration so far, the size of its residual, and where to try next."""

    best: Array
    size: Array
    direction: Array
    share: Array


def _solve_touching(problem: SecondOrder, t, h, state: Kinematic, new: Array, passes: int):
    """Newton with contact. A pass whose residual is no smaller than the best shortens the
    step instead, as a point that comes and goes would make it cycle."""

    def improve(_, search: _Search) -> _Search:
        trial = search.best + search.share * search.direction
        size, direction = _touching(problem, t, h, state, trial)
        better = size < search.size
        accepted = _Search(trial, size, direction, jnp.ones_like(size))
        shortened = search._replace(share=_SHORTER * search.share)
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), accepted, shortened)

    one = jnp.ones((), new.dtype)
    first = _Search(new, jnp.inf * one, jnp.zeros_like(new), one)
    return jax.lax.fori_loop(0, passes, improve, first).best


def _touching(problem: SecondOrder, t, h, state: Kinematic, new: Array) -> tuple[Array, Array]:
    """Size of the residual with contact, and the Newton step: normal forces at the end of
    the step, sliding at its midpoint."""
    assert problem.contact is not None
    half = state.v + h / 2 * new
    middle, end = move(problem, state.q, h / 2 * half), move(problem, state.q, h * half)
    mass, force, _ = problem.contact.free(t + h / 2, middle, half)
    contact, stiffness, damping = problem.contact.force(t + h, end, half)
    implicit = mass + h / 2 * (problem.damping + damping)
    implicit = implicit + h**2 / 4 * problem.stiffness + h**2 / 2 * stiffness
    residual = mass @ new - force - contact
    held = jax.lax.stop_gradient((mass, residual))
    return held[1] @ solve_symmetric(*held), -solve_symmetric(implicit, residual)
