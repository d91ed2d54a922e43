"""Bellows actuator to 20 kPa in four states, error of the tip, against felupe."""

import jax.numpy as jnp
import numpy as np

from benchmarks import peers
from benchmarks.bellows import PRESSURES, RUBBER, case_a, tip_errors
from benchmarks.harness import Row, measure_calls, quick
from sorojax import fem, material
from sorojax.cli.demo.design import LAYER_STIFFNESS
from sorojax.fem.equilibrium.solve import Path
from sorojax.units import kPa, mm

NOTE = "converged solution, worst of 5, 10, 15 and 20 kPa"
SIZES = (1.0, 0.7, 0.5)  # mm; bars on errors are for 0.7, which `sorojax demo` uses, and finer
COARSE = 1.0  # mm: 8,424 unknowns with linear pressures, whose bar is on the time of the path
LONGEST = 1.0  # s


def rows():
    for size in SIZES[1:2] if quick("cells of 1 and 0.5 mm, felupe") else SIZES:
        problem = case_a(size * mm)
        yield _row(problem, size, bar=3e-3 if size < COARSE else None)
        if not quick("40 kPa in two steps"):
            yield _felupe(problem, size)
            yield _far(problem, size)
        richer = case_a(size * mm, linear_pressure=True)
        yield _row(richer, size, bar=1e-3 if size < COARSE else LONGEST)
        if not quick():
            yield _far(richer, size)


def _row(problem: fem.Problem, size: float, bar: float | None) -> Row:
    def solve():
        return fem.solve_path(problem, air=jnp.asarray(PRESSURES))

    timing = measure_calls(lambda: solve().displacements, repeats=5)
    path = solve()
    errors = tip_errors(problem, path.displacements)
    settings = _settings(problem, size, path)
    settings["error_percent_at_5_10_15_20_kPa"] = [round(100 * float(e), 4) for e in errors]
    return Row(
        "sorojax",
        settings,
        **timing.columns(),
        error=float(errors.max()),
        reference=NOTE,
        bar=bar,
        bar_on="error" if size < COARSE else "run_s",
    )


def _far(problem: fem.Problem, size: float) -> Row:
    """To 40 kPa in two steps; `cuts` says how many of them had to be halved."""

    def solve():
        return fem.solve_path(problem, air=jnp.asarray([20.0, 40.0]) * kPa)

    timing = measure_calls(lambda: solve().displacements, repeats=3)
    settings = _settings(problem, size, solve())
    return Row("sorojax", settings | {"to": "40 kPa in two steps"}, **timing.columns())


def _settings(problem: fem.Problem, size: float, path: Path) -> dict:
    return {
        "size_mm": size,
        "element": problem.mesh.element.name,
        "dof": problem.space.num_dofs,
        "solver": problem.space.system.solver.name,
        "iterations": sum(stats.iterations for stats in path.stats),
        "cuts": sum(stats.cuts for stats in path.stats),
    }


def _felupe(problem: fem.Problem, size: float):
    """The same mesh and pressures, plain Newton in 16 equal steps (8 diverge)."""
    (clamp,), (air,), body = problem.supports, problem.loads, problem.material
    assert isinstance(air, fem.Pressure) and isinstance(body, material.Scaled)
    cells, fixed = np.asarray(problem.mesh.cells), np.asarray(clamp.nodes)
    part = (np.asarray(body.factor) > 1).astype(int)
    edges = np.asarray(air.facets)[:, [1, 0, 2]]  # round the cavity
    levels = np.linspace(0.0, PRESSURES[-1], 17)[1:]
    arrays = {
        "points": np.asarray(problem.mesh.points),
        "cells": cells,
        "part": part,
        "mu": float(RUBBER.shear_modulus) * np.array([1.0, LAYER_STIFFNESS]),
        "bulk": float(RUBBER.bulk_modulus) * np.array([1.0, LAYER_STIFFNESS]),
        "fixed": np.stack([2 * fixed, 2 * fixed + 1]).ravel(),
        "edges": edges,
        "levels": levels,
    }

    def error(answer):
        states = answer["displacement"][3::4]
        return float(tip_errors(problem, states).max())

    return peers.row("felupe", "pressure", arrays, error, NOTE, size_mm=size, tolerance=1e-9)
