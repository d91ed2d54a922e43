"""Cost of contact: a step of the soft finger D1 with no, a far, a near and a met obstacle."""

import jax
import jax.numpy as jnp

from benchmarks.fingers import finger
from benchmarks.harness import Row, measure
from sorojax import sdf
from sorojax.contact import LinePenalty
from sorojax.math.contact_stepper import ContactMidpoint
from sorojax.math.steppers import start
from sorojax.rod import Gravity, ObstacleContact, SelfContact
from sorojax.rod.rollout import second_order

STEPS, STEP, BATCH = 500, 1e-3, 64
BAR = 0.05  # what a far obstacle may add, unbatched
LAW = LinePenalty(stiffness=5e7, smoothing=6e-6, friction=0.5)


def forces(obstacle):
    """Weight, and contact with a floor at a height [m] or with the rod itself."""
    if obstacle is None:
        return (Gravity(),)
    if obstacle == "itself":
        return (Gravity(), SelfContact(6e-3, LAW, points=32))
    floor = sdf.HalfSpace([0.0, 0.0, obstacle], [0.0, 0.0, 1.0])
    return (Gravity(), ObstacleContact(floor, 6e-3, LAW))


def loop(rod, loads):
    """Many steps from rest; returns the end."""
    stepper = ContactMidpoint()

    def run(q, v):
        problem = second_order(rod, q, loads, unroll=False)
        t, h = jnp.zeros(()), jnp.asarray(STEP)
        begin = start(problem, t, q, v)
        return jax.lax.fori_loop(0, STEPS, lambda _, s: stepper.step(problem, t, h, s), begin)

    return run


def rows():
    rod = finger(8)
    q = jnp.zeros(rod.basis.num_dof)
    cases = (("none", None), ("far", -0.2), ("itself", "itself"), ("met", -0.015))
    programs = {name: loop(rod, forces(obstacle)) for name, obstacle in cases}
    timings = {
        name: measure(run, q, q, repeats=25).per(STEPS) for name, run in programs.items()
    }
    yield from compared(timings, {})
    many = jnp.zeros((BATCH, q.shape[0]))
    timings = {
        name: measure(jax.vmap(programs[name]), many, many, repeats=5).per(STEPS * BATCH)
        for name in ("none", "far")
    }
    yield from compared(timings, {"batch": BATCH})


def compared(timings, settings):
    """Rows with what each adds to the best time without an obstacle."""
    plain = min(timings["none"].runs)
    for name, timing in timings.items():
        extra = min(timing.runs) / plain - 1
        is_barred = name == "far" and not settings
        yield Row(
            "sorojax", {"obstacle": name} | settings, **timing.columns(), error=extra,
            reference="extra over none", bar=BAR if is_barred else None, bar_on="error",
        )  # fmt: skip
