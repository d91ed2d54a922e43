"""The soft finger D1 released at rest, 0.5 s, tips every 10 ms; by `jax.jit`, and by
`sorojax.jit`."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers
from benchmarks.fingers import LENGTH, MODES, accelerate, finger, tip
from benchmarks.harness import Row, measure, measure_calls, quick
from sorojax import jit
from sorojax.math.ode.steppers import DormandPrince, GeneralisedAlpha, RungeKutta4
from sorojax.rod import Gravity, operators
from sorojax.rod.dynamics.rollout import rollout

DURATION, SAVE = 0.5, 0.01  # s
SAVES = round(DURATION / SAVE)
REFERENCE = "16 nodes, Dopri8 to 1e-10, RMS of tip distance / length"
PUBLISHED_TIP = np.array([7.999903e-2, 0.0, -3.7232e-4])  # m at 0.5 s, by another code
PUBLISHED_DIGITS = 2e-8  # m
STEPS = (
    (GeneralisedAlpha(1.0), (5e-3, 2e-3, 1e-3)),
    (RungeKutta4(), (1e-3, 5e-4)),
    (DormandPrince(), (1e-3, 5e-4)),
)


def own(rod, stepper, step):
    """Tips by a fixed-step method of sorojax (times, 3) [m]."""
    rest, constants = jnp.zeros(rod.basis.num_dof), operators(rod)
    path = rollout(
        rod,
        rest,
        rest,
        (Gravity(),),
        step=step,
        saves=SAVES,
        every=round(SAVE / step),
        stepper=stepper,
    )
    return jax.vmap(lambda q: tip(rod, constants, q))(path.q[1:])


def stock(rod, solver, controller, dt0):
    """Tips by a solver of diffrax (times, 3) [m]."""
    constants = operators(rod)

    def field(t, state, args):
        q, v = state
        return v, accelerate(rod, constants, q, v)

    rest = jnp.zeros(rod.basis.num_dof)
    solution = dfx.diffeqsolve(
        dfx.ODETerm(field),
        solver,
        0.0,
        DURATION,
        dt0,
        (rest, rest),
        saveat=dfx.SaveAt(ts=jnp.arange(1, SAVES + 1) * SAVE),
        max_steps=1_000_000,
        stepsize_controller=controller,
        adjoint=dfx.ForwardMode(),
    )
    assert solution.ys is not None
    return jax.vmap(lambda q: tip(rod, constants, q))(solution.ys[0])


def reference():
    """Tips of the tight solution, held against the published last one."""
    tight = dfx.PIDController(rtol=1e-10, atol=1e-10)
    tips = np.asarray(jax.jit(lambda rod: stock(rod, dfx.Dopri8(), tight, 1e-4))(finger(16)))
    if np.abs(tips[-1] - PUBLISHED_TIP).max() > PUBLISHED_DIGITS:
        raise RuntimeError(f"the reference ends at {tips[-1]}, need {PUBLISHED_TIP}")
    return tips


def rows():
    want, rod = reference(), finger(8)

    def error(arrays):
        distance = np.linalg.norm(arrays["tips"] - want, axis=1) / LENGTH
        return float(np.sqrt(np.mean(distance**2)))

    def row(code, name, step, function, by="jax.jit"):
        settings = {"nodes": 8, "method": name, "step": step, "by": by}
        if by == "jax.jit":
            programs = []
            timing = measure(function, rod, repeats=5, keep=programs.append)
            tips = programs[0](rod)
        else:
            alone = jit(function)
            timing, tips = measure_calls(lambda: alone(rod), repeats=5), alone(rod)
        return Row(
            code, settings, **timing.columns(), error=error({"tips": tips}), reference=REFERENCE
        )

    few = quick("RungeKutta4")
    for stepper, steps in STEPS[::2] if few else STEPS:
        for h in steps[:1] if quick("steps shorter than the first of each method") else steps:
            run = lambda rod: own(rod, stepper, h)  # noqa: B023, E731
            for by in ("jax.jit", "sorojax.jit"):
                yield row("sorojax", type(stepper).__name__, h, run, by)
    peer_steps = (1e-3,) if quick("peers at 0.5 ms") else (1e-3, 5e-4)
    for h in peer_steps:
        fixed = dfx.ConstantStepSize()
        yield row("diffrax", "Tsit5", h, lambda rod: stock(rod, dfx.Tsit5(), fixed, h))  # noqa: B023
    for h in () if quick("soromox: it is in rod.acceleration") else peer_steps:
        yield peers.row(
            "soromox",
            "simulation",
            {},
            error,
            REFERENCE,
            nodes=8,
            modes=MODES,
            duration=DURATION,
            dt=h,
            save_dt=SAVE,
            repeats=3,
        )
