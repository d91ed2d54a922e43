"""Statics with contact in several solves: friction from one to the next, no overlap."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._jax.jit import once
from sorojax._jax.trace_state import is_traced
from sorojax._progress import report
from sorojax.contact.facet import Contacts
from sorojax.fem.assembly.space import space
from sorojax.fem.contact.obstacle import Contact
from sorojax.fem.contact.self_contact import SelfContact, with_partners
from sorojax.fem.equilibrium.solve import ConvergenceError, Solution, solve
from sorojax.fem.loads import checks as checks_loads
from sorojax.fem.problem import Problem
from sorojax.math.status import Status

Touching = Contact | SelfContact


def update_friction(problem: Problem, u: Float[Array, "nodes dim"]) -> Problem:
    """`problem` after the equilibrium `u` [m], with friction that knows of it.

    Friction of the next `solve` is taken at the pressures of `u`, and pulls towards where
    points stood there. Move loads and obstacles in small steps in between:

        for force in forces:
            pulled = fem.with_load(problem, "pull", force)
            u = fem.solve(pulled, start=u).displacement
            problem = fem.update_friction(pulled, u)

    A rod that slips in the solid (`BondedRod`) remembers how far. Differentiable; loads
    without memory stay as they are.

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].

    Returns:
        The problem of the next step.
    """
    bare = dataclasses.replace(problem, supports=(), loads=())

    loads = tuple(load.remembered(bare, u) for load in problem.loads)
    return eqx.tree_at(lambda p: p.loads, problem, loads)


def solve_contact(
    problem: Problem,
    *,
    penetration: float | Float[Array, ""],
    max_updates: int = 10,
    throw: bool = True,
    **options: Any,
) -> Solution:
    """Static equilibrium in which no point of a contact overlaps by more than `penetration`.

    Self-contacts list their pairs anew before each solve. After it the pressure of every
    point is moved into the `offset` of its contact, so that the next one needs less overlap
    to carry it: the augmented Lagrangian, whose answer does not depend on the stiffness. The
    problem of the solution holds the offsets.

    Args:
        problem: What to solve.
        penetration: Largest overlap allowed [m].
        max_updates: How many more solves to spend.
        throw: Raise when the overlap stays larger, otherwise report it in `status`. Inside
            a trace all updates are made and nothing is raised.
        **options: Of `solve`.

    Returns:
        Displacement and status of the last solve; its problem holds the offsets.

    Raises:
        ConvergenceError: If `throw` and a solve failed or the overlap stayed larger.

    Reference:
        Simo, Laursen, An augmented Lagrangian treatment of contact problems involving
        friction, Computers & Structures 42, 1992.
    """
    solution = solve(problem, throw=throw, **options)
    options.pop("start", None)
    found = overlap(solution.problem, solution.displacement)
    traced = is_traced((found, jnp.zeros(())))
    for k in range(max_updates):
        if not traced and (found <= penetration or bool(solution.status != Status.successful)):
            return solution
        lifted = _lifted(solution.problem, solution.displacement)
        lifted = lifted if traced else update_contact_pairs(lifted, solution.displacement)
        solution = solve(lifted, start=solution.displacement, throw=throw, **options)
        found = overlap(solution.problem, solution.displacement)
        if not traced:
            report("contact", k + 1, max_updates, overlap=float(found))
    return _judged(solution, found, penetration, throw and not traced)


def overlap(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
    """Largest penetration of all contacts at displacement `u` [m].

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].

    Returns:
        The depth [m]; zero where nothing touches.
    """
    loads = [load for load in problem.loads if isinstance(load, Touching)]
    if not loads:
        raise ValueError(
            "fem.overlap: the problem has no contact, need one. Add fem.Contact to its loads."
        )
    return jnp.max(jnp.stack([_state(load, problem, u).penetration for load in loads]))


def contact_state(
    problem: Problem, u: Float[Array, "nodes dim"], name: str = "contact"
) -> Contacts:
    """Gap, pressure, normal and force at the quadrature points of the contact `name`.

    `.total` is the force of the obstacle on the body [N], friction included, `.active` the
    points that touch, `.torque(about)` and `.power(velocity)` [W] that of the forces. In a
    self-contact the points of both sides are listed and their forces balance.

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].
        name: Of the contact.

    Returns:
        What the contact does at each quadrature point, and in all.
    """
    loads = [load for load in problem.loads if load.name == name]
    if not loads or not isinstance(loads[0], Touching):
        names = [load.name for load in problem.loads if isinstance(load, Touching)]
        raise ValueError(f"fem.contact_state: got name {name!r}, need one of {names}.")
    return _state(loads[0], problem, u)


@once
def _state(load: Touching, problem: Problem, u: Float[Array, "nodes dim"]) -> Contacts:
    return load.state(problem, u)


def update_contact_pairs(problem: Problem, u: Float[Array, "nodes dim"]) -> Problem:
    """`problem` whose self-contacts list the facets that are near each other at `u` [m].

    The sparse pattern, and with it the analysis of the solver, stays as long as it has room
    for the new pairs; where no list changes the problem itself is returned. Lists depend on
    concrete positions: call it outside `jit` and `grad`.

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].

    Returns:
        The problem with its new lists, or `problem` itself.

    Raises:
        ValueError: If positions are traced.
    """
    if is_traced((problem, u)):
        raise ValueError(
            "fem.update_contact_pairs: got traced positions, need concrete ones. Call it "
            "between solves, outside jit, grad and vmap."
        )
    loads = tuple(
        with_partners(load, problem.mesh, np.asarray(u))
        if isinstance(load, SelfContact)
        else load
        for load in problem.loads
    )
    if all(_same(a, b) for a, b in zip(loads, problem.loads, strict=True)):
        return problem
    made = dataclasses.replace(problem, loads=loads)
    try:
        checks_loads.room(problem.space, loads)
    except ValueError:
        wide = [_wide(load, problem.mesh, np.asarray(u)) for load in loads]
        room = (*loads, *problem.loads, *(load for load in wide if load is not None))
        made = dataclasses.replace(made, space=space(problem.mesh, room))
    return made


def _wide(load, mesh, u: np.ndarray) -> SelfContact | None:
    """The load with longer lists, so that a pattern serves for some time."""
    if not isinstance(load, SelfContact) or load.reach is None:
        return None
    count = 3 * (load.candidates or 1)
    return with_partners(
        dataclasses.replace(load, reach=2 * load.reach, candidates=count), mesh, u
    )


def _same(new, old) -> bool:
    if not isinstance(new, SelfContact):
        return True
    pairs = (new.partners, old.partners), (new.real, old.real)
    return all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)


def _lifted(problem: Problem, u) -> Problem:
    def lifted(load):
        if not isinstance(load, Touching):
            return load
        gap = _state(load, problem, u).gap.reshape(len(load.rows()), -1)
        before = jnp.zeros_like(gap) if load.offset is None else load.offset
        offset = jnp.maximum(before - gap, jnp.zeros_like(gap))
        return dataclasses.replace(load, offset=offset)

    return eqx.tree_at(lambda p: p.loads, problem, tuple(map(lifted, problem.loads)))


def _judged(solution: Solution, found, penetration, throw: bool) -> Solution:
    solved = solution.status == Status.successful
    status = Status.where(
        solved & (found <= penetration), Status.successful, Status.not_converged
    )
    solution = dataclasses.replace(solution, status=status)
    if throw and not bool(jax.numpy.all(found <= penetration)):
        raise ConvergenceError(
            f"fem.solve_contact: an overlap of {float(found):.3g} m is left, need "
            f"{float(penetration):.3g} m. Raise max_updates or the stiffness of the contact.",
            solution,
        )
    return solution
