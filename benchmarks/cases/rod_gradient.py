"""Derivatives of the finger D1 against central differences, and what they cost to compile.

The tip and the energy at a bent state, and the mean square height of the tip over 1 s of
motion on a tendon, by Young's modulus, radius, length, routing and the first state.
Compiled by `sorojax.jit`, and beside it by `jax.jit`.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row, measure, measure_calls
from sorojax import jit
from sorojax.math.lie import SE3
from sorojax.rod import (
    Damping,
    Gravity,
    Straight,
    Tendons,
    chebyshev,
    circle,
    potential_energy,
    rod,
    rollout,
    tip_pose,
)
from sorojax.units import MPa, mm

BAR, COMPILE_BAR = 1e-7, 10.0  # relative; s
SAVES, STEP = 50, 2e-3  # 1 s in steps of 2 ms, ten to a sample
BENT = np.array([8.0, -3.0, 1.0, 5.0, 2.0, -1.0])  # 1/m
START = {"young": 1 * MPa, "radius": 6 * mm, "length": 80 * mm, "place": 4 * mm, "state": 1.0}


def make(p):
    return rod(
        SE3(),
        chebyshev(kappa_y=3, kappa_z=3),
        circle(p["radius"]),
        length=p["length"],
        young_modulus=p["young"],
        poisson_ratio=0.3,
        density=2000.0,
        nodes=8,
    )


def tip(p):
    return tip_pose(make(p), p["state"] * BENT)[2, 3] / (80 * mm)


def energy(p):
    return potential_energy(make(p), p["state"] * BENT) / 1e-3


def trajectory(p):
    body, q = make(p), 0.2 * p["state"] * BENT
    place = jnp.stack([jnp.zeros_like(p["place"]), p["place"]])
    loads = (Gravity(), Damping(0.01), Tendons(Straight(place), 0.05))
    path = rollout(body, q, 0 * q, loads, step=STEP, saves=SAVES, every=10)
    heights = jax.vmap(lambda q: tip_pose(body, q)[2, 3])(path.q)
    return jnp.mean((heights / (80 * mm)) ** 2)


def differences(cost, p):
    """Slopes by relative size: fourth-order central differences."""
    run = jax.jit(cost)

    def at(name, h):
        return float(run({**p, name: p[name] * (1 + h)}))

    def slope(name, h=2e-3):
        near, far = at(name, h) - at(name, -h), at(name, 2 * h) - at(name, -2 * h)
        return (8 * near - far) / (12 * h)

    return {name: slope(name) for name in p}


def rows():
    p = {name: jnp.asarray(value) for name, value in START.items()}
    for name, cost in (("tip", tip), ("energy", energy), ("trajectory", trajectory)):
        wanted = differences(cost, p)
        scale = max(abs(w) for w in wanted.values())
        for mode, slope in (("reverse", jax.grad(cost)), ("forward", jax.jacfwd(cost))):
            alone = jit(slope)
            timings = {
                "sorojax.jit": measure_calls(lambda alone=alone: alone(p), repeats=3),
                "jax.jit": measure(slope, p, repeats=3),
            }
            found = alone(p)
            error = max(abs(float(found[k] * p[k]) - wanted[k]) for k in p) / scale
            settings = {"of": name, "mode": mode}
            yield Row(
                "sorojax",
                settings,
                **timings["sorojax.jit"].columns(),
                error=error,
                reference="central differences, order 4",
                bar=BAR,
                bar_on="error",
            )
            for by, timing in timings.items():
                yield Row(
                    "sorojax",
                    settings | {"bar": "compile", "by": by},
                    **timing.columns(),
                    bar=COMPILE_BAR,
                    bar_on="compile_s",
                )
