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
        lasting: Start those from the step before instead of from a step without contact:
            for grasps that last, where few passes then do.
        theta: Where within a step the other forces, friction and damping act: at 1/2 the rule
            of the midpoint, at 1 backward Euler, which damps what is faster than the step and
            would ring in a grip.
        tolerance: Unbalanced force over contact force at which passes stop, both in the norm
            of the inverse mass; 0 makes all passes.

    Reference:
        Kane, Repetto, Ortiz, Marsden, Finite element analysis of nonsmooth contact, Comput.
        Methods Appl. Mech. Engrg. 180, 1999, for contact at the end of a step.
    """

    passes: int = eqx.field(static=True, default=2)
    contact_passes: int = eqx.field(static=True, default=12)
    lasting: bool = eqx.field(static=True, default=False)
    theta: float = eqx.field(static=True, default=0.5)
    tolerance: float = eqx.field(static=True, default=0.0)

    def step(self, problem, t, h, state):
        contact = problem.contact
        if contact is None:
            return ImplicitMidpoint(self.passes).step(problem, t, h, state)
        at = _At(t, h, self.theta * h)
        if self.lasting and self.passes == 1 and self.tolerance > 0:
            new = _solve_together(problem, at, state, self)
        else:
            new = _solve_apart(problem, at, state, self)
        half = state.v + at.part * new
        return Kinematic(move(problem, state.q, h * half), state.v + h * new, new)


class _At(NamedTuple):
    """A step: its start [s], its length, and the part of it at which most forces act."""

    t: Array
    h: Array
    part: Array


def _solve_apart(problem: SecondOrder, at: _At, state: Kinematic, method: ContactMidpoint):
    """The mean acceleration without contact, or with it if that comes near."""
    assert problem.contact is not None
    new, moment = state.a, None
    for _ in range(method.passes):
        mass, force, moment = _free_at(problem, at, state, new)
        new = new - _newton(problem, at, mass, mass @ new - force)

    def touch():
        first = state.a if method.lasting else new
        return _solve_touching(problem, at, state, first, method)

    return jax.lax.cond(problem.contact.near(moment, at.h), touch, lambda: new)


class _Search(NamedTuple):
    """Best mean acceleration so far, the size of its residual, where to try next, and
    whether that is needed."""

    best: Array
    size: Array
    direction: Array
    share: Array
    done: Array


def _solve_touching(
    problem: SecondOrder, at: _At, state: Kinematic, new: Array, method: ContactMidpoint
):
    """Newton with contact."""

    def improve(_, search: _Search) -> _Search:
        trial = search.best + search.share * search.direction
        mass, force, _ = _free_at(problem, at, state, trial)
        return _judged(search, trial, _touching(problem, at, state, trial, mass, force), method)

    def unless_done(k, search: _Search) -> _Search:
        return jax.lax.cond(search.done, lambda: search, lambda: improve(k, search))

    loop = unless_done if method.tolerance > 0 else improve
    return jax.lax.fori_loop(0, method.contact_passes, loop, _search_from(new)).best


def _solve_together(problem: SecondOrder, at: _At, state: Kinematic, method: ContactMidpoint):
    """As `_solve_apart` where both solutions begin at the acceleration before: one loop whose
    first pass tells whether contact is near, so that the program holds the equations once."""
    contact = problem.contact
    assert contact is not None

    def improve(k, near, search: _Search) -> tuple[Array, _Search]:
        trial = search.best + search.share * search.direction
        mass, force, moment = _free_at(problem, at, state, trial)
        near = jax.lax.cond(k == 0, lambda: contact.near(moment, at.h), lambda: near)

        def touching() -> _Search:
            found = _touching(problem, at, state, trial, mass, force)
            return _judged(search, trial, found, method)

        def apart() -> _Search:
            new = trial - _newton(problem, at, mass, mass @ trial - force)
            return search._replace(best=new, done=jnp.ones_like(search.done))

        return near, jax.lax.cond(near, touching, apart)

    def unless_done(k, carry):
        return jax.lax.cond(carry[1].done, lambda: carry, lambda: improve(k, *carry))

    start = jnp.array(False), _search_from(state.a)
    return jax.lax.fori_loop(0, max(1, method.contact_passes), unless_done, start)[1].best


def _search_from(new: Array) -> _Search:
    one = jnp.ones((), new.dtype)
    return _Search(new, jnp.inf * one, jnp.zeros_like(new), one, jnp.array(False))


def _judged(
    search: _Search, trial: Array, found: tuple[Array, Array, Array], method: ContactMidpoint
) -> _Search:
    """A pass whose residual is no smaller than the best shortens the step instead, as a point
    that comes and goes would make it cycle."""
    size, direction, contact = found
    better = size < search.size
    done = size <= method.tolerance**2 * contact
    accepted = _Search(trial, size, direction, jnp.ones_like(size), done)
    shortened = search._replace(share=_SHORTER * search.share)
    return jax.tree.map(lambda a, b: jnp.where(better, a, b), accepted, shortened)


def _free_at(problem: SecondOrder, at: _At, state: Kinematic, new: Array):
    """Mass, force without contact and motion within a step of mean acceleration `new`."""
    assert problem.contact is not None
    inner = state.v + at.part * new
    middle = move(problem, state.q, at.part * inner)
    return problem.contact.free(at.t + at.part, middle, inner)


def _newton(problem: SecondOrder, at: _At, mass: Array, residual: Array) -> Array:
    """What the acceleration is too large by, without contact."""
    implicit = mass + at.part * problem.damping + at.part**2 * problem.stiffness
    return solve_symmetric(implicit, residual)


def _touching(
    problem: SecondOrder, at: _At, state: Kinematic, new: Array, mass: Array, force: Array
) -> tuple[Array, Array, Array]:
    """Size of the residual with contact, the Newton step, and the size of the contact
    forces: normal ones at the end of the step, all others, `force` beside them, within it."""
    assert problem.contact is not None
    h, part = at.h, at.part
    inner = state.v + part * new
    end = move(problem, state.q, h * inner)
    contact, stiffness, damping = problem.contact.force(at.t + h, end, inner)
    implicit = mass + part * (problem.damping + damping)
    implicit = implicit + part**2 * problem.stiffness + part * h * stiffness
    residual = mass @ new - force - contact
    solve = solve_symmetric if problem.contact.symmetric else jnp.linalg.solve
    sizes = [_size(mass, force) for force in (residual, contact)]
    return sizes[0], -solve(implicit, residual), sizes[1]


def _size(mass: Array, force: Array) -> Array:
    mass, force = jax.lax.stop_gradient((mass, force))
    return force @ solve_symmetric(mass, force)
