"""32 samples of stiffness and pressure of the bellows actuator: vmap against a loop."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.bellows import case_a
from benchmarks.harness import Row, measure, measure_calls
from sorojax import Status, fem
from sorojax.math.linalg import sparse
from sorojax.units import kPa, mm

NUM_LANES = 32


def rows():
    problem = case_a(1.1 * mm)
    random = np.random.default_rng(0)
    scales = jnp.asarray(random.uniform(0.8, 1.25, NUM_LANES))
    pressures = jnp.asarray(random.uniform(2.0, 20.0, NUM_LANES)) * kPa
    solver = problem.space.system.solver

    def solve(scale, pressure):
        here = eqx.tree_at(
            lambda p: (p.material.factor, p.loads[0].value),
            problem,
            (scale * problem.material.factor, pressure),  # type: ignore
        )
        return fem.solve(here, throw=False)

    def one_by_one():
        pairs = zip(scales, pressures, strict=True)
        return jnp.stack([solve(*pair).displacement for pair in pairs])

    def at_once():
        return jax.vmap(solve)(scales, pressures).displacement

    loop, batch = measure_calls(one_by_one, repeats=3), measure_calls(at_once, repeats=3)
    counts = []
    for call in (one_by_one, at_once):
        before = solver.num_factorisations
        call()
        counts.append(solver.num_factorisations - before)
    settings = {"dof": problem.space.num_dofs, "lanes": NUM_LANES}
    method = {"method": "loop", "factorisations": counts[0]}
    yield Row("sorojax", settings | method, **loop.columns(), reference="", error=None)
    alone, lanes = one_by_one(), jax.vmap(solve)(scales, pressures)
    error = float(jnp.max(jnp.abs(lanes.displacement - alone)) / jnp.max(jnp.abs(alone)))
    ratio = min(batch.runs) / min(loop.runs)
    method = {"method": "vmap", "factorisations": counts[1], "of_loop": round(ratio, 3)}
    failed = int(np.sum(lanes.status == Status.not_converged))
    yield Row(
        "sorojax",
        settings | method | {"failed": failed},
        **batch.columns(),
        reference="loop",
        error=error,
        bar=0.9 * min(loop.runs),
    )
    yield from _callback(problem)


def _callback(problem: fem.Problem):
    """The solve of a matrix that is factored already, from inside a program and directly."""
    system = problem.space.system
    values = jnp.where(system.rows == system.cols, 1.0, 0.0)
    b = jnp.ones(system.size)
    host_values, host_b = np.asarray(values), np.asarray(b)
    direct = measure_calls(lambda: system.solver.solve(host_values, host_b), repeats=51)
    inside = measure(lambda v, b: sparse.solve(system, v, b), values, b, repeats=51)
    settings = {"dof": system.size, "nnz": system.num_values}
    yield Row(
        "sorojax",
        settings | {"method": "solve on the host"},
        **direct.columns(),
        reference="",
        error=None,
    )
    cost = min(inside.runs) - min(direct.runs)
    settings |= {"method": "solve in a program", "callback_ms": round(1e3 * cost, 3)}
    yield Row("sorojax", settings, **inside.columns(), reference="", error=None)
