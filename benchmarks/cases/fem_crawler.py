"""The multigait crawler: cost of a second, gait, independence, derivatives, against felupe.

Times are CPU seconds on one core.
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers
from benchmarks.crawling import cycles, felupe_arrays, moved, run
from benchmarks.harness import Row, Timing
from sorojax import fem
from sorojax.robots import Crawler, crawler_gait, crawler_problem
from sorojax.units import kPa, mm

SIZE, STEP = 1.5 * mm, 2e-3
PEER_STEPS, GRADIENT_STEPS = 100, 6


def rows():
    problem = crawler_problem(Crawler(), size=SIZE)
    yield from _second(problem)
    yield from _against()
    yield from _changes(problem)
    yield _slopes()


def timed(go, *arguments) -> tuple[Timing, Any]:
    """What `go(*arguments, **options)` takes and gives, compiled by its first step."""
    start = time.process_time()
    go(*arguments, max_steps=1, throw=False)
    ready = time.process_time()
    found = go(*arguments)
    return Timing(ready - start, (time.process_time() - ready,)), found


def _second(problem):
    """One second of motion, at the original's step and at half of it."""
    for step in (STEP, STEP / 2):
        timing, motion = timed(run, problem, 1.0, step)
        stats, took = motion.stats, timing.runs[0]
        settings = {
            "dof": problem.space.num_dofs,
            "step_ms": 1e3 * step,
            "ms_per_step": round(1e3 * took / stats.steps, 2),
            "iterations": round(stats.iterations / stats.steps, 2),
            "factorisations": round(stats.factorisations / stats.steps, 2),
            "cuts": stats.cuts,
        }
        yield Row("sorojax", settings, **timing.columns(), bar=60.0)


def _against():
    """The first steps, beside a plain loop of felupe and SciPy with the same mesh."""
    flat = crawler_problem(Crawler(), size=SIZE, depth=1.0)
    duration = PEER_STEPS * STEP
    timing, motion = timed(run, flat, duration, STEP)
    end = np.asarray(motion.displacements[-1])

    def error(answer):
        return float(np.abs(answer["displacement"][-1] - end).max() / np.abs(end).max())

    settings = {"dof": flat.space.num_dofs, "steps": PEER_STEPS}
    yield Row("sorojax", settings, **timing.columns())
    arrays = felupe_arrays(flat, PEER_STEPS, STEP)
    law = flat.loads[-1]
    assert isinstance(law, fem.Contact)
    numbers = ("stiffness", "smoothing", "friction", "friction_velocity")
    options = {name: float(getattr(law, name)) for name in numbers}
    for solver in ("superlu", "pardiso"):
        yield peers.row(
            "felupe", "motion", arrays, error, "sorojax, largest difference over largest",
            element="Quad8", step=STEP, rho_inf=0.5, tolerance=1e-6, max_iterations=60,
            solver=solver, **options,
        )  # fmt: skip


def _changes(problem):
    """Way of a cycle under other numbers; other cells by their first cycle."""
    law: Any = problem.loads[-1]
    stiffer = eqx.tree_at(
        lambda p: (p.loads[-1].stiffness, p.loads[-1].friction_stiffness),
        problem, (2 * law.stiffness, 2 * law.friction_stiffness),
    )  # fmt: skip
    halved = crawler_problem(Crawler(), size=SIZE / 2, across=2)
    coarse = crawler_problem(Crawler(), size=2 * SIZE)
    base = None
    for name, case, step, count, bar in (
        ("as it is", problem, STEP, 2, None),
        ("contact twice as stiff", stiffer, STEP, 2, 0.02),
        ("steps three times as long", problem, 3 * STEP, 2, None),
        ("cells half as large", halved, STEP, 1, 0.05),
        ("cells twice as large", coarse, STEP, 1, None),
    ):
        timing, found = timed(cycles, case, step, count)
        settings = {
            "case": name,
            "dof": case.space.num_dofs,
            "mm_per_cycle": np.round(found.ways / mm, 3).tolist(),
            "overlap_mm": round(found.overlap / mm, 4),
            "cuts": found.cuts,
        }
        base = found.ways if base is None else base
        error = float(abs(found.ways[-1] / base[count - 1] - 1))
        yield Row("sorojax", settings, **timing.columns(), error=error, bar=bar,
                  bar_on="error", reference=f"cycle {count} of: as it is")  # fmt: skip


def _slopes():
    """Way after a short time by pressure, lag, friction and modulus."""
    problem = crawler_problem(Crawler(), size=2 * SIZE)
    newton = fem.Newton(residual_tolerance=1e-12)
    modulus = problem.material.shear_modulus  # type: ignore

    def way(theta):
        amplitude, lag, friction, scale = theta
        given = eqx.tree_at(
            lambda p: (p.loads[-1].friction, p.material.shear_modulus),
            problem, (friction, scale * modulus),
        )  # fmt: skip
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
    settings = {"of": "gradient", "steps": GRADIENT_STEPS, "dof": problem.space.num_dofs,
                "errors": [float(f"{e:.2g}") for e in errors]}  # fmt: skip
    return Row("sorojax", settings, run_s=took, error=max(errors), bar=1e-3, bar_on="error",
               reference="central differences")  # fmt: skip
