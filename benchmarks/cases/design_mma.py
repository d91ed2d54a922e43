"""One update of moving asymptotes by the number of variables, and its share of a step."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.cases.scaling_design import cantilever
from benchmarks.harness import Row
from sorojax import design

#: Variables, constraints and most seconds for an update.
CELLS, SHARE = (200, 50), 0.1  # of a linear layout of 10,000 densities
CASES = ((1_000, 1, None), (10_000, 1, None), (100_000, 1, 1.0), (10_000, 10, None))


def rows():
    for variables, constraints, bar in CASES:
        random = np.random.default_rng(0)
        weights = jnp.asarray(random.uniform(0.5, 1.5, (constraints, variables))) / variables
        costs = jnp.asarray(random.uniform(0.5, 1.5, variables)) / variables

        def values(x, weights=weights, costs=costs):
            held = weights @ x - 0.4
            return design.Values(costs @ (1 / x), -costs / x**2, held, weights)

        method = design.MMA(1e-2, 1.0)
        x = jnp.full(variables, 0.5)
        state, seconds = method.init(x, constraints), []
        for _ in range(25):
            here = values(x)
            start = time.perf_counter()
            x, state = method.update(x, here, state)
            jax.block_until_ready(x)
            seconds.append(time.perf_counter() - start)
        settings = {
            "variables": variables,
            "constraints": constraints,
            "objective": float(values(x).objective),
        }
        yield Row(
            "sorojax",
            settings,
            seconds[0],
            float(np.median(seconds[1:])),
            min(seconds[1:]),
            max(seconds[1:]),
            bar=bar,
        )
    yield _share()


def _share() -> Row:
    """Processor time of an update over that of a whole step: the update beside one
    factorisation, one solve and the gradient of a linear compliance."""
    both, count = jax.value_and_grad(cantilever(*CELLS)), CELLS[0] * CELLS[1]
    weights, method = jnp.ones((1, count)) / count, design.MMA(1e-3, 1.0, move=0.1)
    x = jnp.full(count, 0.5)
    state, evaluated, updated = method.init(x, 1), [], []
    for _ in range(12):
        start = time.process_time()
        objective, gradient = jax.block_until_ready(both(x))
        middle = time.process_time()
        values = design.Values(objective, gradient, weights @ x - 0.5, weights)
        x, state = jax.block_until_ready(method.update(x, values, state))
        evaluated.append(middle - start)
        updated.append(time.process_time() - middle)
    update, solve = float(np.median(updated[2:])), float(np.median(evaluated[2:]))
    settings = {
        "variables": count,
        "constraints": 1,
        "what": "share of a step",
        "solve_and_gradient_s": solve,
        "update_s": update,
    }
    return Row(
        "sorojax",
        settings,
        run_s=update,
        error=update / (update + solve),
        bar=SHARE,
        bar_on="error",
        reference="one linear solve with gradient",
    )
