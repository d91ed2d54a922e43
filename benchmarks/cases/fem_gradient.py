"""Tip of the bellows actuator at 20 kPa by every stiffness factor, beside its solve."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.bellows import PRESSURES, case_a
from benchmarks.harness import Row, measure_calls, quick
from sorojax import fem, mesh
from sorojax.fem.equilibrium.linear import linearise, prepare, step
from sorojax.units import mm

SIZES = (0.7, 0.32)  # mm: 13k and 50k dof


def rows():
    for size in SIZES[:1] if quick("cells of 0.32 mm") else SIZES:
        yield from _rows(size)


def _rows(size: float):
    problem = case_a(size * mm)
    problem = eqx.tree_at(lambda p: p.loads[0].value, problem, jnp.asarray(PRESSURES[-1]))
    solver = problem.space.system.solver
    tip = mesh.nearest_node(problem.mesh, [66 * mm, 0.0])
    tight = fem.Newton(residual_tolerance=1e-12)

    def height(factor, start=None):
        here = eqx.tree_at(lambda p: p.material.factor, problem, factor)
        return fem.solve(here, start=start, newton=tight).displacement[tip, 1]

    def factorisations(call):
        before = solver.num_factorisations
        call()
        return solver.num_factorisations - before

    factor = problem.material.factor
    alone, together = (lambda: height(factor)), (lambda: jax.value_and_grad(height)(factor))
    solve, both = measure_calls(alone), measure_calls(together)
    iteration = _iteration(problem)
    settings = {"dof": problem.space.num_dofs, "parameters": factor.size}
    count = {"factorisations": factorisations(alone)}
    yield Row(
        "sorojax",
        settings | {"method": "solve"} | count,
        **solve.columns(),
        reference="",
        error=None,
    )
    start = fem.solve(problem, newton=tight).displacement
    gradient = np.asarray(jax.grad(height)(factor))
    way = np.random.default_rng(0).standard_normal(factor.size) * 0.1
    values = [float(height(factor + k * 1e-2 * way, start)) for k in (-2, -1, 1, 2)]
    slope = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / 12e-2
    extra = min(both.runs) - min(solve.runs)
    settings |= {
        "method": "value and gradient",
        "factorisations": factorisations(together),
        "extra_s": round(extra, 4),
        "newton_iteration_s": round(min(iteration.runs), 4),
        "extra_iterations": round(extra / min(iteration.runs), 2),
    }
    yield Row(
        "sorojax",
        settings,
        **both.columns(),
        reference="central differences of order 4 on a random direction",
        error=abs(float(gradient @ way) / slope - 1),
        bar=1e-6,
        bar_on="error",
    )


def _iteration(problem: fem.Problem):
    """Timing of one Newton iteration: assembly, factorisation, back-substitution."""
    prepared = prepare(problem)
    still = np.zeros(problem.space.num_dofs)
    states = (1e-9 * jnp.sin(100 * k * problem.mesh.points) for k in range(1, 99))

    def iterate():
        u = next(states)  # another matrix at every call: no factor is reused
        state = linearise(problem, prepared, u, u)
        step(problem, prepared, state.values, state.residual, still)
        return state

    return measure_calls(iterate)
