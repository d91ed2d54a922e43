"""The soft finger D1 with stretch and shear, released at rest: error against the continuum.

Planar, as the motion is: bending, stretch and shear modes by name. The reference has seven
bending and six stretch and shear modes and is held against the tip of another code. PyElastica
has the same rod; a cable of MuJoCo bends only.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers
from benchmarks.fingers import LENGTH
from benchmarks.harness import Row, measure, quick
from sorojax.math.lie import SE2
from sorojax.math.ode.steppers import GeneralisedAlpha
from sorojax.rod import (
    Gravity,
    chebyshev,
    circle,
    motion,
    operators,
    rod,
    rollout,
    vector_field,
)
from sorojax.units import MPa, mm

WORKERS = 1  # nothing here calls the host
DURATION, SAVE = 0.5, 0.01  # s
SAVES = round(DURATION / SAVE)
PUBLISHED_TIP = np.array([7.999048e-2, -1.01831e-3])  # m at 0.5 s, by another code
PUBLISHED_DIGITS = 1e-5  # m; the motion is not converged in modes to more
ERROR_BAR, TIME_BAR = 5e-4, 10e-3  # of the length; s
SETTINGS = (((4, 3, 3), 1e-3), ((5, 4, 4), 1e-3), ((5, 4, 4), 5e-4))
REFERENCE = "modes 7, 6, 6, Dopri8 to 1e-9, RMS of tip distance / length"
#: Elements, and steps in terms of the time that a wave of strain needs for one; ten elements
#: diverge at 0.8.
ELASTICA = ((10, 0.3), (20, 0.8), (40, 0.8))
#: Links, integrator, step [s]; implicit steps of 1 ms are unstable.
CABLES = ((10, "implicitfast", 2e-4), (20, "RK4", 2e-4), (40, "RK4", 1e-4))


def finger(bend, stretch, shear):
    basis = chebyshev(kappa_z=bend, sigma_x=stretch, sigma_y=shear)
    return rod(
        SE2(),
        basis,
        circle(6 * mm, shear_factor=27 / 28),
        length=LENGTH,
        young_modulus=1 * MPa,
        poisson_ratio=0.3,
        density=2000.0,
        nodes=bend + 5,
    )


def tips(body, q):
    constants = operators(body)
    return jax.vmap(lambda q: constants.weights @ motion(body, q, constants=constants).tangent)(
        q
    )


def stepped(step):
    def run(body):
        rest = jnp.zeros(body.basis.num_dof)
        path = rollout(
            body,
            rest,
            rest,
            (Gravity(),),
            step=step,
            saves=SAVES,
            every=round(SAVE / step),
            stepper=GeneralisedAlpha(1.0),
        )
        return tips(body, path.q[1:])

    return run


@jax.jit
def reference(body):
    rest = jnp.zeros(body.basis.num_dof)
    solution = dfx.diffeqsolve(
        dfx.ODETerm(vector_field(body, (Gravity(),))),
        dfx.Dopri8(),
        0.0,
        DURATION,
        1e-5,
        (rest, rest),
        saveat=dfx.SaveAt(ts=jnp.arange(1, SAVES + 1) * SAVE),
        max_steps=1_000_000,
        adjoint=dfx.ForwardMode(),
        stepsize_controller=dfx.PIDController(rtol=1e-9, atol=1e-9),
    )
    assert solution.ys is not None
    return tips(body, solution.ys[0])


def rows():
    want = np.asarray(reference(finger(7, 6, 6)))
    if np.abs(want[-1] - PUBLISHED_TIP).max() > PUBLISHED_DIGITS:
        raise RuntimeError(f"the reference ends at {want[-1]}, need {PUBLISHED_TIP}")

    def error(tips):
        gap = np.linalg.norm(np.asarray(tips) - want, axis=1) / LENGTH
        return float(np.sqrt(np.mean(gap**2)))

    for number, (modes, step) in enumerate(SETTINGS):
        body, run = finger(*modes), stepped(step)
        programs = []
        timing = measure(run, body, repeats=5, keep=programs.append)
        settings = {"modes": modes, "step": step}
        yield Row(
            "sorojax",
            settings,
            **timing.columns(),
            error=error(programs[0](body)),
            reference=REFERENCE,
            bar=ERROR_BAR,
            bar_on="error",
        )
        if number == 0:
            settings |= {"bar": "time"}
            yield Row("sorojax", settings, **timing.columns(), bar=TIME_BAR)
    yield from _peers(lambda arrays: error(arrays["tips"][:, [0, 2]]))


def _peers(error):
    """Fewer elements where time is short."""
    some = slice(1, 2) if quick("peers but with 20 elements or links") else slice(None)
    common = {"duration": DURATION, "save_dt": SAVE, "repeats": 3}
    for elements, share in ELASTICA[some]:
        yield peers.row(
            "pyelastica",
            "simulation",
            {},
            error,
            REFERENCE,
            elements=elements,
            share=share,
            **common,
        )
    for links, method, dt in CABLES[some]:
        yield peers.row(
            "mujoco",
            "simulation",
            {},
            error,
            REFERENCE,
            links=links,
            method=method,
            dt=dt,
            **common,
        )
