"""Bellows actuator to 20 kPa in four states, error of the tip, against felupe."""

import jax.numpy as jnp
import numpy as np

from benchmarks import peers
from benchmarks.bellows import PRESSURES, RUBBER, case_a, tip_errors
from benchmarks.harness import Row, measure_calls
from sorojax import fem, material
from sorojax.cli.demo.design import LAYER_STIFFNESS
from sorojax.units import mm

NOTE = "converged solution, worst of 10, 15 and 20 kPa"
SIZES = (1.0, 0.7, 0.5)  # mm; the bar is for 0.7, which `sorojax demo` uses


def rows():
    for size in SIZES:
        problem = case_a(size * mm)

        def solve(problem=problem):
            return fem.solve_path(problem, air=jnp.asarray(PRESSURES))

        timing = measure_calls(lambda: solve().displacements, repeats=5)
        path = solve()
        settings = {
            "size_mm": size,
            "dof": problem.space.num_dofs,
            "solver": problem.space.system.solver.name,
            "iterations": sum(stats.iterations for stats in path.stats),
        }
        yield Row(
            "sorojax", settings, **timing.columns(), reference=NOTE,
            bar=3e-3 if size == 0.7 else None,
            error=float(tip_errors(problem, path.displacements)[1:].max()), bar_on="error",
        )  # fmt: skip
        yield _felupe(problem, size)


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
        return float(tip_errors(problem, states)[1:].max())

    return peers.row("felupe", "pressure", arrays, error, NOTE, size_mm=size, tolerance=1e-9)
