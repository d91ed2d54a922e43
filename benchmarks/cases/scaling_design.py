"""Layouts over design variables: compliance, its gradient, and an update of the variables."""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import memory, scaling
from benchmarks.cases.design_layout import _grid, _problem
from benchmarks.harness import measure_calls, quick
from sorojax import design, fem, mesh

GRIDS = ((20, 10), (60, 20), (150, 50), (300, 100), (450, 150))
UPDATES = (10**2, 10**3, 10**4, 10**5)


def cantilever(nx: int, ny: int):
    """Compliance of a beam held on the left and pulled down at its right end."""
    grid = _grid(nx, ny)
    pull = fem.Force(jnp.array([mesh.nearest_node(grid, [nx, 0.0])]), [0.0, -1.0])
    model = design.linear(_problem(grid, (fem.Fixed(grid.node_sets["left"]),), (pull,)))
    interpolation = design.Simp(3.0, 1e-9)
    return jax.jit(lambda x: design.compliance(model, interpolation(x)))


def compliances():
    """Points of values and of values with gradients; other densities every time."""
    values, gradients = [], []
    few = quick("grids but 60 x 20 and 150 x 50")
    for nx, ny in GRIDS[1:3] if few else GRIDS:
        loss = cantilever(nx, ny)
        both, draw = jax.value_and_grad(loss), np.random.default_rng(0)

        def densities(draw=draw, cells=nx * ny):
            return jnp.asarray(draw.uniform(0.4, 0.6, cells))

        for points, function in ((values, loss), (gradients, both)):

            def call(function=function, densities=densities):
                return function(densities())

            timing = measure_calls(call, repeats=3)
            points.append(scaling.Point(nx * ny, timing, memory.peak(call)))
    return {"compliance": values, "compliance and gradient": gradients}


def update(variables: int) -> scaling.Point:
    """Moving asymptotes with one constraint, after some steps."""
    draw = np.random.default_rng(0)
    weights = jnp.asarray(draw.uniform(0.5, 1.5, (1, variables))) / variables
    costs = jnp.asarray(draw.uniform(0.5, 1.5, variables)) / variables
    method, x = design.MMA(1e-2, 1.0), jnp.full(variables, 0.5)
    state = method.init(x, 1)

    def at(x):
        return design.Values(costs @ (1 / x), -costs / x**2, weights @ x - 0.4, weights)

    for _ in range(5):
        x, state = method.update(x, at(x), state)
    here = at(x)

    def call():
        return method.update(x, here, state)[0]

    return scaling.Point(variables, measure_calls(call), memory.peak(call))


def rows():
    for name, points in compliances().items():
        yield from scaling.rows(name, "variables", 1.5, points)
    yield from scaling.rows(
        "update of moving asymptotes", "variables", 1.0, map(update, UPDATES)
    )
