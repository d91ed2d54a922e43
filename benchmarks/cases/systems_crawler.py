"""Crawlers reduced to a few shapes, the force of a few weighted points and the contact of their
surface, beside the full bodies: an inchworm on two feet with bristles, whose back one group of
chambers arches, and a crawler of three groups on its flat sole.

Trained on two motions, with lower and higher pressures than the one that is asked for, on
another floor; the way of a cycle, once the gait has settled, is compared.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import contact, fem, robots, systems
from sorojax.math.compiled import batched, chunked_lanes
from sorojax.systems.integrate.modal_step import first_acceleration, modal_step
from sorojax.units import kPa, mm

RATE, CYCLES, TOLERANCE = 1.25, 3, 1e-2  # Hz
SHAPES = {"inchworm": 16, "flat sole": 20}
SIZE, STEP = 1.5 * mm, 1e-3
SEEN, ASKED = (6 * kPa, 8 * kPa), 7 * kPa
FLOORS = {"training": 1.0, "asked": 0.85}  # coefficients of friction, over the usual ones
EVERY = 6  # frames of training
DAMPING = fem.Rayleigh(mass=1.0, stiffness=1e-3)
ERROR_BAR, SHARE_BAR, STEP_BAR, MEMBER_BAR, GRADIENT_BAR = 1e-2, 0.02, 200e-6, 50e-6, 1e-5
MEMBERS = {"inchworm": (1, 64, 1024, 4096), "flat sole": (1, 64, 1024)}

CRAWLERS = {
    "inchworm": robots.Crawler(60 * mm, num_groups=1, foot_height=2 * mm),
    "flat sole": robots.Crawler(),
}


def bristles(share):
    return contact.DirectionalCoulomb(0.3 * share, 0.9 * share, [1.0, 0.0])


def rough(share):
    return contact.Coulomb(0.6 * share)


FRICTIONS = {"inchworm": bristles, "flat sole": rough}


class Gait(systems.AbstractReference):
    """The pressure of one group of chambers, of which others are ahead or behind."""

    air: jax.Array
    ports: tuple[str, ...] = eqx.field(static=True)
    port: str = eqx.field(static=True)

    def __call__(self, t):
        return robots.crawler_gait(self.air, RATE, ports=self.ports)[self.port](t)


class Scene:
    """A crawler on its floor."""

    def __init__(self, name):
        self.crawler, self.friction = CRAWLERS[name], FRICTIONS[name]
        self.ports = self.crawler.ports

    def problem(self, share):
        friction = self.friction(share)
        return robots.crawler_problem(self.crawler, size=SIZE, friction=friction)

    def body(self):
        problem = self.problem(FLOORS["training"])
        return systems.FemBody(problem, damping=DAMPING, driven=self.ports)

    def gait(self, air):
        return robots.crawler_gait(air, RATE, ports=self.ports)

    def walked(self, share, air, step=STEP):
        """The motion of the full body."""
        problem, duration = self.problem(share), CYCLES / RATE
        return fem.simulate(problem, duration, step, damping=DAMPING, **self.gait(air))

    def crawled(self, small, air):
        """The motion of the reduced body in a network."""
        goals = {
            port: systems.Source(Gait(jnp.asarray(air), self.ports, port), unit="Pa")
            for port in self.ports
        }
        wires = {f"body.{port}_pressure": f"{port}.value" for port in self.ports}
        network = systems.Network({"body": small, **goals}, wires)
        return systems.simulate(network, CYCLES / RATE, save=1201, step=STEP)

    def stepped(self, small, count):
        """Mean of the coordinates after `count` steps in the middle of a cycle, by a factor of
        the pressures."""
        state, h = small.initial_state(), jnp.asarray(STEP)

        def run(factor):
            gait = {f"{port}_pressure": at for port, at in self.gait(factor * ASKED).items()}

            def one(carry, number):
                state, a = carry
                t = number * h
                inputs = {name: at(t) for name, at in gait.items()}
                moved = modal_step(small, inputs, state, a, h)
                return (moved.state, moved.acceleration), None

            rest = {name: 0 * factor for name in gait}
            start = state, first_acceleration(small, rest, state)
            numbers = jnp.arange(count, dtype=h.dtype)
            (end, _), _ = jax.lax.scan(one, start, numbers)
            return jnp.mean(end["q"])

        return run


def centre(displacements, of):
    """Way of the centre of mass along the floor and above it [m]."""
    shares = fem.lumped_mass(of)[::2] / fem.total_mass(of)
    return np.asarray(jnp.einsum("n,tni->ti", shares, displacements))


def way(times, along):
    """Of the last cycle, along the floor [m]."""
    ends = np.interp(np.array([CYCLES - 1, CYCLES]) / RATE, np.asarray(times), along[:, 0])
    return float(ends[1] - ends[0])


def per_step(run, count, members):
    """CPU time of a step of one member [s], in chunks as environments take them."""
    run = jax.jit(batched(chunked_lanes(run)))
    factors = jnp.linspace(0.8, 1.1, members)
    jax.block_until_ready(run(factors))
    times = []
    for _ in range(3 if members < 1000 else 1):
        start = time.process_time()
        jax.block_until_ready(run(factors))
        times.append(time.process_time() - start)
    return min(times) / count / members


def gradient(run):
    """Derivative of a run by the pressures, over that of differences."""
    run = jax.jit(run)
    found = float(jax.jit(jax.grad(run))(jnp.asarray(1.0)))
    h = 1e-6  # by 1e-5 differences are 1.5e-4 off on the flat sole
    want = (8 * (run(1 + h) - run(1 - h)) - (run(1 + 2 * h) - run(1 - 2 * h))) / (12 * h)
    return abs(found / float(want) - 1)


def compared(name):
    """Rows of one crawler."""
    scene = Scene(name)
    motions = [scene.walked(FLOORS["training"], air, 2 * STEP) for air in SEEN]
    start = time.perf_counter()
    frames = [motion.displacements[::EVERY] for motion in motions]
    found = systems.sampled_body(
        scene.body(), motions=frames, modes=SHAPES[name], tolerance=TOLERANCE
    )
    took = time.perf_counter() - start
    law = scene.friction(FLOORS["asked"])
    small = eqx.tree_at(lambda b: b.contacts[0].slider.law, found.body, law)
    cells = {
        "crawler": name,
        "shapes": len(small.basis),
        "points": len(found.cells),
        "cells": len(np.unique(found.cells)),
        "of": found.num_cells,
    }
    start = time.process_time()
    want = scene.walked(FLOORS["asked"], ASKED)
    full_step = (time.process_time() - start) / (CYCLES / RATE / STEP)
    of = scene.problem(FLOORS["asked"])
    asked = centre(want.displacements, of)
    film = scene.crawled(small, ASKED)
    moved = jax.vmap(lambda q: systems.displacement(small.basis, q))(film.state["body"]["q"])
    seen = centre(moved, of)
    ways = way(film.time, seen), way(want.time, asked)
    height = np.interp(np.asarray(want.time), np.asarray(film.time), seen[:, 1])
    height = np.abs(height - asked[:, 1]).max() / np.ptp(asked[:, 1])

    def row(of, error, bar, reference, **columns):
        known = cells | {"quantity": of}
        columns |= {"error": error, "reference": reference, "bar": bar, "bar_on": "error"}
        return Row("sorojax", known, **columns)

    reference = f"the full body, {ways[1] / mm:.3f} mm for {ways[0] / mm:.3f} mm"
    error = abs(ways[0] / ways[1] - 1)
    yield row("way of a cycle", error, ERROR_BAR, reference, compile_s=took)
    yield row("height of the centre", height, ERROR_BAR, "the full body, over its range")
    yield row("share of the quadrature points", float(found.share), SHARE_BAR, "all")
    slope = gradient(scene.stepped(small, 200))
    yield row("gradient", slope, GRADIENT_BAR, "central differences")
    yield Row("sorojax", cells | {"quantity": "a step of the full body"}, run_s=full_step)
    for members in MEMBERS[name]:
        count = 800 if members == 1 else 200  # a cycle, or its first quarter
        took = per_step(scene.stepped(small, count), count, members)
        known = cells | {"quantity": "a step of a member", "members": members}
        bar = STEP_BAR if members == 1 else MEMBER_BAR
        yield Row("sorojax", known, run_s=took, bar=bar, bar_on="run_s")


def rows():
    for name in CRAWLERS:
        yield from compared(name)
