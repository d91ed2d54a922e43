"""The same motion on a floor by felupe with SciPy, between runs of ours."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers
from benchmarks.harness import Row, Timing
from sorojax import fem
from sorojax.contact import Coulomb
from sorojax.fem.loads.facets import areas_of

BAR = 0.2  # share of felupe's time that ours may take
LAW = ("stiffness", "smoothing", "friction_velocity")


def timed(go, *arguments, **options) -> tuple[Timing, Any]:
    """What `go(*arguments, **options)` takes and gives, compiled by its first step; CPU
    seconds."""
    start = time.process_time()
    go(*arguments, max_steps=1, throw=False, **options)
    ready = time.process_time()
    found = go(*arguments, **options)
    return Timing(ready - start, (time.process_time() - ready,)), found


def against_felupe(
    run: Callable[..., fem.Trajectory],
    problem: fem.Problem,
    damping: Any,
    steps: int,
    step: float,
    gait: dict[str, Any],
    element: str,
):
    """Rows of ours and of felupe's, by SciPy's solver and by Pardiso.

    `run(problem, duration, step)` moves the problem from rest, one metre deep, on a floor
    y = 0 that is its last load.
    """
    runs = (problem, steps * step, step)
    timing, motion = timed(run, *runs)
    end = np.asarray(motion.displacements[-1])

    def error(answer):
        return float(np.abs(answer["displacement"][-1] - end).max() / np.abs(end).max())

    arrays, law, found = _arrays(problem, damping, steps, step, gait), problem.loads[-1], []
    assert isinstance(law, fem.Contact) and isinstance(law.friction, Coulomb)
    numbers = {"friction": float(law.friction.coefficient)}
    numbers |= {name: float(getattr(law, name)) for name in LAW}
    for solver in ("superlu", "pardiso"):
        found.append(
            peers.row(
                "felupe",
                "motion",
                arrays,
                error,
                "sorojax, largest difference over largest",
                element=element,
                step=step,
                rho_inf=0.5,
                tolerance=1e-6,
                max_iterations=60,
                solver=solver,
                **numbers,
            )
        )
        start = time.process_time()
        run(*runs)
        timing = Timing(timing.compile_s, (*timing.runs, time.process_time() - start))
    settings = {
        "dof": problem.space.num_dofs,
        "steps": steps,
        "step_ms": 1e3 * step,
        "solver": problem.space.system.solver.name,
    }
    share = None if found[0].run_s is None else statistics.median(timing.runs) / found[0].run_s
    yield Row(
        "sorojax",
        settings,
        **timing.columns(),
        error=share,
        bar=BAR,
        bar_on="error",
        reference="time over that of felupe with SciPy's solver",
    )
    yield from found


def _arrays(problem: fem.Problem, damping: Any, steps: int, step: float, gait: dict[str, Any]):
    """What `peers/felupe.py motion` asks for."""
    cells, floor = problem.mesh, problem.loads[-1]
    assert isinstance(floor, fem.Contact)
    mass = fem.mass_matrix(problem)
    pull = next(load.value for load in problem.loads if isinstance(load, fem.Gravity))
    mu, bulk = (
        np.broadcast_to(np.asarray(x), cells.num_cells)
        for x in (problem.material.shear_modulus, problem.material.bulk_modulus)  # type: ignore
    )
    part, first = _parts(mu)
    air = [load for load in problem.loads if isinstance(load, fem.Pressure)]
    times = step * jnp.arange(steps + 1)
    pressures = [np.asarray(jax.vmap(gait[load.name])(times)) for load in air]
    return {
        "points": np.asarray(cells.points),
        "cells": np.asarray(cells.cells),
        "part": part,
        "mu": mu[first],
        "bulk": bulk[first],
        "rows": np.asarray(problem.space.system.rows),
        "cols": np.asarray(problem.space.system.cols),
        "mass": np.asarray(mass),
        "damping": np.asarray(damping.matrix(problem, mass, jnp.zeros_like(cells.points))),
        "weight": np.asarray(fem.lumped_mass(problem)) * np.tile(pull, cells.num_nodes),
        "pressures": np.stack(pressures, axis=1) if air else np.zeros((steps + 1, 0)),
        "touching": np.asarray(floor.facets),
        "areas": np.asarray(areas_of(problem, floor.facets)),
        **{f"edges_{k}": np.asarray(load.facets)[:, [1, 0, 2]] for k, load in enumerate(air)},
    }  # fmt: skip


def _parts(moduli: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number of the rubber of every cell, and the first cell of every rubber."""
    _, first, part = np.unique(moduli, return_index=True, return_inverse=True)
    return part.ravel(), first
