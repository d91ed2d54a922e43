"""The passive walker in its gait: frequency, cost, contact stiffness, cells.

Times are CPU seconds on one core.
"""

import time
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import fem
from sorojax.robots import Walker, pair_angles, walker_problem
from sorojax.units import mm

SIZE, FINE, STEP, DURATION, DROP = 2.5 * mm, 0.9 * mm, 1e-3, 0.5, 3 * mm  # m, m, s, s, m
DAMPING = fem.KelvinVoigt(800.0)


def walk(problem: fem.Problem, step: float = STEP, **options: Any) -> fem.Motion:
    """From rest, a little above the slope."""
    rest = jnp.zeros_like(problem.mesh.points)
    start = rest.at[:, 1].set(DROP), rest
    return fem.simulate(problem, DURATION, step, start=start, damping=DAMPING, **options)


def frequencies(times: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Strongest frequency [Hz] above 8 Hz of every pair in the second half of a record."""
    waves = angles[len(times) // 2 :]
    waves = (waves - waves.mean(axis=0)) * np.hanning(len(waves))[:, None]
    at = np.fft.rfftfreq(64 * len(waves), float(times[1] - times[0]))
    power = np.abs(np.fft.rfft(waves, 64 * len(waves), axis=0))
    power[at < 8] = 0
    return at[power.argmax(axis=0)]


def rows():
    walker, base = Walker(), None
    problem = walker_problem(walker, size=SIZE)
    law: Any = problem.loads[-1]
    stiffer = eqx.tree_at(
        lambda p: (p.loads[-1].stiffness, p.loads[-1].friction_stiffness),
        problem, (2 * law.stiffness, 2 * law.friction_stiffness),
    )  # fmt: skip
    finer = walker_problem(walker, size=FINE)
    for name, case, step, bar in (
        ("as it is", problem, STEP, None),
        ("contact twice as stiff", stiffer, STEP, 0.02),
        ("finer cells", finer, STEP, 0.05),
    ):
        start = time.process_time()
        walk(case, step, max_steps=1, throw=False)
        ready = time.process_time()
        motion = walk(case, step)
        took = time.process_time() - ready
        angles = np.degrees(np.asarray(pair_angles(walker, case.mesh, motion.displacements)))
        found = frequencies(np.asarray(motion.times), angles)
        base = found.mean() if base is None else base
        weights = fem.lumped_mass(case)[::2]
        way = jnp.sum(weights * motion.displacements[-1, :, 0]) / jnp.sum(weights)
        settings = {
            "case": name,
            "dof": case.space.num_dofs,
            "frequency_Hz": np.round(found, 2).tolist(),
            "swing_deg": np.round(np.ptp(angles[len(angles) // 2 :], axis=0), 1).tolist(),
            "way_mm": round(float(way) / mm, 1),
            "steps": motion.stats.steps,
            "iterations": round(motion.stats.iterations / motion.stats.steps, 1),
            "cuts": motion.stats.cuts,
        }
        yield Row("sorojax", settings, ready - start, took, took, took,
                  float(abs(found.mean() / base - 1)), "frequency of the first row", bar,
                  "error")  # fmt: skip
