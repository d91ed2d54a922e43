"""Gradient of a closed loop's cost by dimensions of the drawing, rubber, valve and controller.

Three robots by `design.drawing_to_loop`: a bellows actuator and a PneuNet in the plane, and a
printed finger in space. Their meshes follow the drawing; equilibria under pressure, the strain
of a line, modes, the identified rod, and the loop of valve, air, rod and PID. The cost is the
mean square of the tracking error. `error` of the gradient is the largest difference to central
differences of fourth order with the mesh's cells held, each number scaled by itself, over the
larger of the component and a thousandth of the largest one; numbers that are zero or infinite
are left out. `memory_MB` is the most that the process has held, compilation and the robots
before included. No peer has such a gradient.
"""

import jax

from benchmarks import loops
from benchmarks.harness import Row, measure_calls, quick
from benchmarks.memory import highest
from sorojax.units import mm

WORST = 1e-4


def rows():
    few = quick("cells of 1 mm, loops of 2 s, PneuNet and finger")
    if few:
        robots = {"bellows": loops.bellows(1.6 * mm, 0.5)}
    else:
        robots = {
            "bellows": loops.bellows(1 * mm, 2.0),
            "PneuNet": loops.pneunet(1.2 * mm, 1.0, num_chambers=6),
            "finger": loops.finger(2 * mm, 1.0, folds=3, order=1),
        }
    for name, robot in robots.items():
        yield from _rows(name, loops.Loop(robot))


def _rows(name: str, loop: loops.Loop):
    both = jax.value_and_grad(loop.cost)
    value, gradient = (measure_calls(lambda f=f: f(loop.numbers), 3) for f in (loop.cost, both))
    settings = {
        "robot": name,
        "cells": loop.robot.cells,
        "numbers": len(loop.varied),
        "loop_s": float(loop.near.time[-1]),
    }
    yield Row("sorojax", settings | {"method": f"{name}, value"}, **value.columns())
    settings["memory_MB"] = highest()
    yield Row(
        "sorojax",
        settings | {"method": f"{name}, value and gradient"},
        **gradient.columns(),
        error=loop.error(both(loop.numbers)[1]),
        reference="central differences",
        bar=WORST,
        bar_on="error",
    )
