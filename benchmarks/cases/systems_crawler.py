"""A crawler reduced to a few shapes, the force of a few weighted points and the contact of its
surface, beside the full body.

Trained on two motions, with lower and higher pressures than the one that is asked for, on
another floor; the way of a cycle, once the gait has settled, is compared.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import fem, robots, systems
from sorojax.math.compiled import batched
from sorojax.systems.integrate.modal_step import first_acceleration, modal_step
from sorojax.units import kPa, mm

RATE, CYCLES, MODES, TOLERANCE = 1.25, 3, 20, 1e-2  # Hz
SIZE, STEP = 1.5 * mm, 1e-3
SEEN, ASKED = (6 * kPa, 8 * kPa), 7 * kPa
EVERY = 6  # frames of training
FRICTION = {"training": 0.6, "asked": 0.5}
ERROR_BAR, SHARE_BAR, STEP_BAR, MEMBER_BAR, GRADIENT_BAR = 1e-2, 0.02, 200e-6, 50e-6, 1e-5
MEMBERS = (1, 64, 1024, 4096)


class Gait(systems.AbstractReference):
    """The pressure of one group of chambers."""

    air: jax.Array
    port: str = eqx.field(static=True)

    def __call__(self, t):
        return robots.crawler_gait(self.air, RATE)[self.port](t)


def problem(friction):
    return robots.crawler_problem(robots.Crawler(), size=SIZE, friction=friction)


def body(friction):
    damping = fem.Rayleigh(mass=1.0, stiffness=1e-3)
    ports = tuple(robots.crawler_gait())
    return systems.FemBody(problem(friction), damping=damping, driven=ports)


def walked(friction, air, step=STEP):
    """The motion of the full body."""
    damping = fem.Rayleigh(mass=1.0, stiffness=1e-3)
    gait = robots.crawler_gait(air, RATE)
    return fem.simulate(problem(friction), CYCLES / RATE, step, damping=damping, **gait)


def centre(displacements, of):
    """Way of the centre of mass along the floor and above it [m]."""
    shares = fem.lumped_mass(of)[::2] / fem.total_mass(of)
    return np.asarray(jnp.einsum("n,tni->ti", shares, displacements))


def way(times, along):
    """Of the last cycle, along the floor [m]."""
    ends = np.interp(np.array([CYCLES - 1, CYCLES]) / RATE, np.asarray(times), along[:, 0])
    return float(ends[1] - ends[0])


def network(small, air):
    goals = {name: systems.Source(Gait(air, name), unit="Pa") for name in robots.crawler_gait()}
    wires = {f"body.{name}_pressure": f"{name}.value" for name in goals}
    return systems.Network({"body": small, **goals}, wires)


def with_friction(small, friction):
    return eqx.tree_at(
        lambda b: b.contacts[0].slider.law.coefficient, small, jnp.asarray(friction)
    )


def stepped(small, count):
    """Mean of the coordinates after `count` steps in the middle of a cycle, by a factor of the
    pressures."""
    state, h = small.initial_state(), jnp.asarray(STEP)

    def run(factor):
        def one(carry, number):
            state, a = carry
            gait = robots.crawler_gait(factor * ASKED, RATE)
            t = number * h
            inputs = {f"{name}_pressure": at(t) for name, at in gait.items()}
            moved = modal_step(small, inputs, state, a, h)
            return (moved.state, moved.acceleration), None

        rest = {f"{name}_pressure": 0 * factor for name in robots.crawler_gait()}
        start = state, first_acceleration(small, rest, state)
        numbers = jnp.arange(count, dtype=h.dtype)
        (end, _), _ = jax.lax.scan(one, start, numbers)
        return jnp.mean(end["q"])

    return run


def per_step(small, members, count=200):
    """CPU time of a step of one member [s]."""
    run = jax.jit(batched(stepped(small, count)))
    factors = jnp.linspace(0.8, 1.1, members)
    jax.block_until_ready(run(factors))
    times = []
    for _ in range(3 if members < 1000 else 1):
        start = time.process_time()
        jax.block_until_ready(run(factors))
        times.append(time.process_time() - start)
    return min(times) / count / members


def gradient(small):
    """Derivative of a run of 200 steps by the pressures, over that of differences."""
    run = jax.jit(stepped(small, 200))
    found = float(jax.jit(jax.grad(run))(jnp.asarray(1.0)))
    h = 1e-5
    want = (8 * (run(1 + h) - run(1 - h)) - (run(1 + 2 * h) - run(1 - 2 * h))) / (12 * h)
    return abs(found / float(want) - 1)


def rows():
    motions = [walked(FRICTION["training"], air, 2 * STEP) for air in SEEN]
    start = time.perf_counter()
    full = body(FRICTION["training"])
    frames = [motion.displacements[::EVERY] for motion in motions]
    found = systems.sampled_body(full, motions=frames, modes=MODES, tolerance=TOLERANCE)
    took = time.perf_counter() - start
    small = with_friction(found.body, FRICTION["asked"])
    cells = {
        "shapes": len(small.basis),
        "points": len(found.cells),
        "cells": len(np.unique(found.cells)),
        "of": found.num_cells,
    }
    start = time.process_time()
    want = walked(FRICTION["asked"], ASKED)
    full_step = (time.process_time() - start) / (CYCLES / RATE / STEP)
    of = problem(FRICTION["asked"])
    asked = centre(want.displacements, of)
    film = systems.simulate(
        network(small, jnp.asarray(ASKED)), CYCLES / RATE, save=1201, step=STEP
    )
    seen = centre(
        jax.vmap(lambda q: systems.displacement(small.basis, q))(film.state["body"]["q"]), of
    )
    both = np.stack(
        [np.interp(np.asarray(want.time), np.asarray(film.time), x) for x in seen.T]
    )
    height = np.abs(both[1] - asked[:, 1]).max() / np.ptp(asked[:, 1])
    ways = way(film.time, seen), way(want.time, asked)

    def row(of, error, bar, reference, **columns):
        more = {"quantity": of} | cells
        return Row(
            "sorojax",
            more,
            error=error,
            reference=reference,
            bar=bar,
            bar_on="error",
            **columns,
        )

    reference = f"the full body, {ways[1] / mm:.3f} mm for {ways[0] / mm:.3f} mm"
    yield row(
        "way of a cycle", abs(ways[0] / ways[1] - 1), ERROR_BAR, reference, compile_s=took
    )
    yield row("height of the centre", height, ERROR_BAR, "the full body, over its range")
    yield row("share of the quadrature points", float(found.share), SHARE_BAR, "all")
    yield row("gradient", gradient(small), GRADIENT_BAR, "central differences")
    more = {"quantity": "a step of the full body", "of": found.num_cells}
    yield Row("sorojax", more, run_s=full_step)
    for members in MEMBERS:
        took = per_step(small, members, 200 if members < 1000 else 20)
        more = {"quantity": "a step of a member", "members": members} | cells
        bar = STEP_BAR if members == 1 else MEMBER_BAR
        yield Row("sorojax", more, run_s=took, bar=bar, bar_on="run_s")
