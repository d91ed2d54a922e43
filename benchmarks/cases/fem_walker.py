"""The passive walker in its gait: frequency, cost, contact stiffness, cells; its first steps
against felupe.

Times are CPU seconds on one core.
"""

import time
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from benchmarks.on_a_floor import against_felupe
from sorojax import fem, mesh
from sorojax.robots import Walker, gait, pair_angles, walker_problem
from sorojax.units import mm

SIZE, STEP, DURATION, DROP = 2.5 * mm, 1e-3, 0.5, 3 * mm  # m, s, s, m
# Legs and spine are so thin that cells are as small as they are, not as they are asked for:
# these make cells of half the side.
FINE = 0.6 * mm
DAMPING = fem.KelvinVoigt(800.0)
# The original's step, and for felupe damping by a matrix that does not turn with the legs.
PEER_STEP, PEER_STEPS, PLAIN = 1e-3 / 3, 90, fem.Rayleigh(stiffness=2e-3)


def walk(problem: fem.Problem, step: float = STEP, **options: Any) -> fem.Trajectory:
    """From rest, a little above the slope."""
    rest = jnp.zeros_like(problem.mesh.points)
    start = rest.at[:, 1].set(DROP), rest
    return fem.simulate(problem, DURATION, step, start=start, damping=DAMPING, **options)


def side(cells: mesh.Mesh) -> float:
    """Of an equilateral triangle as large as the cells are in the mean [m]."""
    corners = np.asarray(cells.points)[np.asarray(cells.cells)[:, :3]]
    (ax, ay), (bx, by) = (corners[:, k].T - corners[:, 0].T for k in (1, 2))
    return float(np.sqrt(np.mean(np.abs(ax * by - ay * bx)) * 2 / np.sqrt(3)))


def plain(problem: fem.Problem) -> fem.Problem:
    """The same on quadratic triangles without the bubble and the pressures of their own,
    which felupe lacks."""
    cells = problem.mesh
    corners = np.asarray(cells.cells)[:, :6]
    bare = mesh.Mesh(cells.points[: corners.max() + 1], corners, mesh.Tri6())
    return fem.problem(
        bare,
        problem.material,
        kinematics=problem.kinematics,
        supports=(),
        loads=problem.loads,
        free=True,
    )


def fall(problem: fem.Problem, duration: float, step: float, **options: Any) -> fem.Trajectory:
    """From rest, with all feet on the slope."""
    return fem.simulate(problem, duration, step, damping=PLAIN, **options)


def rows():
    walker, base = Walker(), None
    deep = plain(walker_problem(walker, size=SIZE, depth=1.0))
    yield from against_felupe(fall, deep, PLAIN, PEER_STEPS, PEER_STEP, {}, "Tri6")
    problem = walker_problem(walker, size=SIZE)
    law: Any = problem.loads[-1]
    stiffer = eqx.tree_at(
        lambda p: (p.loads[-1].stiffness, p.loads[-1].friction_stiffness),
        problem,
        (2 * law.stiffness, 2 * law.friction_stiffness),
    )
    finer = walker_problem(walker, size=FINE)
    for name, case, step, bar in (
        ("as it is", problem, STEP, None),
        ("contact twice as stiff", stiffer, STEP, 0.02),
        ("cells half as large", finer, STEP, 0.05),
    ):
        start = time.process_time()
        walk(case, step, max_steps=1, throw=False)
        ready = time.process_time()
        motion = walk(case, step)
        took = time.process_time() - ready
        angles = np.asarray(pair_angles(walker, case.mesh, motion.displacements))
        walked = gait(np.asarray(motion.time), angles)
        found, late = walked.frequencies, angles[len(angles) // 2 :]
        base = found.mean() if base is None else base
        weights = fem.lumped_mass(case)[::2]
        way = jnp.sum(weights * motion.displacements[-1, :, 0]) / jnp.sum(weights)
        settings = {
            "case": name,
            "dof": case.space.num_dofs,
            "cells": case.mesh.num_cells,
            "side_mm": round(side(case.mesh) / mm, 3),
            "frequency_Hz": np.round(found, 2).tolist(),
            "swing_deg": np.round(np.degrees(np.ptp(late, axis=0)), 1).tolist(),
            "repeats": round(walked.repeats, 3),
            "way_mm": round(float(way) / mm, 1),
            "steps": motion.stats.steps,
            "iterations": round(motion.stats.iterations / motion.stats.steps, 1),
            "cuts": motion.stats.cuts,
        }
        yield Row(
            "sorojax",
            settings,
            ready - start,
            took,
            took,
            took,
            float(abs(found.mean() / base - 1)),
            "frequency of the first row",
            bar,
            "error",
        )
