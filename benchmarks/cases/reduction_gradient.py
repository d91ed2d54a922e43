"""Gradient of a closed loop's cost by dimensions of the drawing, rubber, valve and controller.

A bellows actuator in the plane: its mesh follows the drawing, eleven equilibria under
pressure, the strain of a line, three modes, the identified rod, and 2 s of the loop of valve,
air, rod and PID. The cost is the mean square of the tracking error. `error` of the gradient is
the largest difference to central differences of fourth order with the mesh's cells held,
each number scaled by itself, over the larger of the component and a thousandth of the largest
one; numbers that are zero or infinite are left out. No peer has such a gradient.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks.harness import Row, measure_calls, quick
from sorojax import SE2, fem, material, mesh, reduction, robots, rod, systems
from sorojax.cli.demo.design import bellows_problem, loop_of
from sorojax.units import kPa, mm

STEP = 1e-4  # of each number
WORST = 1e-4


def rows():
    size, duration = (1.6 * mm, 0.5) if quick("cells of 1 mm, loops of 2 s") else (1 * mm, 2.0)
    numbers, cost, cells = loop(size, duration)
    both = jax.value_and_grad(cost)
    varied = np.flatnonzero(np.isfinite(numbers) & (np.asarray(numbers) != 0))
    settings = {"cells": cells, "numbers": len(varied), "loop_s": duration}
    value, gradient = (measure_calls(lambda f=f: f(numbers), 3) for f in (cost, both))
    yield Row("sorojax", settings | {"method": "value"}, **value.columns())
    seen = np.array([difference(cost, numbers, int(k)) for k in varied])
    found, size = np.asarray(both(numbers)[1])[varied], np.asarray(numbers)[varied]
    scaled, wrong = found * size, (found - seen) * size
    most = np.abs(scaled).max()
    yield Row(
        "sorojax",
        settings | {"method": "value and gradient"},
        **gradient.columns(),
        error=float(np.max(np.abs(wrong) / np.maximum(np.abs(scaled), 1e-3 * most))),
        reference="central differences",
        bar=WORST,
        bar_on="error",
    )


def loop(size: float, duration: float):
    """The numbers, the cost as a function of them, and how many cells the mesh has."""
    first = robots.BellowsActuator()
    flat = mesh.triangulate(first.body(), size=size, order=2, interfaces=(first.layer(),))
    rubber = material.presets.dragon_skin_30()
    start = bellows_problem(first, flat, rubber, 20 * mm, fem.Displacement())
    near: list[reduction.Backbone] = []

    def reduced(actuator, law):
        """The rod, its identified laws, from the drawing and the rubber."""
        moved = mesh.move(flat, actuator.body(), interfaces=(actuator.layer(),))
        problem = eqx.tree_at(
            lambda p: (p.mesh.points, p.material.base), start, (moved.points, law)
        )
        path = fem.solve_path(problem, air=jnp.linspace(0, 12 * kPa, 11))
        middle = actuator.layer_thickness / 2
        ends = (jnp.stack([x, middle]) for x in (0 * middle, actuator.length))
        line = reduction.Line(*ends)
        backbone = reduction.strain_along(path, line, near=near[0] if near else None)
        if not near:
            near.append(jax.lax.stop_gradient(backbone))
        basis = reduction.pod_basis(backbone, modes={"kappa_z": 3})
        fit = reduction.identify(path, basis, backbone, line)
        made = rod.rod(SE2(), basis, fit.section, rod.elastic(law), length=fit.length)
        return made, fit

    def cost(actuator, law, valve, pid):
        made, fit = reduced(actuator, law)
        target = systems.SmoothRamp([0.0, 0.4 * duration], [0.0, -0.4])
        body = systems.RodBody(made, (fit.elastic, fit.pressure, fit.damping(0.02)))
        network = loop_of(systems.Source(target, unit="rad"), pid, valve, body)
        film = systems.simulate(network, duration, save=101)
        return jnp.mean((film["body.tip_angle"] - film["target.value"]) ** 2)

    valve = systems.Regulator(1.5e-8, integral_gain=3e-8, max_flow=3e-5)
    pid = systems.PID(-8 * kPa, integral_gain=-60 * kPa, derivative=-0.8 * kPa, low=0.0)
    moving, rest = eqx.partition((first, rubber, valve, pid), eqx.is_inexact_array)
    numbers, build = ravel_pytree(moving)
    return numbers, lambda x: cost(*eqx.combine(build(x), rest)), flat.num_cells


def difference(cost, numbers, k: int) -> float:
    """The central difference by number `k`."""
    way = jnp.zeros_like(numbers).at[k].set(STEP * numbers[k])
    at = {j: float(cost(numbers + j * way)) for j in (-2, -1, 1, 2)}
    return (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / float(12 * STEP * numbers[k])
