"""Assemblies with closures in motion: what holds them, coordinates that keep the loops closed,
and the reactions along a motion."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed, number, outcome
from sorojax._types import real
from sorojax.math.compiled import batched, jit_public
from sorojax.math.ode.held import Held, HeldTerms, accelerate, hold, solve_held
from sorojax.math.ode.steppers import Kinematic, SecondOrder
from sorojax.math.status import Status
from sorojax.rod.contact.terms import any_contact
from sorojax.rod.dynamics.closures import (
    closure_jacobian,
    closure_wrenches,
    held,
    held_rates,
    violations,
)
from sorojax.rod.forces.loads import Load, total_force
from sorojax.rod.model.assembly import Assembly, rest, retract
from sorojax.rod.model.closure import equations as equations_of, is_closed
from sorojax.rod.model.model import inertia, motion, operators

CLOSED = 1e-6  # [rad], [m]: a loop that is open by less is taken for closed at the start
_PASSES = 100
_SHORTEST = 1e-4  # of a pass
_ENOUGH = 1e-4  # of it, where the search has found them
_RIGID = 1e-9  # of the square of the highest frequency: joints without springs


def held_terms(
    model: Assembly,
    constants: Any,
    forces: tuple[Load, ...],
    t: Float[Array, ""],
    q: Float[Array, " coordinates"],
) -> HeldTerms:
    """The closures of a model as what holds it, from `q` at `t` on, where they hold."""

    once = functools.partial(jax.checkpoint, prevent_cse=False)  # as the open equations

    def balanced(t, q, v):
        moment = motion(model, q, v, constants=constants)
        mass, coriolis = inertia(moment)
        return moment, mass, total_force(forces, t, moment) - coriolis

    @once
    def accelerations(t, q, v):
        moment, mass, force = balanced(t, q, v)
        return mass, force, held(moment, t)

    @once
    def rates(t, q, v):
        moment, mass, force = balanced(t, q, v)
        return mass, force, held_rates(moment, t)[1]

    @once
    def place(t, q):
        return held_rates(motion(model, q, constants=constants), t)

    def gap(t, q):
        return violations(motion(model, q, constants=constants), t)

    moment = motion(model, q, constants=constants)
    near = jnp.linalg.inv(inertia(moment)[0])
    rows = closure_jacobian(moment, t)
    by = hold(rows @ near @ rows.T)
    return HeldTerms(accelerations, rates, place, gap, by, near)


def reactions_along(
    model: Assembly, problem: SecondOrder, time: Array, path: Kinematic
) -> tuple[dict[str, Float[Array, "time twist"]], Float[Array, ""]]:
    """Wrenches of the closures at every state of a path, and their largest violation."""
    terms, constants = problem.held, operators(model)
    assert terms is not None

    def one(t, q, v, memory):
        mass, force, rows = terms.accelerations(t, q, v)
        if problem.memory is not None:
            force = force + problem.memory.force(q, memory)
        reactions = solve_held(mass, force, rows, terms.by).reactions
        moment = motion(model, q, constants=constants)
        off = jnp.max(jnp.abs(violations(moment, t)))
        return closure_wrenches(moment, t, reactions), off

    found, off = batched(one)(time, path.q, path.v, path.memory)
    return found, jnp.max(off)


def refuse_contact(where: str, forces: tuple[Load, ...]) -> None:
    """Contact is not solved together with closures."""
    if any_contact(forces):
        raise ValueError(
            f"{where}: got contact on a model with closures, need one of both: contact steps "
            "do not solve for reactions. Leave the contact out, or replace the closures by "
            "stiff springs (PairForce)."
        )


def refuse_open(where: str, model: Assembly, q: Any, t: Any) -> None:
    """Coordinates, if known, that do not keep the closures."""
    leaves = jax.tree.leaves(eqx.filter((model, q, t), eqx.is_array))
    if not all(_check.is_concrete(leaf) for leaf in leaves):
        return
    gap = jnp.abs(gaps(model, real(q), real(t)))
    worst = [float(jnp.max(gap[at])) for at in equations_of(model)]
    k = max(range(len(worst)), key=worst.__getitem__)
    if not worst[k] <= CLOSED:
        raise ValueError(
            f"{where}: closure `{model.loops[k]}` is open by {worst[k]:.2g} rad or m, need "
            f"{CLOSED:g} or less. Close the loops first: q = rod.close_loops(model, "
            "q).q, or take those of rod.equilibrium."
        )


@jit_public
def gaps(model: Assembly, q: Float[Array, " coordinates"], t) -> Float[Array, " equations"]:
    """Violations of the closures."""
    return violations(motion(model, q), t)


# Coordinates that keep the closures


@displayed
class Closed(eqx.Module):
    """Coordinates `q` that keep the closures, `gap`, how far they are from it [rad], [m], and
    `status`, how the search ended."""

    q: Float[Array, " coordinates"]
    gap: Float[Array, ""]
    status: Status

    def _text(self) -> str:
        return f"Closed: {outcome(self.status)}\n  q {number(self.q)}, gap {number(self.gap)}"


class _Search(NamedTuple):
    q: Array
    size: Array
    share: Array
    count: Array


@jit_public
def close_loops(
    model: Assembly, q: Float[Array, " coordinates"] | None = None, *, t=0.0
) -> Closed:
    """Coordinates near a guess that keep the closures: the loops of an assembly closed.

    Newton's method on g(q, t) = 0 with the step of least size in a metric of inertia and
    elastic stiffness, shortened until the violation falls; so rods bend rather than stretch.
    The derivative is that of such a step at the answer: what the closures determine changes
    as they do, what they leave free by the least, and not as the search would go elsewhere.

    Args:
        model: An assembly with closures.
        q: The guess; coordinates at rest if omitted. Another guess may close the loops in
            another way, as an elbow up or down.
        t: Time [s], which driven ends depend on.

    Returns:
        Coordinates, their violation, and the status: `not_converged` where the loops do not
        close from there. Nothing is raised.

    Raises:
        ValueError: If the model has no closures.

    Example:
        >>> bar = rod.Link(0.1, 1e-5)
        >>> along = lambda x: sj.math.lie.homogeneous(jnp.eye(2), jnp.array([x, 0.0]))
        >>> arm = rod.assembly(SE2(), first=rod.Part(bar, rod.Revolute()), second=rod.Part(
        ...     bar, rod.Revolute(), on="first", offset=along(0.1)))
        >>> loop = rod.with_closures(arm, end=rod.Closure(
        ...     "second", rod.Spherical(), offset=along(0.15), frame=along(0.1)))
        >>> found = rod.close_loops(loop, jnp.array([0.5, -1.0]))
        >>> print(jnp.degrees(found.q).round(2))  # a triangle of sides 10, 10 and 15 cm
        [ 41.41 -82.82]

    Reference:
        Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems, 1989, chapter 4,
        for the assembly of loops.
    """
    if not is_closed(model):
        raise ValueError(
            "close_loops: got a model without closures, need one or more. Add them by "
            "rod.with_closures."
        )
    guess = rest(model) if q is None else q
    t = jnp.asarray(t, guess.dtype)
    fixed = jax.tree.map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, (model, t, guess)
    )
    found = jax.lax.stop_gradient(_search(*fixed))
    # in zero steps from the answer, whose derivative is that of the last Newton step
    q, size = _newton(model, t, found + guess - fixed[2])
    size = jax.lax.stop_gradient(size)
    fine = size <= _ENOUGH * CLOSED
    status = Status.where(fine, Status.successful, Status.not_converged)
    status = Status.where(jnp.all(jnp.isfinite(q)), status, Status.not_finite)
    return Closed(q, jnp.max(jnp.abs(gaps(model, q, t))), status)


def _search(model: Assembly, t: Array, guess: Array) -> Array:
    """Newton's method with steps that are shortened."""

    def size_of(q):
        return jnp.linalg.norm(gaps(model, q, t))

    def one(now: _Search) -> _Search:
        trial = retract(model, now.q, now.share * _step(model, t, now.q))
        size = size_of(trial)
        better = size < now.size
        taken = _Search(trial, size, jnp.minimum(1.0, 4 * now.share), now.count + 1)
        shorter = now._replace(share=now.share / 4, count=now.count + 1)
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), taken, shorter)

    def going(now: _Search) -> Array:
        return (now.size > 0) & (now.share > _SHORTEST) & (now.count < _PASSES)

    one_, none = jnp.ones((), guess.dtype), jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(going, one, _Search(guess, size_of(guess), one_, none)).q


def _step(model: Assembly, t: Array, q: Array) -> Float[Array, " dof"]:
    """The least change of coordinates that closes the loops to first order."""
    moment = motion(model, q)
    rows = closure_jacobian(moment, t)
    metric = _metric(inertia(moment)[0], moment.operators.stiffness)
    wanted = Held(rows, -violations(moment, t))
    return accelerate(metric, jnp.zeros(rows.shape[1], q.dtype), wanted).x


def _newton(model: Assembly, t: Array, q: Array) -> tuple[Array, Array]:
    q = retract(model, q, _step(model, t, q))
    return q, jnp.linalg.norm(gaps(model, q, t))


def _metric(mass: Array, stiffness: Array) -> Array:
    """Inertia and the stiffness that is like it in the softest mode."""
    half = jnp.linalg.inv(jnp.linalg.cholesky(jax.lax.stop_gradient(mass)))
    squares = jnp.linalg.eigvalsh(half @ jax.lax.stop_gradient(stiffness) @ half.T)
    elastic = squares > _RIGID * squares[-1]
    softest = jnp.min(jnp.where(elastic, squares, jnp.inf))
    return mass + stiffness / softest
