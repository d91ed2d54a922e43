"""Cost of contact: a step of the soft finger D1 with no, a far and a met obstacle, and with
contact with itself. Depth of contact: a rod that coils up until it lies on itself. What twice
the contact points change: at rest on a stone, and in the fall of a free rod into a corner."""

from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.fingers import finger
from benchmarks.harness import Row, measure_together
from sorojax import sdf
from sorojax.contact import LinePenalty
from sorojax.math import ContactMidpoint
from sorojax.math.lie import SE2
from sorojax.math.ode.steppers import start
from sorojax.rod import (
    Damping,
    Free,
    Gravity,
    ObstacleContact,
    Part,
    PartForce,
    SelfContact,
    assembly,
    chebyshev,
    circle,
    equilibrium,
    motion,
    part_motion,
    penetration,
    points,
    rod as make_rod,
    rollout,
)
from sorojax.rod.dynamics.rollout import second_order

STEPS, STEP, BATCH, BATCH_STEPS = 250, 1e-3, 64, 25
BAR = 0.05  # what a far obstacle may add, unbatched
DOUBLED_BAR = 0.02  # what twice the contact points may change
FINGER: Any = {"length": 0.08, "young_modulus": 1e6, "poisson_ratio": 0.3, "density": 2000.0}
LAW = LinePenalty(stiffness=5e7, smoothing=6e-6, friction=0.5)


def forces(obstacle):
    """Weight, and contact with a floor at a height [m] or with the rod itself."""
    if obstacle is None:
        return (Gravity(),)
    if obstacle == "itself":
        return (Gravity(), SelfContact(radius=6e-3, law=LAW, points=32))
    floor = sdf.HalfSpace([0.0, 0.0, obstacle], [0.0, 0.0, 1.0])
    return (Gravity(), ObstacleContact(obstacle=floor, radius=6e-3, law=LAW))


def loop(rod, loads, steps=STEPS):
    """Many steps from rest; returns the end."""
    stepper = ContactMidpoint()

    def run(q, v):
        problem = second_order(rod, q, loads)
        t, h = jnp.zeros(()), jnp.asarray(STEP)
        begin = start(problem, t, q, v)
        return jax.lax.fori_loop(0, steps, lambda _, s: stepper.step(problem, t, h, s), begin)

    return run


def coiling(stiffness):
    """Penetration over the radius for 1 s after a rod that rests in 1.08 turns is let
    go from 0.8 turns: the tip swings onto the base and comes to rest there.

    Deepest 0.81 % at 5e7 N/m^2, in the first touch.
    """
    radius = 3e-3
    rod = make_rod(
        SE2(),
        chebyshev(kappa_z=3),
        circle(radius),
        length=0.2,
        young_modulus=1e6,
        poisson_ratio=0.3,
        density=2000.0,
        nodes=20,
        rest_strain=[34.0, 1.0, 0.0],
    )
    law = LinePenalty(stiffness, smoothing=6e-6)
    contact = SelfContact(radius=radius, law=law, points=96)
    q = jnp.array([-9.0, 4.0, 0.5])
    path = rollout(rod, q, 0 * q, (Damping(1e-6), contact), step=1e-3, saves=1000)
    depth = jax.vmap(lambda q: penetration(contact, motion(rod, q)))(path.q)
    return depth / radius


def fallen(count):
    """Ends and middle of a free rod that falls for 0.2 s and bounces, in steps that resolve
    its impacts, which last 0.4 ms; 32 steps to a row."""
    rod = make_rod(SE2(), chebyshev(kappa_z=2), circle(6e-3), nodes=8, **FINGER)
    body = assembly(SE2(), rod=Part(rod, Free()))
    faces = sdf.Rectangle([-1.0, -1.0], [1.0, 0.0]), sdf.Rectangle([0.09, -1.0], [1.0, 1.0])
    options = {"radius": 6e-3, "law": LAW, "points": count, "caps": "both"}
    corner = (PartForce("rod", ObstacleContact(obstacle=face, **options)) for face in faces)
    q, v = jnp.array([-0.6, 0.0, 0.06, 0.0, 0.0]), jnp.array([0.0, 0.4, 0.0, 0.0, 0.0])
    path = rollout(body, q, v, (Gravity(), *corner), step=6.25e-5, saves=100, every=32)
    at = jnp.array([0.0, 0.5, 1.0])
    return jax.vmap(lambda q: points(part_motion(motion(body, q), 0), at).position)(path.q)


def lying(count):
    """Middle and end of a rod that its weight presses onto a round stone."""
    rod = make_rod(SE2(), chebyshev(kappa_z=3), circle(6e-3), **FINGER)
    stone = sdf.Circle([0.045, -0.014], 6e-3)
    contact = ObstacleContact(obstacle=stone, radius=6e-3, law=LAW, points=count)
    rest = equilibrium(rod, (Gravity(), contact))
    places = [
        points(motion(rod, q), jnp.array([0.5, 1.0])).position for q in (0 * rest.q, rest.q)
    ]
    return jnp.stack(places)


def doubled(scene):
    """Distance of two results over the travel, largest and mean: 32 and 64 points."""
    few, many = (jax.jit(scene, static_argnums=0)(count) for count in (32, 64))
    travel = jnp.max(jnp.linalg.norm(many - many[:1], axis=-1))
    apart = jnp.linalg.norm(few - many, axis=-1) / travel
    return float(jnp.max(apart)), float(jnp.mean(apart))


def rows():
    for name, scene in (("stone", lying), ("fall", fallen)):
        largest, mean = doubled(scene)
        yield Row(
            "sorojax",
            {"scene": name, "points": "32, 64", "mean": round(mean, 5)},
            error=largest,
            reference="travel",
            bar=DOUBLED_BAR,
            bar_on="error",
        )
    rod = finger(8)
    q = jnp.zeros(rod.basis.num_dof)
    cases = (("none", None), ("far", -0.2), ("itself", "itself"), ("met", -0.015))
    programs = {name: loop(rod, forces(obstacle)) for name, obstacle in cases}
    met = {"met": programs.pop("met")}  # 30 times as long
    timings = measure_together(programs, q, q, repeats=200)
    yield from compared(timings | measure_together(met, q, q, repeats=10), STEPS, {})
    many = jnp.zeros((BATCH, q.shape[0]))
    programs = {
        name: jax.vmap(loop(rod, forces(obstacle), BATCH_STEPS)) for name, obstacle in cases[:2]
    }
    timings = measure_together(programs, many, many, repeats=6)
    yield from compared(timings, BATCH_STEPS * BATCH, {"batch": BATCH})
    depth = float(jnp.max(jax.jit(coiling)(LAW.stiffness)))
    settings = {"scene": "coil", "stiffness": float(LAW.stiffness)}
    yield Row("sorojax", settings, error=depth, reference="radius", bar=0.01, bar_on="error")


def compared(timings, steps, settings):
    """Rows with what each adds to the best time without an obstacle, per step."""
    plain = min(timings["none"].runs)
    for name, timing in timings.items():
        extra, timing = min(timing.runs) / plain - 1, timing.per(steps)
        is_barred = name == "far" and not settings
        yield Row(
            "sorojax",
            {"obstacle": name} | settings,
            **timing.columns(),
            error=extra,
            reference="extra over none",
            bar=BAR if is_barred else None,
            bar_on="error",
        )
