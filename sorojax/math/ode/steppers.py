"""Fixed-step integrators of second-order equations, M a = f, for loops of known cost."""

import abc
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax._types import real
from sorojax.math.host import tell
from sorojax.math.linalg.dense import solve_symmetric
from sorojax.math.ode.explicit import (
    DORMAND_PRINCE,
    RK4,
    Field,
    Tableau,
    rolled_step,
)
from sorojax.math.ode.held import Held, HeldTerms, projected, solve_held
from sorojax.math.ode.step_control import (
    Doubled,
    after_start,
    passes,
    rows_between,
    rows_too_long,
    whole_rows,
)


class ContactTerms(NamedTuple):
    """Contact apart from the other forces, for methods that treat it apart.

    Attributes:
        free: (t, q, v) -> (mass matrix, force without contact, moment).
        near: (moment, h) -> whether a step of `h` about that moment may meet contact,
            whether it is so long that it may gain energy, and whether it may in contact.
        force: (t, q, v) -> (force, stiffness, damping) of the contacts.
        passed: ((q, v) before, (q, v) after, h) -> whether anything went through anything.
        energy: (q, v, near) -> energy of motion, and in contacts [J], none if not `near`.
        plain: (t, q, v) -> the forces without contact.
        symmetric: Whether those matrices are.
    """

    free: Callable[[Array, Array, Array], tuple[Array, Array, Any]]
    near: Callable[[Any, Array], tuple[Array, Array, Array]]
    force: Callable[[Array, Array, Array], tuple[Array, Array, Array]]
    passed: Callable[[tuple[Array, Array], tuple[Array, Array], Array], Array]
    energy: Callable[[Array, Array, Array], tuple[Array, Array]]
    plain: Callable[[Array, Array, Array], Array]
    symmetric: bool = True


class MemoryTerms(NamedTuple):
    """Forces that depend on the motion so far, by a memory that relaxes to the coordinates.

    Attributes:
        begin: The memory to begin with.
        rate: (q, memory) -> its rate.
        force: (q, memory) -> the force.
        within: (span, q, memory) -> (force, stiffness) a `span` [s] after (q, memory): the
            force as a function of the coordinates then, and about - d force / dq.
        after: (h, q before, q after, memory before) -> the memory after a step of `h` [s].
    """

    begin: Float[Array, "branches dof"]
    rate: Callable[[Array, Array], Array]
    force: Callable[[Array, Array], Array]
    within: Callable[[Array, Array, Array], tuple[Callable[[Array], Array], Array]]
    after: Callable[[Array, Array, Array, Array], Array]


class SecondOrder(NamedTuple):
    """Equations M(q) a = f(t, q, v) with the matrices an implicit method may lean on.

    Where rates are not derivatives of coordinates (a pose with a quaternion), `retract`
    and `rate` say how they move them.

    Attributes:
        equations: (t, q, v) -> (mass matrix, force).
        stiffness: About - df/dq.
        damping: About - df/dv.
        retract: (q, increment of the rates' dimension) -> q moved; a sum if None.
        rate: (q, v) -> dq/dt; v if None.
        contact: Contact, which `equations` hold as well, apart; None without any.
        memory: Forces with a memory, which `equations` do not hold; None without any.
        held: What holds the coordinates to equations of their own; None without any.
    """

    equations: Callable[[Array, Array, Array], tuple[Array, Array]]
    stiffness: Float[Array, "dof dof"]
    damping: Float[Array, "dof dof"]
    retract: Callable[[Array, Array], Array] | None = None
    rate: Callable[[Array, Array], Array] | None = None
    contact: ContactTerms | None = None
    memory: MemoryTerms | None = None
    held: HeldTerms | None = None


class Kinematic(NamedTuple):
    """Coordinates, rates and accelerations of a second-order system.

    In contact, `resolved` says whether every step so far could be taken; where not, the state
    is that before the step. `gained` is the energy that steps gained by themselves [J].
    `memory` is that of forces which have one, `share` tells how far equations that hold the
    coordinates have been from dependent.
    """

    q: Float[Array, " coordinates"]
    v: Float[Array, " dof"]
    a: Float[Array, " dof"]
    gained: Float[Array, ""] | None = None
    resolved: Bool[Array, ""] | None = None
    memory: Float[Array, "branches dof"] | None = None
    share: Float[Array, ""] | None = None


class AbstractStepper(eqx.Module):
    """A fixed-step method for second-order systems.

    Attributes:
        settles: Whether a step of no length finds the acceleration of its state.
    """

    settles: ClassVar[bool] = False

    def begin(self, problem: SecondOrder, t, q: Array, v: Array) -> Kinematic:
        """The state to begin with."""
        return start(problem, t, q, v)

    @abc.abstractmethod
    def step(self, problem: SecondOrder, t, h, state: Kinematic) -> Kinematic:
        """The state after a step of `h` [s] from `t` [s]."""


def start(problem: SecondOrder, t, q: Array, v: Array) -> Kinematic:
    """A state with the acceleration that belongs to (q, v)."""
    still = _still(problem, t, q, v)
    if problem.memory is None:
        return still._replace(a=acceleration(problem, t, still.q, still.v))
    push = problem.memory.force(still.q, problem.memory.begin)
    return still._replace(a=acceleration(problem, t, still.q, still.v, push))


def acceleration(problem: SecondOrder, t, q: Array, v: Array, push: Array | None = None):
    """That of a state, under one more force."""
    if problem.held is None:
        mass, force = problem.equations(t, q, v)
        return solve_symmetric(mass, force if push is None else force + push)
    mass, force, held = problem.held.accelerations(t, q, v)
    force = force if push is None else force + push
    return solve_held(mass, force, held, problem.held.by).x


def placed(problem: SecondOrder, t, state: Kinematic, pulled: Array | None = None) -> Kinematic:
    """A state at `t` on what holds the coordinates, along the motions `pulled`."""
    if problem.held is None:
        return state
    by = functools.partial(move, problem)
    q, v, share = projected(problem.held, by, t, (state.q, state.v), pulled)
    share = share if state.share is None else jnp.minimum(share, state.share)
    return state._replace(q=q, v=v, share=share)


def within(problem: SecondOrder, span, state: Kinematic) -> SecondOrder:
    """The equations `span` [s] after `state`, with the forces that have a memory."""
    if problem.memory is None:
        return problem
    if state.memory is None:
        raise ValueError(
            "steppers: got a state without memory, need one, as a force remembers the motion. "
            "Begin with `start(problem, t, q, v)`, or set `memory`."
        )
    push, stiffness = problem.memory.within(span, state.q, state.memory)

    def pushed(t, q, v):
        mass, force = problem.equations(t, q, v)
        return mass, force + push(q)

    held = problem.held
    if held is not None:
        bound = held.rates

        def pushed_bound(t, q, v):
            mass, force, rows = bound(t, q, v)
            return mass, force + push(q), rows

        held = held._replace(rates=pushed_bound)
    contact = problem.contact
    if contact is not None:
        free, plain = contact.free, contact.plain

        def pushed_free(t, q, v):
            mass, force, moment = free(t, q, v)
            return mass, force + push(q), moment

        contact = contact._replace(
            free=pushed_free, plain=lambda t, q, v: plain(t, q, v) + push(q)
        )
    return problem._replace(
        equations=pushed,
        stiffness=problem.stiffness + stiffness,
        contact=contact,
        held=held,
    )


def remembered(problem: SecondOrder, h, state: Kinematic, q: Array) -> Array | None:
    """The memory after a step of `h` [s] from `state` to `q`."""
    if problem.memory is None or state.memory is None:
        return None
    return problem.memory.after(h, state.q, q, state.memory)


def balance(problem: SecondOrder, t, q: Array, v: Array) -> tuple[Array, Array, Held | None]:
    """Mass matrix, force, and the equations that rates keep; None without any."""
    if problem.held is None:
        return *problem.equations(t, q, v), None
    return problem.held.rates(t, q, v)


def _guessed(problem: SecondOrder, a: Array) -> tuple[Array, Array | None]:
    """An acceleration, and room for the motions that reactions make."""
    if problem.held is None:
        return a, None
    return a, jnp.zeros((a.shape[0], problem.held.by.spare.shape[0]), a.dtype)


def _corrected(
    problem: SecondOrder, new: Array, matrix: Array, residual: Array, held: Held | None, rate
) -> tuple[Array, Array | None]:
    """An acceleration after a Newton pass, at which a rate keeps its equations, and the motions
    that reactions make. `rate` is that rate, and its derivative by the acceleration."""
    if held is None or problem.held is None:
        return new - solve_symmetric(matrix, residual), None
    value, slope = rate
    left = Held(held.rows, (held.rows @ value - held.wanted) / slope)
    found = solve_held(matrix, residual, left, problem.held.by)
    return new - found.x, found.pulled


class GeneralisedAlpha(AbstractStepper):
    """Generalised-alpha with approximate Newton passes: implicit, second order.

    Its cost is known beforehand. `math.ode.generalised_alpha`, for any y' = f(t, y), solves
    every step to a tolerance, with line search, and cuts steps that do not converge.

    Attributes:
        rho_inf: What an oscillation much faster than the step keeps of its size in one
            step: 1 keeps and 0 kills fast modes [-].
        passes: Newton passes per step; 2 are as good as 3 on soft rods.

    Reference:
        Chung and Hulbert, J. Appl. Mech. 60, 1993.
    """

    rho_inf: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    passes: int = eqx.field(static=True, default=2)
    settles: ClassVar[bool] = True

    def step(self, problem, t, h, state):
        rho = self.rho_inf
        am, af = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
        gamma = 1 / 2 + af - am
        beta = (gamma + 1 / 2) ** 2 / 4
        am = jnp.where(h == 0, 0.0, am)  # nothing of the acceleration before
        q, v, a = state[:3]
        leap = h * v + h * h * (1 / 2 - beta) * a
        surge = v + h * (1 - gamma) * a
        inner = within(problem, (1 - af) * h, state)

        def improve(_, run):
            new, _ = run
            middle_q = move(problem, q, (1 - af) * (leap + h * h * beta * new))
            middle_v = (1 - af) * (surge + h * gamma * new) + af * v
            mass, force, held = balance(inner, t + (1 - af) * h, middle_q, middle_v)
            implicit = gamma * h * inner.damping + beta * h**2 * inner.stiffness
            residual = mass @ ((1 - am) * new + am * a) - force
            matrix = (1 - am) * mass + (1 - af) * implicit
            rate = middle_v, (1 - af) * gamma * h
            return _corrected(inner, new, matrix, residual, held, rate)

        new, pulled = jax.lax.fori_loop(0, self.passes, improve, _guessed(problem, a))
        moved = move(problem, q, leap + h * h * beta * new)
        memory = remembered(problem, h, state, moved)
        end = Kinematic(moved, surge + h * gamma * new, new, memory=memory, share=state.share)
        return placed(problem, t + h, end, pulled)


class ImplicitMidpoint(AbstractStepper):
    """Implicit midpoint with approximate Newton passes: second order, time-reversible.

    Attributes:
        passes: Newton passes per step.
    """

    passes: int = eqx.field(static=True, default=2)
    settles: ClassVar[bool] = True

    def step(self, problem, t, h, state):
        q, v, a = state[:3]
        inner = within(problem, h / 2, state)

        def improve(_, run):
            new, _ = run
            half = v + h / 2 * new
            middle = move(problem, q, h / 2 * half)
            mass, force, held = balance(inner, t + h / 2, middle, half)
            implicit = mass + h / 2 * inner.damping + h**2 / 4 * inner.stiffness
            residual = mass @ new - force
            return _corrected(inner, new, implicit, residual, held, (half, h / 2))

        new, pulled = jax.lax.fori_loop(0, self.passes, improve, _guessed(problem, a))
        moved = move(problem, q, h * (v + h / 2 * new))
        memory = remembered(problem, h, state, moved)
        end = Kinematic(moved, v + h * new, new, memory=memory, share=state.share)
        return placed(problem, t + h, end, pulled)


class TripleJump(AbstractStepper):
    """Three implicit midpoint steps of h (1.35, -1.70, 1.35): order 4.

    Attributes:
        passes: Newton passes per midpoint step. Two suit damped rods; 3 keep order 4 where
            velocity-product forces lead, as in free flight.

    Reference:
        Yoshida, Construction of higher order symplectic integrators, Phys. Lett. A 150, 1990.
    """

    passes: int = eqx.field(static=True, default=2)
    settles: ClassVar[bool] = True

    def step(self, problem, t, h, state):
        if problem.memory is not None:
            raise ValueError(
                "TripleJump: got a force that remembers the motion, need none: a step goes "
                "back in time within, and a memory does not. Take ImplicitMidpoint()."
            )
        midpoint, outer = ImplicitMidpoint(self.passes), 1 / (2 - 2 ** (1 / 3))
        shares = h * jnp.array([outer, 1 - 2 * outer, outer], h.dtype)

        def jump(carry, share):
            t, state = carry
            return (t + share, midpoint.step(problem, t, share, state)), None

        (_, state), _ = jax.lax.scan(jump, (t, state), shares)
        return state


class AbstractExplicit(AbstractStepper):
    """Runge-Kutta methods of a `tableau`, which keep no acceleration. A memory is stepped as
    coordinates are: stable for steps below some 2.8 of its shortest time."""

    tableau: eqx.AbstractClassVar[Tableau]

    def begin(self, problem, t, q, v):
        return _still(problem, t, q, v)

    def step(self, problem, t, h, state):
        field, begun = vector_field(problem), (state.q, state.v, state.memory)
        q, v, memory = rolled_step(self.tableau, field, t, begun, h)
        if problem.retract is not None:
            q = problem.retract(q, jnp.zeros_like(v))  # back on the manifold
        end = Kinematic(q, v, state.a, memory=memory, share=state.share)
        return placed(problem, t + h, end)


class RungeKutta4(AbstractExplicit):
    """Classical explicit method of order 4; unstable beyond h omega = 2.8."""

    tableau: ClassVar[Tableau] = RK4


class DormandPrince(AbstractExplicit):
    """Explicit method of order 5, for undamped motion at high accuracy."""

    tableau: ClassVar[Tableau] = DORMAND_PRINCE


def move(problem: SecondOrder, q: Array, increment: Array) -> Array:
    """Coordinates after an increment of the rates' dimension."""
    return q + increment if problem.retract is None else problem.retract(q, increment)


def vector_field(problem: SecondOrder) -> Field:
    """(t, (q, v, memory)) -> their rates, for methods of first order; `memory` is None where
    no force has one."""

    def field(t, y):
        q, v, memory = y
        rate = v if problem.rate is None else problem.rate(q, v)
        if problem.memory is None:
            return rate, acceleration(problem, t, q, v), None
        force = problem.memory.force(q, memory)
        return rate, acceleration(problem, t, q, v, force), problem.memory.rate(q, memory)

    return field


def _still(problem: SecondOrder, t, q: Array, v: Array) -> Kinematic:
    """A state without acceleration."""
    memory = None if problem.memory is None else problem.memory.begin
    still = Kinematic(q, v, jnp.zeros_like(v), memory=memory)
    return placed(problem, t, still)


def integrate(
    stepper: AbstractStepper,
    problem: SecondOrder,
    q: Array,
    v: Array,
    *,
    t: Float[Array, ""],
    h: Float[Array, ""],
    saves: int,
    every: int,
    label: str | None = None,
    judged: bool = True,
) -> tuple[Kinematic, Bool[Array, ""]]:
    """The first state and those after each of `saves` runs of `every` steps, stacked, and
    whether the steps were too long, if that is to be `judged`; with a `label` tells how far
    it is, about a hundred times."""
    judged = judged and problem.contact is None  # whose steps balance their own energy
    rows = rows_between(saves, every, judged)
    short, count = every // rows, saves * rows
    plan, pause = passes(count, saves * every, judged), max(1, count // 100)
    idle = stepper.settles and count >= _WORTH_IDLING and problem.held is None

    def advance(run: Doubled, one_pass):
        number, part, first, length = one_pass
        begun = run.begin(part)

        def one(k, state):
            at = t + (first * short + k * length) * h
            return stepper.step(problem, at, length * h, state)

        new = jax.lax.fori_loop(0, short, one, begun) if short > 1 else one(0, begun)
        if label is not None:
            due = (part == 0) & ((number % pause == 0) | (number == count))
            jax.lax.cond(
                due, lambda k, label=label: tell(label, k / count), lambda _: None, number
            )
        return run.end(part, new), new

    made = (plan.row + 1, plan.part, plan.start.astype(h.dtype), plan.length.astype(h.dtype))
    if idle:
        # A run of steps of no length finds the first acceleration: equations written out a
        # second time before the loop would compile for almost as long as the loop.
        made = tuple(np.insert(column, 0, 0) for column in made)
        begin = _still(problem, t, q, v)
    else:
        begin = stepper.begin(problem, t, q, v)
    _, states = jax.lax.scan(advance, Doubled.at(begin), made)
    if idle:
        begin = jax.tree.map(lambda a: a[0], states)
        states = jax.tree.map(lambda a: a[1:], states)
    path = after_start(begin, whole_rows(plan, states))
    too_long = rows_too_long(plan, [path.q], [states.q])
    return jax.tree.map(lambda a: a[::rows], path), too_long


_WORTH_IDLING = 20  # rows that one more is at most five per cent of
