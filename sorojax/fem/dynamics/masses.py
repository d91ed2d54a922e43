"""Masses whose places y are functions of the displacements of some nodes: those of a rod that
stands on a patch of the solid.

Their kinetic energy is the sum of w |y'|^2 / 2 with constant weights w. A method treats y as it
does the places of nodes, so that in a step their inertia is the potential

    c |y(x) - y_n|_w^2 / 2 - drive . w (y(x) - y_n)

of the positions x where forces act: its slope is J' w y'' with J = dy/dx, by d'Alembert's
principle, centrifugal and Coriolis forces included, and the tangent stays symmetric.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax.fem.equilibrium.jit import group_slots

if TYPE_CHECKING:
    from sorojax.fem.dynamics.step import StepState
    from sorojax.fem.problem import Problem


class Masses(NamedTuple):
    """Masses that move with a group of nodes.

    Attributes:
        nodes: The group.
        places: (positions of the group [m]) -> y, places [m] or directions [-].
        weights: Mass [kg], or rotary inertia [kg m^2], of each entry of y.
        coordinates: Nodes of the group whose displacements are no places but other numbers.
    """

    nodes: Int[Array, " nodes"]
    places: Callable[[Float[Array, "nodes dim"]], Float[Array, " places"]]
    weights: Float[Array, " places"]
    coordinates: Int[Array, " inner"]


class MassMotion(eqx.Module):
    """What masses remember of the last step of a motion, and their inertia in it.

    Attributes:
        before: Positions of the nodes when it began [m].
        places, rates, bends: y and its first two derivatives then, as the method has them.
        step: Its size [s]; zero if there was none.
        stiffness: c [1/s^2].
        drive: Acceleration that the state before brings along [m/s^2].
    """

    before: Float[Array, "nodes dim"]
    places: Float[Array, " places"]
    rates: Float[Array, " places"]
    bends: Float[Array, " places"]
    step: Float[Array, ""]
    stiffness: Float[Array, ""]
    drive: Float[Array, " places"]


def no_motion(masses: Masses, points: Float[Array, "nodes dim"]) -> MassMotion:
    """Before the first step."""
    still, none = jnp.zeros_like(masses.weights), jnp.zeros((), points.dtype)
    return MassMotion(points[masses.nodes], still, still, still, none, none, still)


def begun_motion(
    masses: Masses, past: MassMotion, problem: "Problem", step: "StepState"
) -> MassMotion:
    """The inertia of masses in a step, as generalised-alpha and Newmark have it."""
    c, h = step.scheme, step.step
    assert c is not None and step.a is not None
    before = (problem.mesh.points + step.u)[masses.nodes]
    first = _derivatives(masses, before, step.v[masses.nodes], step.a[masses.nodes])
    later = _ended(masses, past, before, c)
    places, rates, bends = (
        jnp.where(past.step > 0, a, b) for a, b in zip(later, first, strict=True)
    )
    stiffness = (1 - c.am) / (c.beta * h**2 * (1 - c.af))
    drive = (1 - c.am) * (rates / (c.beta * h) + (1 / (2 * c.beta) - 1) * bends) - c.am * bends
    return MassMotion(before, places, rates, bends, h, stiffness, drive)


def _ended(masses: Masses, past: MassMotion, now, c) -> tuple[Array, Array, Array]:
    """y and its derivatives after a step whose end is at `now` [m]."""
    h = jnp.where(past.step > 0, past.step, jnp.ones_like(past.step))
    acted = masses.places((1 - c.af) * now + c.af * past.before)
    move = (acted - past.places) / (1 - c.af)
    bends = (move - h * past.rates) / (c.beta * h**2) - (1 / (2 * c.beta) - 1) * past.bends
    rates = past.rates + h * ((1 - c.gamma) * past.bends + c.gamma * bends)
    return past.places + move, rates, bends


def _derivatives(masses: Masses, x, v, a) -> tuple[Array, Array, Array]:
    """y and its derivatives at positions, velocities and accelerations of the nodes."""

    def rate(x, v):
        return jax.jvp(masses.places, (x,), (v,))

    (places, rates), (_, bends) = jax.jvp(rate, (x, v), (v, a))
    return places, rates, bends


def inertia_energy(
    masses: Masses, motion: MassMotion, x: Float[Array, "nodes dim"]
) -> Float[Array, ""]:
    """The potential of inertia in a step [J] at positions `x` [m] where forces act."""
    move = masses.places(x) - motion.places
    pulled = motion.stiffness / 2 * move - motion.drive
    return jnp.sum(masses.weights * pulled * move)


# What the masses of the loads of a problem are at an instant


def masses_of(problem: "Problem") -> list[Masses]:
    found = [load.masses(problem) for load in problem.loads]
    return [masses for masses in found if masses is not None]


def with_masses(
    problem: "Problem", u: Float[Array, "nodes dim"], values: Float[Array, " nnz"]
) -> Float[Array, " nnz"]:
    """The mass matrix `values` with J' w J of the masses at displacement `u` [m]."""
    system, dim = problem.space.system, u.shape[1]
    for masses in masses_of(problem):
        x = (problem.mesh.points + u)[masses.nodes]
        slope = jax.jacfwd(masses.places)(x).reshape(-1, x.size)
        full = slope.T @ (masses.weights[:, None] * slope)
        upper = full[np.triu_indices(x.size)]
        values = values.at[group_slots(system, masses.nodes[None], dim)[0]].add(upper)
    return values


def kinetic_energy(
    problem: "Problem", u: Float[Array, "nodes dim"], v: Float[Array, "nodes dim"]
) -> Float[Array, ""]:
    """Of the masses of the loads [J]."""
    energy = jnp.zeros((), u.dtype)
    for masses in masses_of(problem):
        x = (problem.mesh.points + u)[masses.nodes]
        rates = jax.jvp(masses.places, (x,), (v[masses.nodes],))[1]
        energy = energy + jnp.sum(masses.weights * rates**2) / 2
    return energy


def moving_nodes(problem: "Problem") -> Float[Array, " nodes"]:
    """One for each node that has a place, zero for those that hold other numbers."""
    share = jnp.ones(problem.mesh.num_nodes, problem.mesh.points.dtype)
    for masses in masses_of(problem):
        share = share.at[masses.coordinates].set(0.0)
    return share


def swing_force(
    problem: "Problem", u: Float[Array, "nodes dim"], v: Float[Array, "nodes dim"]
) -> Float[Array, "nodes dim"]:
    """J' w y'' of nodes without acceleration [N]: centrifugal and Coriolis forces of the
    masses, on the left of the equations of motion."""
    force = jnp.zeros_like(u)
    for masses in masses_of(problem):
        x, rate = (problem.mesh.points + u)[masses.nodes], v[masses.nodes]
        bends = _derivatives(masses, x, rate, jnp.zeros_like(x))[2]
        _, pull = jax.vjp(masses.places, x)
        force = force.at[masses.nodes].add(pull(masses.weights * bends)[0])
    return force
