"""The multigait crawler: cost of a second, gait, independence, derivatives, against felupe.

Times are CPU seconds on one core.
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.crawling import DAMPING, FREQUENCY, GAIT, cycles, moved, run
from benchmarks.harness import Row, Timing
from benchmarks.on_a_floor import against_felupe, timed
from sorojax import fem
from sorojax.robots import Crawler, crawler_gait, crawler_problem
from sorojax.units import kPa, mm

SIZE, STEP = 1.5 * mm, 2e-3
PEER_STEPS, GRADIENT_STEPS = 100, 6


def rows():
    problem = crawler_problem(Crawler(), size=SIZE)
    timing, second = timed(run, problem, 1.0, STEP)
    yield _second(problem, STEP, timing, second)
    yield _second(problem, STEP / 2, *timed(run, problem, 1.0, STEP / 2, save=2))
    flat = crawler_problem(Crawler(), size=SIZE, depth=1.0)
    yield from against_felupe(run, flat, DAMPING, PEER_STEPS, STEP, GAIT, "Quad8")
    yield from _changes(problem, second)
    yield _slopes()


def _second(problem, step, timing: Timing, motion: fem.Trajectory) -> Row:
    """One second of motion."""
    stats, took = motion.stats, timing.runs[0]
    settings = {
        "dof": problem.space.num_dofs,
        "step_ms": 1e3 * step,
        "ms_per_step": round(1e3 * took / stats.steps, 2),
        "iterations": round(stats.iterations / stats.steps, 2),
        "factorisations": round(stats.factorisations / stats.steps, 2),
        "cuts": stats.cuts,
    }
    return Row("sorojax", settings, **timing.columns(), bar=60.0)


def _changes(problem, second: fem.Trajectory):
    """Way of a cycle under other numbers; other cells by their first cycle."""
    law: Any = problem.loads[-1]
    stiffer = eqx.tree_at(
        lambda p: (p.loads[-1].stiffness, p.loads[-1].friction_stiffness),
        problem,
        (2 * law.stiffness, 2 * law.friction_stiffness),
    )
    rest = run(problem, 2 / FREQUENCY - 1.0, STEP, start=second)
    base = cycles(problem, second, rest)
    yield Row(
        "sorojax",
        _told("as it is", problem, base),
        reference="no bar: what others are compared with",
    )
    halved = crawler_problem(Crawler(), size=SIZE / 2, across=2)
    coarse = crawler_problem(Crawler(), size=2 * SIZE)
    for name, case, step, count, bar in (
        ("contact twice as stiff", stiffer, STEP, 2, 0.02),
        ("steps three times as long", problem, 3 * STEP, 2, None),
        ("cells half as large", halved, STEP, 1, 0.05),
        ("cells twice as large", coarse, STEP, 1, None),
    ):
        timing, motion = timed(run, case, count / FREQUENCY, step)
        found = cycles(case, motion)
        error = float(abs(found.ways[-1] / base.ways[count - 1] - 1))
        yield Row(
            "sorojax",
            _told(name, case, found),
            **timing.columns(),
            error=error,
            bar=bar,
            bar_on="error",
            reference=f"cycle {count} of: as it is",
        )


def _told(name, case, found) -> dict[str, Any]:
    return {
        "case": name,
        "dof": case.space.num_dofs,
        "cells": case.mesh.num_cells,
        "mm_per_cycle": np.round(found.ways / mm, 3).tolist(),
        "overlap_mm": round(found.overlap / mm, 4),
        "cuts": found.cuts,
    }


def _slopes():
    """Way after a short time by pressure, lag, friction and modulus."""
    problem = crawler_problem(Crawler(), size=2 * SIZE)
    newton = fem.Newton(residual_tolerance=1e-12)
    modulus = problem.material.shear_modulus  # type: ignore

    def way(theta):
        amplitude, lag, friction, scale = theta
        given = eqx.tree_at(
            lambda p: (p.loads[-1].friction.coefficient, p.material.shear_modulus),
            problem,
            (friction, scale * modulus),
        )
        gait = crawler_gait(amplitude, lag=lag)
        motion = run(given, GRADIENT_STEPS * STEP, STEP, gait, newton=newton, save=2)
        return moved(given, motion)[-1, 0]

    theta = jnp.array([8 * kPa, 0.02, 0.6, 1.0])
    jax.grad(way)(theta)
    start = time.process_time()
    slope, errors = np.asarray(jax.grad(way)(theta)), []
    took = time.process_time() - start
    for k in range(4):
        d = jnp.zeros(4).at[k].set(1e-4 * theta[k])
        change = float(way(theta + d) - way(theta - d)) / (2 * float(d[k]))
        errors.append(abs(slope[k] / change - 1))
    settings = {
        "of": "gradient",
        "steps": GRADIENT_STEPS,
        "dof": problem.space.num_dofs,
        "errors": [float(f"{e:.2g}") for e in errors],
    }
    return Row(
        "sorojax",
        settings,
        run_s=took,
        error=max(errors),
        bar=1e-3,
        bar_on="error",
        reference="central differences",
    )
