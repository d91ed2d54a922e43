"""Energy of the undamped finger D1 over 10 s: largest drift over the largest elastic energy."""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.fingers import finger
from benchmarks.harness import Row, measure
from sorojax.math.ode.steppers import (
    DormandPrince,
    GeneralisedAlpha,
    ImplicitMidpoint,
    RungeKutta4,
    TripleJump,
)
from sorojax.rod import Gravity, kinetic_energy, potential_energy, rollout

DURATION, SAVE = 10.0, 0.05  # s
BAR = 1e-5
REFERENCE = "energy at the start, in the largest elastic energy"
STEPS = (
    (GeneralisedAlpha(1.0), 1e-3, None),
    (ImplicitMidpoint(), 1e-3, None),
    (TripleJump(), 1e-3, BAR),
    (RungeKutta4(), 2.5e-4, None),
    (DormandPrince(), 5e-4, None),
    (DormandPrince(), 2.5e-4, BAR),
)


def path(rod, stepper, step):
    rest = jnp.zeros(rod.basis.num_dof)
    run = rollout(
        rod,
        rest,
        rest,
        (Gravity(),),
        step=step,
        saves=round(DURATION / SAVE),
        every=round(SAVE / step),
        stepper=stepper,
    )
    return run.q, run.v


def drift(rod, q, v):
    down = jnp.array([0.0, 0.0, -9.81])
    total = jax.vmap(lambda q, v: kinetic_energy(rod, q, v) + potential_energy(rod, q, down))(
        q, v
    )
    elastic = jax.vmap(lambda q: potential_energy(rod, q))(q)
    return float(np.abs(total - total[0]).max() / elastic.max())


def rows():
    rod = finger(8)
    for stepper, h, bar in STEPS:
        run = lambda rod: path(rod, stepper, h)  # noqa: B023, E731
        timing = measure(run, rod, repeats=2)
        settings = {"nodes": 8, "method": type(stepper).__name__, "step": h}
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            error=drift(rod, *jax.jit(run)(rod)),
            reference=REFERENCE,
            bar=bar,
            bar_on="error",
        )
