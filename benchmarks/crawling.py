"""The crawler in motion: runs, its way per cycle, and the arrays that felupe needs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import fem
from sorojax.fem.contact_area import areas_of
from sorojax.robots import crawler_gait
from sorojax.robots.crawler import PORTS
from sorojax.units import kPa

FREQUENCY, DAMPING = 1.25, fem.Rayleigh(mass=1.0, stiffness=1e-3)
GAIT = crawler_gait(8 * kPa, FREQUENCY)


def run(problem: fem.Problem, duration: float, step: float, gait=None, **options) -> fem.Motion:
    """The crawler on its floor from rest."""
    gait = GAIT if gait is None else gait
    return fem.simulate(problem, duration, step, damping=DAMPING, **options, **gait)


def moved(problem: fem.Problem, motion: fem.Motion) -> Float[Array, "times 2"]:
    """Displacement of the centre of mass [m]."""
    weights = fem.lumped_mass(problem)[::2]
    shares = weights / jnp.sum(weights)
    return jnp.einsum("n,tni->ti", shares, motion.displacements)


class Cycles(NamedTuple):
    """Way in each cycle [m], largest overlap [m] and steps that were cut."""

    ways: np.ndarray
    overlap: float
    cuts: int


def cycles(problem: fem.Problem, *motions: fem.Motion) -> Cycles:
    """Whole cycles of the gait in a motion from rest, and in those that go on from it."""
    x = np.concatenate([np.asarray(moved(problem, motion))[:, 0] for motion in motions])
    times = np.concatenate([np.asarray(motion.times) for motion in motions])
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


def felupe_arrays(problem: fem.Problem, steps: int, step: float) -> dict[str, np.ndarray]:
    """What `peers/felupe.py motion` asks for, of a crawler one metre deep."""
    cells, floor = problem.mesh, problem.loads[-1]
    assert isinstance(floor, fem.Contact)
    mass = fem.mass_matrix(problem)
    weight = np.asarray(fem.lumped_mass(problem)).copy()
    weight[::2], weight[1::2] = 0.0, -9.81 * weight[1::2]
    sole = np.zeros(cells.num_cells, int)
    sole[np.asarray(cells.regions["sole"])] = 1
    times = step * jnp.arange(steps + 1)
    pressures = [jax.vmap(GAIT[name])(times) for name in PORTS]
    air = {load.name: load.facets for load in problem.loads if isinstance(load, fem.Pressure)}
    first = [int(np.argmax(sole == k)) for k in (0, 1)]
    moduli = problem.material.shear_modulus, problem.material.bulk_modulus  # type: ignore
    return {
        "points": np.asarray(cells.points),
        "cells": np.asarray(cells.cells),
        "part": sole,
        "mu": np.asarray(moduli[0])[first],
        "bulk": np.asarray(moduli[1])[first],
        "rows": np.asarray(problem.space.system.rows),
        "cols": np.asarray(problem.space.system.cols),
        "mass": np.asarray(mass),
        "damping": np.asarray(DAMPING.matrix(problem, mass, jnp.zeros_like(cells.points))),
        "weight": weight,
        "pressures": np.stack([np.asarray(p) for p in pressures], axis=1),
        "touching": np.asarray(floor.facets),
        "areas": np.asarray(areas_of(problem, floor.facets)),
        **{f"edges_{k}": np.asarray(air[n])[:, [1, 0, 2]] for k, n in enumerate(PORTS)},
    }  # fmt: skip
