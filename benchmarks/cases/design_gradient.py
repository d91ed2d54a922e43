"""What the gradient of each objective by 1,250 densities costs beside its forward solve.

A row of designs as an optimiser visits them, each a small step from the one before, is
evaluated twice in turn: values alone, and values with gradients, both as `minimise` calls
them. `error` is the processor time of the second less that of the first, over that of the
first. "warm" starts every equilibrium from that of the design before, "rest" from the
unloaded body.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.cases.design_layout import _problem
from benchmarks.harness import Row, quick
from sorojax import design, fem, material, mesh
from sorojax._progress import silent
from sorojax.design.pneunet import body_of, output

MOST = 0.5
AGREES = 1e-5  # with central differences along a random direction
NUM_DESIGNS, STEP = 6, 5e-3
GRID = (50, 25)


class Objective(NamedTuple):
    """The first design, and from what solves an equilibrium to the function of a design;
    `compiled` where it solves none."""

    start: jax.Array
    of: Callable
    compiled: bool = False
    begins: tuple[str, ...] = ("warm", "rest")


def rows():
    for name, objective in objectives().items():
        for begin in objective.begins:
            value, both, wrong = _cost(objective, begin == "warm", 1.0 if quick() else 4.0)
            settings = {"objective": name, "start": begin, "densities": objective.start.size,
                        "value_ms": 1e3 * value, "gradient_ms": 1e3 * (both - value),
                        "slope_error": wrong}  # fmt: skip
            yield Row(
                "sorojax",
                settings,
                run_s=both,
                error=both / value - 1,
                bar=MOST,
                bar_on="error",
                reference="share of the forward solve",
            )
            yield Row(
                "sorojax",
                settings | {"what": "slope"},
                error=wrong,
                bar=AGREES,
                bar_on="error",
                reference="central differences",
            )


def objectives() -> dict[str, Objective]:
    beam = _cantilever()
    plan = design.layout(beam.mesh, radius=0.04)
    end = jnp.asarray(beam.mesh.node_sets["right"])
    start = 0.5 + 0.2 * jnp.sin(jnp.arange(1.0 * plan.num_variables))
    factor = jax.jit(lambda x: design.Simp(3.0, 1e-6)(plan(x, 4.0)))
    material_of = jax.jit(lambda x: design.interpolated_energy(beam.material, factor(x)))
    model = design.linear(_problem(beam.mesh, beam.supports, beam.loads))

    def judged(judge):
        def of(solver):
            def loss(x):
                made = dataclasses.replace(beam, material=material_of(x))
                return judge(made, solver(made).displacement)

            return loss

        return of

    def grip(made, u):
        out = design.displacement_along(u, end, [1.0, 0.0])
        return design.mechanism(made, u, out, work_weight=1e-2)

    def followed(_):
        loads = jnp.array([[0.0, -force] for force in (125.0, 250.0, 375.0, 500.0)])
        targets = jnp.array([[1.0, 0.125 - drop] for drop in (0.02, 0.04, 0.06, 0.08)])

        def loss(x):
            made = dataclasses.replace(beam, material=material_of(x))
            path = fem.solve_path(made, push=loads)
            return design.path_error(path, end, targets)

        return loss

    def small(_):
        return lambda x: design.compliance(model, factor(x))

    def moved(_):
        return lambda x: design.displacement_along(
            design.displacement(model, factor(x)), end, [0.0, -1.0]
        )

    return {
        "compliance, small strain": Objective(start, small, True, ("none",)),
        "displacement, small strain": Objective(start, moved, True, ("none",)),
        "compliance": Objective(start, judged(design.work_of_loads)),
        "mechanism": Objective(start, judged(grip)),
        "rotation": Objective(start, judged(lambda made, u: design.rotation(made, u, end))),
        "path of four loads": Objective(start, followed, begins=("rest",)),
        "pressure by flood": _inflated("flood", ("warm",)),
        "pressure by darcy": _inflated("darcy"),
    }


def _cantilever() -> fem.Problem:
    grid = mesh.rectangle([0, 0], [1.0, 0.5], divisions=GRID, element=mesh.Quad4())
    tip = jnp.array([mesh.nearest_node(grid, [1.0, 0.25])])
    return fem.problem(
        grid,
        material.neo_hookean(young_modulus=1e7, poisson_ratio=0.4),
        kinematics=fem.PlaneStrain(0.1),
        supports=(fem.Fixed(grid.node_sets["left"]),),
        loads=(fem.Force(tip, [0.0, -500.0], name="push"),),
        formulation=fem.Displacement(),
    )


def _inflated(chamber: str, begins: tuple[str, ...] = ("warm", "rest")) -> Objective:
    cell = design.pneunet_cell(chamber=chamber)
    sharpness = jnp.asarray(4.0)

    def of(solver):
        return lambda x: output(cell, solver(body_of(cell, x, sharpness)).displacement)

    return Objective(cell.start, of, begins=begins)


def _cost(objective: Objective, warm: bool, budget: float) -> tuple[float, float, float]:
    """Processor seconds of a value and of a value with its gradient, and how far the slope
    along the way is from that of differences. Repeats take `budget` seconds, as a hiccup of
    the machine is longer than what is compared."""
    size = objective.start.size
    ways = np.random.default_rng(0).uniform(-STEP, STEP, (NUM_DESIGNS, size))
    inside = np.clip(np.asarray(objective.start) + np.cumsum(ways, axis=0), 0.0, 1.0)
    designs = [jnp.asarray(x) for x in inside]

    def loss():
        return objective.of(design.Follower() if warm else fem.solve)

    value, both = loss(), jax.value_and_grad(loss())
    if objective.compiled:
        value, both = jax.jit(value), jax.jit(both)

    def seconds(function) -> list[float]:
        function(designs[0])
        spent = []
        for x in designs[1:]:
            begin = time.process_time()
            jax.block_until_ready(function(x))
            spent.append(time.process_time() - begin)
        return spent

    with silent():
        for function in (value, both):
            seconds(function)  # compiles
        rounds, begin = [], time.process_time()
        while len(rounds) < 2 or time.process_time() < begin + budget:
            rounds.append((seconds(value), seconds(both)))
        way = jnp.asarray(designs[1] - designs[0])
        slope = float(jnp.vdot(both(designs[0])[1], way))
        ahead, behind = (float(value(designs[0] + s * 1e-2 * way)) for s in (1, -1))
    # of every design the repeat that met the quietest machine
    alone, together = np.min(rounds, axis=0).mean(axis=1)
    return float(alone), float(together), abs(slope / ((ahead - behind) / 2e-2) - 1)
