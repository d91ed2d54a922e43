"""One update of moving asymptotes by the number of variables."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import design

#: Variables, constraints and most seconds for an update.
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
        settings = {"variables": variables, "constraints": constraints,
                    "objective": float(values(x).objective)}  # fmt: skip
        yield Row(
            "sorojax", settings, seconds[0], float(np.median(seconds[1:])), min(seconds[1:]),
            max(seconds[1:]), bar=bar,
        )  # fmt: skip
