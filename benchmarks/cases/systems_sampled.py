"""A bellows reduced to a few shapes and the force of a few weighted cells.

Trained on equilibria under pressure and on two motions; then filled with air by a regulator to
another pressure in another time, beside the full body in the same network.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.cases.systems_fem import DURATION, STEP, STEPS, body, network
from benchmarks.harness import Row, measure_calls
from sorojax import systems
from sorojax.math.compiled import batched
from sorojax.units import kPa, mm

SIZE, MODES, TOLERANCE = 0.7 * mm, 10, 1e-2
SEEN = ((7 * kPa, 0.05), (3 * kPa, 0.03))  # pressures, and times to them [s], of training
TARGET, RISE = 5 * kPa, 0.04
PRESSURES = np.linspace(0, 8 * kPa, 17)
ERROR_BAR, CELLS_BAR, STEP_BAR, MEMBER_BAR, GRADIENT_BAR = 1e-2, 0.02, 200e-6, 50e-6, 1e-5
MEMBERS = (1, 64, 1024, 4096)


def filled(block, pressure, rise, step, solver=None):
    """The network that fills the body to a pressure [Pa] in a time [s]."""
    net = network(block)
    goal = systems.Source(systems.SmoothRamp([0.0, rise], [0.0, pressure]), unit="Pa")
    net = systems.Network({**net.blocks, "goal": goal}, dict(net.wires))
    return systems.simulate(net, DURATION, save=STEPS + 1, step=step, solver=solver)


def trained(full):
    motions = [filled(full, *seen, STEP).state["body"]["u"][3::3] for seen in SEEN]
    paths = [{"air": PRESSURES}]
    return systems.sampled_body(full, paths, motions=motions, modes=MODES, tolerance=TOLERANCE)


def moves(block, step, solver=None):
    """Where the tip goes while the network fills the body."""
    place = filled(block, TARGET, RISE, step, solver)["body.tip_position"]
    return place - place[0]


def stepped(block, count):
    """Where the tip is after `count` steps of the body alone under a pressure."""
    solver, h = systems.Rosenbrock2(refresh=True), STEP / 4

    def run(pressure):
        alone = systems.Network(
            {"body": block, "air": systems.Source(systems.Constant(pressure), unit="Pa")},
            {"body.air_pressure": "air.value"},
        )
        film = systems.simulate(alone, count * h, save=2, step=h, solver=solver)
        return film["body.tip_position"][-1]

    return run


def per_step(block, members, count=40):
    """CPU time of a step of one member [s]."""
    run = jax.jit(batched(stepped(block, count)))
    pressures = jnp.linspace(1 * kPa, 6 * kPa, members)
    jax.block_until_ready(run(pressures))
    times = []
    for _ in range(3):
        start = time.process_time()
        jax.block_until_ready(run(pressures))
        times.append(time.process_time() - start)
    return min(times) / count / members


def gradient(block):
    """Derivative of a run by stiffness and pressure, over that of differences."""

    def end(numbers):
        scaled = eqx.tree_at(
            lambda b: b.force.body.material.shear_modulus,
            block,
            block.force.body.material.shear_modulus * numbers[0],
        )
        return stepped(scaled, 20)(4 * kPa * numbers[1])[1]

    end, at, way = jax.jit(end), jnp.ones(2), jnp.array([1.0, 0.7])
    found = jax.jit(jax.grad(end))(at) @ way
    steps = {k: end(at + k * 1e-3 * way) for k in (-2, -1, 1, 2)}
    want = (8 * (steps[1] - steps[-1]) - (steps[2] - steps[-2])) / 12e-3
    return abs(float(found / want - 1))


def rows():
    full = body(SIZE)
    count = full.problem.mesh.num_cells
    start = time.perf_counter()
    small = trained(full)
    took = time.perf_counter() - start
    share = len(small.cells) / count
    settings = {"shapes": len(small.body.basis), "cells": len(small.cells), "of": count}
    want, got = (
        moves(full, STEP),
        moves(small.body, STEP / 4, systems.Rosenbrock2(refresh=True)),
    )
    scale = float(jnp.max(jnp.abs(want)))

    def row(of, error, bar, reference, **columns):
        more = {"quantity": of} | settings
        bars = {"bar": bar, "bar_on": "error"}
        return Row("sorojax", more, error=error, reference=reference, **bars, **columns)

    reference = "the full body, over its largest move"
    off = float(jnp.max(jnp.abs(got - want))) / scale
    yield row("tip in a network", off, ERROR_BAR, reference, compile_s=took)
    seen = float(small.error)
    yield row("equilibria between those of training", seen, ERROR_BAR, reference)
    yield row("share of the cells", share, CELLS_BAR, "all cells")
    yield row("gradient", gradient(small.body), GRADIENT_BAR, "central differences")
    timing = measure_calls(lambda: moves(full, STEP), 1)
    columns = timing.per(STEPS).columns()
    yield Row("sorojax", {"quantity": "a step of the full body", "of": count}, **columns)
    for members in MEMBERS:
        took = per_step(small.body, members)
        more = {"quantity": "a step of a member", "members": members} | settings
        bar = STEP_BAR if members == 1 else MEMBER_BAR
        yield Row("sorojax", more, run_s=took, bar=bar, bar_on="run_s")
