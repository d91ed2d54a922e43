"""Bending of a fast PneuNet with and without contact between its walls."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure_calls
from benchmarks.pneunet import pneunet, tip_turn
from sorojax import fem
from sorojax.units import kPa, mm

LEVELS = np.array([0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0]) * kPa
GAP = 0.55 * mm


def rows():
    turns = {}
    for size, touching, stiffness in (
        (0.8 * mm, False, 1.0),
        (0.8 * mm, True, 1.0),
        (0.8 * mm, True, 2.0),
        (0.5 * mm, True, 1.0),
    ):
        problem = pneunet(size, touching, num_bellows=3)
        if touching:
            walls = problem.loads[1]
            assert isinstance(walls, fem.SelfContact)
            law = walls.law
            problem = eqx.tree_at(
                lambda p: p.loads[1].stiffness, problem, stiffness * law.stiffness
            )

        def solve(problem=problem):
            return fem.solve_path(problem, air=jnp.asarray(LEVELS))

        timing = measure_calls(lambda: solve().displacements, repeats=1)
        path = solve()
        found = [tip_turn(problem, u) for u in path.displacements]
        turns[size, touching, stiffness] = found[-1]
        settings = {
            "dof": problem.space.num_dofs,
            "size_mm": size / mm,
            "touching": touching,
            "stiffness_over_default": stiffness,
            "iterations": [stats.iterations for stats in path.stats],
            "cuts": sum(stats.cuts for stats in path.stats),
            "turn_deg": np.round(found, 3).tolist(),
        }
        error = bar = reference = None
        if touching:
            states = [fem.contact_state(problem, u, "walls") for u in path.displacements]
            settings["pressure_kPa"] = [round(float(s.pressure.max()) / kPa, 2) for s in states]
            error = max(float(s.penetration) for s in states) / size
            bar, reference = 0.05, "overlap over the size of a cell"
            settings["change_of_turn"] = found[-1] / turns[0.8 * mm, True, 1.0] - 1
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            reference=reference,
            error=error,
            bar=bar,
            bar_on="error",
        )
