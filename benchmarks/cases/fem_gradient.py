"""Tip of the bellows actuator at 20 kPa by every stiffness factor, beside its solve."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.bellows import PRESSURES, case_a
from benchmarks.harness import Row, measure_calls
from sorojax import fem, mesh
from sorojax.units import mm


def rows():
    problem = case_a(0.7 * mm)
    problem = eqx.tree_at(lambda p: p.loads[0].value, problem, jnp.asarray(PRESSURES[-1]))
    tip = mesh.nearest_node(problem.mesh, [66 * mm, 0.0])
    tight = fem.Newton(residual_tolerance=1e-12)

    def height(factor, start=None):
        here = eqx.tree_at(lambda p: p.material.factor, problem, factor)
        return fem.solve(here, start=start, newton=tight).displacement[tip, 1]

    factor = problem.material.factor
    solve = measure_calls(lambda: height(factor))
    both = measure_calls(lambda: jax.value_and_grad(height)(factor))
    settings = {"dof": problem.space.num_dofs, "parameters": factor.size}
    yield Row(
        "sorojax", settings | {"method": "solve"}, **solve.columns(), reference="", error=None
    )
    start = fem.solve(problem, newton=tight).displacement
    gradient = np.asarray(jax.grad(height)(factor))
    way = np.random.default_rng(0).standard_normal(factor.size) * 0.1
    values = [float(height(factor + k * 1e-2 * way, start)) for k in (-2, -1, 1, 2)]
    slope = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / 12e-2
    yield Row(
        "sorojax", settings | {"method": "value and gradient"}, **both.columns(),
        reference="central differences of order 4 on a random direction",
        error=abs(float(gradient @ way) / slope - 1), bar=1e-4, bar_on="error",
    )  # fmt: skip
