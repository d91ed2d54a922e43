"""The crawler in motion: runs, and its way per cycle."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import fem
from sorojax.robots import crawler_gait
from sorojax.units import kPa

FREQUENCY, DAMPING = 1.25, fem.Rayleigh(mass=1.0, stiffness=1e-3)
GAIT = crawler_gait(8 * kPa, FREQUENCY)


def run(
    problem: fem.Problem, duration: float, step: float, gait=None, **options
) -> fem.Trajectory:
    """The crawler on its floor from rest."""
    gait = GAIT if gait is None else gait
    return fem.simulate(problem, duration, step, damping=DAMPING, **options, **gait)


def moved(problem: fem.Problem, motion: fem.Trajectory) -> Float[Array, "times 2"]:
    """Displacement of the centre of mass [m]."""
    weights = fem.lumped_mass(problem)[::2]
    shares = weights / jnp.sum(weights)
    return jnp.einsum("n,tni->ti", shares, motion.displacements)


class Cycles(NamedTuple):
    """Way in each cycle [m], largest overlap [m] and steps that were cut."""

    ways: np.ndarray
    overlap: float
    cuts: int


def cycles(problem: fem.Problem, *motions: fem.Trajectory) -> Cycles:
    """Whole cycles of the gait in a motion from rest, and in those that go on from it."""
    x = np.concatenate([np.asarray(moved(problem, motion))[:, 0] for motion in motions])
    times = np.concatenate([np.asarray(motion.time) for motion in motions])
    count = round(float(times[-1]) * FREQUENCY)
    ends = np.interp(np.arange(count + 1) / FREQUENCY, times, x)
    floor = problem.loads[-1]
    assert isinstance(floor, fem.Contact)

    def lowest(u):
        return jnp.min(floor.points_of(problem, u)[..., 1])

    overlap = -min(
        float(jnp.min(jax.lax.map(lowest, motion.displacements))) for motion in motions
    )
    cuts = sum(motion.stats.cuts for motion in motions)
    return Cycles(np.diff(ends), max(0.0, overlap), cuts)
