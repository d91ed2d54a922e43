"""A motion: states on a grid of times, with its energies."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sorojax._display import displayed, number, outcome
from sorojax._jax.jit import once
from sorojax._jax.trace_state import is_traced
from sorojax.fem.dynamics.damping import nodal_mass
from sorojax.fem.dynamics.masses import kinetic_energy, moving_nodes, with_masses
from sorojax.fem.dynamics.newton import has_lists, lists_of, with_lists
from sorojax.fem.dynamics.step import Dynamics, State, loads_at, matter
from sorojax.fem.problem import Problem, body, exchanged
from sorojax.fem.relaxation import stored_energy
from sorojax.math.linalg import sparse
from sorojax.math.status import Status


class Energies(eqx.Module):
    """Energies [J] at the saved times.

    `loads` is the potential of the loads with the values of the instant; `work` is what
    loads and moving supports gave since the start, `dissipated` what damping, the branches
    of a viscoelastic material and softening took.
    """

    kinetic: Float[Array, " times"]
    elastic: Float[Array, " times"]
    loads: Float[Array, " times"]
    work: Float[Array, " times"]
    dissipated: Float[Array, " times"]

    @property
    def balance(self) -> Float[Array, " times"]:
        """Kinetic and elastic energy minus what was given and taken [J]: constant but for
        the error in time and what the method damps."""
        return self.kinetic + self.elastic + self.dissipated - self.work


@displayed
class Trajectory(eqx.Module):
    """States of a body in motion, and how the run ended.

    Outside a trace a run that stops early is cut there; inside one it keeps its length and is
    NaN from there on. `states` are the saved ones in one `State`, whose arrays have the times
    as first axis, and `status` says how the run ended. `dynamics` is what the motion depends
    on: problem, damping, method and loads in time. `end` is the last state reached, to go on
    from; `points` are the saved points of the grid of steps. `steps` were accepted, `cuts` were
    halved, in Newton `iterations`. `stats` is kept on the host and `None` inside a trace.
    """

    dynamics: Dynamics
    states: State
    points: Int[Array, " times"]
    end: State
    status: Status
    steps: Int[Array, ""]
    iterations: Int[Array, ""]
    cuts: Int[Array, ""]
    stats: Any = eqx.field(static=True)  # MotionStats, None in a trace

    def __len__(self) -> int:
        return self.points.shape[0]

    @property
    def problem(self) -> Problem:
        return self.dynamics.problem

    @property
    def time(self) -> Float[Array, " times"]:
        """Saved times [s]."""
        return self.states.time

    @property
    def displacements(self) -> Float[Array, "times nodes dim"]:
        """Displacements [m]."""
        return self.states.displacement

    @property
    def velocities(self) -> Float[Array, "times nodes dim"]:
        """Velocities [m/s]."""
        return self.states.velocity

    @property
    def accelerations(self) -> Float[Array, "times nodes dim"]:
        """Accelerations of the method [m/s^2], of lower order than the velocities."""
        return self.states.acceleration

    @property
    def energies(self) -> Energies:
        """Energies at the saved times, computed when asked for."""
        problem, lists = self.problem, None
        if has_lists(problem) and not is_traced((problem, self.displacements)):
            lists = lists_of(problem, self.displacements)
        return _energies(self.dynamics, self.states, self.points, lists)

    def _text(self) -> str:
        u = self.displacements
        largest = number(jnp.max(jnp.sqrt(jnp.sum(u**2, axis=-1))), "m") if u.size else "none"
        return (
            f"Trajectory: {len(self)} saved states, {outcome(self.status)}, largest "
            f"displacement {largest}\n  time {number(self.time, 's')}"
        )


@once
def _energies(dynamics: Dynamics, states: State, points, lists) -> Energies:
    problem, known = dynamics.problem, matter(dynamics)
    moving, rest = eqx.partition(states, eqx.is_inexact_array)

    def one(row) -> Energies:
        state, index = eqx.combine(row[0], rest), row[1]
        u, v = state.displacement, state.velocity.ravel()
        loads = loads_at(dynamics, state, lambda row: row[index])
        loads = loads if lists is None else with_lists(loads, row[2])
        loaded = exchanged(body(problem), loads=loads)
        own = 0.5 * jnp.sum(v * sparse.product(problem.space.system, known.mass, v))
        return Energies(
            own + kinetic_energy(problem, u, state.velocity),
            stored_energy(body(problem), known.moduli, state.strains, u, state.peaks),
            sum((load.stored(loaded, u) for load in loads), start=jnp.zeros((), u.dtype)),
            state.work,
            state.dissipated,
        )

    return jax.lax.map(one, (moving, points, lists))


def momentum(
    motion: Trajectory,
) -> tuple[Float[Array, "times dim"], Float[Array, "times turns"]]:
    """Linear momentum [N s] and angular momentum about the origin [N m s] at every saved
    time, one component in the plane and three in space, with the consistent mass.

    Args:
        motion: A motion, from `simulate`.

    Returns:
        Linear, then angular momentum.
    """
    problem, share = motion.problem, moving_nodes(motion.problem)
    nodal = nodal_mass(problem)

    def one(u, v):
        mass = with_masses(problem, u, nodal)
        p = sparse.product(problem.space.system, mass, v.ravel()).reshape(v.shape)
        p = share[:, None] * p
        x = problem.mesh.points + u
        turns = x[:, 0] * p[:, 1] - x[:, 1] * p[:, 0] if x.shape[1] == 2 else jnp.cross(x, p)
        return jnp.sum(p, axis=0), jnp.atleast_1d(jnp.sum(turns, axis=0))

    return jax.vmap(one)(motion.displacements, motion.velocities)
