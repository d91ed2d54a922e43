"""The soft finger D1 with retardation 0.01 s, released at rest, 0.5 s, tips every 10 ms;
by `jax.jit`, and by `sorojax.jit`."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.fingers import LENGTH, finger, tip
from benchmarks.harness import Row, measure, measure_calls
from sorojax import jit
from sorojax.math.ode.steppers import GeneralisedAlpha, ImplicitMidpoint, TripleJump
from sorojax.rod import Damping, Gravity, operators, rollout, vector_field

DURATION, SAVE = 0.5, 0.01  # s
SAVES = round(DURATION / SAVE)
FORCES = (Gravity(), Damping(0.01))
REFERENCE = "16 nodes, Dopri8 to 1e-10, RMS of tip distance / length"
PUBLISHED_TIP = np.array([7.917524e-2, 0.0, -1.071715e-2])  # m at 0.5 s, by another code
PUBLISHED_DIGITS = 2e-8  # m
BAR = 5e-3  # s of the triple jump at 5 ms steps, with an error of 1.3e-5
STEPS = (
    (GeneralisedAlpha(0.8), (5e-3, 2e-3, 1e-3)),
    (ImplicitMidpoint(), (5e-3, 1e-3)),
    (TripleJump(), (5e-3, 2e-3, 1e-3)),
)


def own(rod, stepper, step):
    """Tips by a fixed-step method (times, 3) [m]."""
    rest, constants = jnp.zeros(rod.basis.num_dof), operators(rod)
    path = rollout(
        rod,
        rest,
        rest,
        FORCES,
        step=step,
        saves=SAVES,
        every=round(SAVE / step),
        stepper=stepper,
    )
    return jax.vmap(lambda q: tip(rod, constants, q))(path.q[1:])


def reference():
    """Tips of the tight solution, held against the published last one."""
    rod = finger(16)
    rest = jnp.zeros(rod.basis.num_dof)

    def solve(rod):
        solution = dfx.diffeqsolve(
            dfx.ODETerm(vector_field(rod, FORCES)),
            dfx.Dopri8(),
            0.0,
            DURATION,
            1e-4,
            (rest, rest),
            saveat=dfx.SaveAt(ts=jnp.arange(1, SAVES + 1) * SAVE),
            stepsize_controller=dfx.PIDController(rtol=1e-10, atol=1e-10),
            max_steps=1_000_000,
            adjoint=dfx.ForwardMode(),
        )
        assert solution.ys is not None
        return jax.vmap(lambda q: tip(rod, operators(rod), q))(solution.ys[0])

    tips = np.asarray(jax.jit(solve)(rod))
    if np.abs(tips[-1] - PUBLISHED_TIP).max() > PUBLISHED_DIGITS:
        raise RuntimeError(f"the reference ends at {tips[-1]}, need {PUBLISHED_TIP}")
    return tips


def rows():
    want, rod = reference(), finger(8)
    for stepper, steps in STEPS:
        for h in steps:
            run = lambda rod: own(rod, stepper, h)  # noqa: B023, E731
            alone = jit(run)
            timings = {
                "jax.jit": measure(run, rod, repeats=5),
                "sorojax.jit": measure_calls(lambda: alone(rod), repeats=5),  # noqa: B023
            }
            distance = np.linalg.norm(alone(rod) - want, axis=1) / LENGTH
            barred = isinstance(stepper, TripleJump) and h == 5e-3
            for by, timing in timings.items():
                yield Row(
                    "sorojax",
                    {"nodes": 8, "method": type(stepper).__name__, "step": h, "by": by},
                    **timing.columns(),
                    error=float(np.sqrt(np.mean(distance**2))),
                    reference=REFERENCE,
                    bar=BAR if barred else None,
                )
