"""Gradient of a closed loop's cost by dimensions of the drawing, rubber, valve and controller.

Three robots by `design.drawing_to_loop`: a bellows actuator and a PneuNet in the plane, and a
printed finger in space. Their meshes follow the drawing; equilibria under pressure, the strain
of a line, modes, the identified rod, and the loop of valve, air, rod and PID. The cost is the
mean square of the tracking error. `error` of the gradient is the largest difference to central
differences of fourth order with the mesh's cells held, each number scaled by itself, over the
larger of the component and a thousandth of the largest one; numbers that are zero or infinite
are left out. The bar for compiling is on the first value and the first gradient together, each
beyond later ones. `memory_MB` is the most that the process has held, compilation and the robots
before included. No peer has such a gradient.
"""

from dataclasses import replace

import jax

from benchmarks import loops
from benchmarks.harness import Row, clock, measure_calls, quick
from benchmarks.memory import highest
from sorojax.units import mm

WORST = 1e-4
COMPILE = 30.0  # s


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
        yield from _rows(name, robot, COMPILE if name == "bellows" else None)


def _rows(name: str, robot: loops.Robot, most: float | None):
    start = clock()
    loop = loops.Loop(robot)
    jax.block_until_ready(loop.near)
    first = clock() - start
    both = jax.value_and_grad(loop.cost)
    value, gradient = (measure_calls(lambda f=f: f(loop.numbers), 3) for f in (loop.cost, both))
    value = replace(value, compile_s=value.compile_s + first - min(value.runs))
    settings = {
        "robot": name,
        "cells": loop.robot.cells,
        "numbers": len(loop.varied),
        "loop_s": float(loop.near.time[-1]),
    }
    yield Row("sorojax", settings | {"method": f"{name}, value"}, **value.columns())
    compiled = value.compile_s + gradient.compile_s
    both_first = settings | {"method": f"{name}, first value and first gradient"}
    yield Row("sorojax", both_first, compile_s=compiled, bar=most, bar_on="compile_s")
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
