"""A fixed-step integrator that stays stable, and loses energy only, in stiff contact."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sorojax.math.linalg.dense import solve_symmetric
from sorojax.math.ode.step_control import cut
from sorojax.math.ode.steppers import (
    AbstractStepper,
    ImplicitMidpoint,
    Kinematic,
    SecondOrder,
    move,
    remembered,
    start,
    within,
)

_SHORTER = 0.4  # of a Newton step that did not help
_CUTS = 7  # halvings of a step in a row
_GAIN, _FREE_GAIN = 1e-3, 1e-2  # of its energy, that a long step may gain in contact, apart
_HALVES = 6  # of the way of a step, at most, that is looked at in parts
_LEAST = 1e-5  # of it, however much was gained before


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

    def begin(self, problem, t, q, v):
        begun = start(problem, t, q, v)
        return begun if problem.contact is None else _with_record(begun)

    def step(self, problem, t, h, state):
        if problem.contact is None:
            return ImplicitMidpoint(self.passes).step(problem, t, h, state)
        if problem.held is not None:
            raise ValueError(
                "ContactMidpoint: got contact on a model with closures, need one of both: its "
                "steps do not solve for reactions. Replace the closures by stiff springs."
            )
        if state.resolved is None:  # a loop that could not tell of a step that is held
            at = Span(t, h, self.theta * h)
            new = _step(problem, at, _with_record(state), self)[0]
            return new._replace(gained=None)

        def whole(t, h, state):
            return _step(problem, Span(t, h, self.theta * h), state, self)

        t, begun = jnp.asarray(t, h.dtype), state._replace(resolved=None)
        method, numbers = jax.closure_convert(whole, t, h, begun)

        def attempt(given, offset, size, state):
            t, resolved, numbers = given
            return jax.lax.cond(
                resolved,
                lambda: method(t + offset, size, state, *numbers),
                lambda: (state, jnp.zeros((), bool)),
            )

        given = t, state.resolved, tuple(numbers)
        new, reached = cut(attempt, _CUTS, given, h, begun)
        return new._replace(resolved=state.resolved & reached)


def _with_record(state: Kinematic) -> Kinematic:
    """The state with what contact keeps a record of."""
    if state.resolved is not None:
        return state
    return state._replace(gained=jnp.zeros((), state.v.dtype), resolved=jnp.array(True))


class Span(NamedTuple):
    """A step: its start [s], its length, and the part of it at which most forces act."""

    t: Array
    h: Array
    part: Array


def _step(problem: SecondOrder, at: Span, state: Kinematic, method: ContactMidpoint):
    """The state after a step, without its flag, and whether the step can be taken."""
    problem = within(problem, at.part, state)
    assert problem.contact is not None
    if method.lasting and method.passes == 1 and method.tolerance > 0:
        (near, long, swift), search = _solve_together(problem, at, state, method)
    else:
        (near, long, swift), search = _solve_apart(problem, at, state, method)
    new = search.best
    inner = state.v + at.part * new
    end = Kinematic(move(problem, state.q, at.h * inner), state.v + at.h * new, new)
    passed = jax.lax.cond(
        near, lambda: passed_on_way(problem, at, state, inner, long), lambda: np.False_
    )
    kept, gained = jax.lax.cond(
        long | swift & (search.contact > 0),
        lambda: _balance(problem, at, (state, end), inner, near),
        lambda: (np.True_, 0 * at.h),
    )
    memory = remembered(problem, at.h, state, end.q)
    return end._replace(gained=state.gained + gained, memory=memory), ~passed & kept


def passed_on_way(problem: SecondOrder, at: Span, state: Kinematic, inner: Array, long: Array):
    """Whether anything went through anything on the way of a step of mean rate `inner`, which
    is looked at in as many parts, in halves of halves, as it takes for none to be long."""
    contact = problem.contact
    assert contact is not None
    at, q, inner = jax.lax.stop_gradient((at, state.q, inner))

    def place(share):
        return move(problem, q, share * at.h * inner), inner

    def count():
        moment = jax.lax.stop_gradient(contact.free(at.t + at.part, *place(0.5))[2])
        sizes = at.h / 2.0 ** jnp.arange(_HALVES, dtype=at.h.dtype)
        is_long = jax.vmap(lambda h: contact.near(moment, h)[1])(sizes)
        return 2.0 ** jnp.sum(is_long.astype(sizes.dtype))

    parts = jax.lax.cond(long, count, lambda: jnp.ones((), at.h.dtype))

    def look(run):
        k, _ = run
        ways = place(k / parts), place((k + 1) / parts)
        return k + 1, contact.passed(*ways, at.h / parts)

    begin = jnp.zeros_like(parts), jnp.zeros((), bool)
    return jax.lax.while_loop(lambda run: (run[0] < parts) & ~run[1], look, begin)[1]


def _balance(
    problem: SecondOrder, at: Span, ends: tuple[Kinematic, Kinematic], inner: Array, near: Array
):
    """Whether the energies of motion and contact grew by no more than the work of the other
    forces, but for small shares of them, in this step and in all; and what they gained."""
    contact = problem.contact
    assert contact is not None
    (state, end), inner = jax.lax.stop_gradient((ends, inner))
    assert state.gained is not None
    middle = move(problem, state.q, at.part * inner)
    work = at.h * (inner @ contact.plain(at.t + at.part, middle, inner))
    (moving, stored), (moves, stores) = (contact.energy(*x[:2], near) for x in (state, end))
    gained = moves + stores - moving - stored - work
    size = moving + stored + moves + stores
    most = jnp.where(stores > 0, _GAIN, _FREE_GAIN) * size
    most = jnp.minimum(most, _GAIN * size / 4 - state.gained)
    return gained <= jnp.maximum(most, _LEAST * size), jax.lax.stop_gradient(gained)


def _solve_apart(problem: SecondOrder, at: Span, state: Kinematic, method: ContactMidpoint):
    """Whether contact is near, and the mean acceleration: with contact if it is."""
    assert problem.contact is not None
    new, moment = state.a, None
    for _ in range(method.passes):
        mass, force, moment = _free_at(problem, at, state, new)
        new = new - _newton(problem, at, mass, mass @ new - force)

    def touch():
        first = state.a if method.lasting else new
        return _solve_touching(problem, at, state, first, method)

    flags = problem.contact.near(moment, at.h)
    return flags, jax.lax.cond(flags[0], touch, lambda: _search_from(new))


class _Search(NamedTuple):
    """Best mean acceleration so far, the sizes of its residual and of its contact forces,
    where to try next, and whether that is needed."""

    best: Array
    size: Array
    contact: Array
    direction: Array
    share: Array
    done: Array


def _solve_touching(
    problem: SecondOrder, at: Span, state: Kinematic, new: Array, method: ContactMidpoint
):
    """Newton with contact."""

    def improve(_, search: _Search) -> _Search:
        trial = search.best + search.share * search.direction
        mass, force, _ = _free_at(problem, at, state, trial)
        return _judged(search, trial, _touching(problem, at, state, trial, mass, force), method)

    def unless_done(k, search: _Search) -> _Search:
        return jax.lax.cond(search.done, lambda: search, lambda: improve(k, search))

    loop = unless_done if method.tolerance > 0 else improve
    return jax.lax.fori_loop(0, method.contact_passes, loop, _search_from(new))


def _solve_together(problem: SecondOrder, at: Span, state: Kinematic, method: ContactMidpoint):
    """As `_solve_apart` where both solutions begin at the acceleration before: one loop whose
    first pass tells whether contact is near, so that the program holds the equations once."""
    contact = problem.contact
    assert contact is not None

    def improve(k, flags, search: _Search) -> tuple[Any, _Search]:
        trial = search.best + search.share * search.direction
        mass, force, moment = _free_at(problem, at, state, trial)
        flags = jax.lax.cond(k == 0, lambda: contact.near(moment, at.h), lambda: flags)

        def touching() -> _Search:
            found = _touching(problem, at, state, trial, mass, force)
            return _judged(search, trial, found, method)

        def apart() -> _Search:
            new = trial - _newton(problem, at, mass, mass @ trial - force)
            return search._replace(best=new, done=jnp.ones_like(search.done))

        return flags, jax.lax.cond(flags[0], touching, apart)

    def unless_done(k, carry):
        return jax.lax.cond(carry[1].done, lambda: carry, lambda: improve(k, *carry))

    start = (jnp.array(False),) * 3, _search_from(state.a)
    return jax.lax.fori_loop(0, max(1, method.contact_passes), unless_done, start)


def _search_from(new: Array) -> _Search:
    one = jnp.ones((), new.dtype)
    return _Search(new, jnp.inf * one, 0 * one, jnp.zeros_like(new), one, jnp.array(False))


def _judged(
    search: _Search, trial: Array, found: tuple[Array, Array, Array], method: ContactMidpoint
) -> _Search:
    """A pass whose residual is no smaller than the best shortens the step instead, as a point
    that comes and goes would make it cycle."""
    size, direction, contact = found
    better = size < search.size
    done = size <= method.tolerance**2 * contact
    accepted = _Search(trial, size, contact, direction, jnp.ones_like(size), done)
    shortened = search._replace(share=_SHORTER * search.share)
    return jax.tree.map(lambda a, b: jnp.where(better, a, b), accepted, shortened)


def _free_at(problem: SecondOrder, at: Span, state: Kinematic, new: Array):
    """Mass, force without contact and motion within a step of mean acceleration `new`."""
    assert problem.contact is not None
    inner = state.v + at.part * new
    middle = move(problem, state.q, at.part * inner)
    return problem.contact.free(at.t + at.part, middle, inner)


def _newton(problem: SecondOrder, at: Span, mass: Array, residual: Array) -> Array:
    """Excess of the acceleration, without contact."""
    implicit = mass + at.part * problem.damping + at.part**2 * problem.stiffness
    return solve_symmetric(implicit, residual)


def _touching(
    problem: SecondOrder, at: Span, state: Kinematic, new: Array, mass: Array, force: Array
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
