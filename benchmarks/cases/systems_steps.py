"""Steps from far too long to short: which runs call themselves successful.

200 scenes drawn at random, 40 of each of five kinds, each by six fixed steps, against a
reference. The error is the largest distance from it over all saved instants, over the largest
distance of the reference from its start, of every state that is no rate.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness import Row
from sorojax import rod, systems
from sorojax.math.lie import SE2
from sorojax.math.ode.explicit import RungeKutta4, Tsit5
from sorojax.math.ode.step_control import positions
from sorojax.math.ode.steppers import (
    DormandPrince,
    GeneralisedAlpha,
    ImplicitMidpoint,
    RungeKutta4 as SecondOrderRungeKutta4,
)
from sorojax.math.status import Status
from sorojax.systems.blocks.block import AbstractBlock, Output

DRAWS, SAVES = 40, 20
REFERENCE = "steps of a fiftieth of the shortest by Dormand-Prince, or adaptive to 1e-9"


class Oscillator(AbstractBlock):
    """Two masses in a row, each on a stiff spring, pushed from the start on."""

    omega: jax.Array
    damping: jax.Array
    ratio: jax.Array

    @property
    def inputs(self):
        return {}

    @property
    def outputs(self):
        return {"x": Output("m", (2,))}

    def initial_state(self):
        return {"x": jnp.zeros(2), "v": jnp.zeros(2)}

    def output(self, name, t, state, inputs):
        return state["x"]

    def vector_field(self, t, state, inputs):
        x, v = state["x"], state["v"]
        omega = self.omega * jnp.array([1.0, 1.0]) * jnp.stack([jnp.ones(()), self.ratio])
        between = 0.1 * self.omega**2 * (x[1] - x[0]) * jnp.array([1.0, -1.0])
        force = 1.0 + between - omega**2 * (x + x**3) - 2 * self.damping * omega * v
        return {"x": v, "v": force}


def regulated(draw):
    """A regulator that fills a vessel, with gains over three decades."""
    gain, integral, volume, target, limit = draw.T
    make = lambda g, k, v, p, m: systems.Network(  # noqa: E731
        {
            "target": systems.Source(systems.Constant(p), unit="Pa"),
            "valve": systems.Regulator(g, k, max_flow=m),
            "air": systems.Reservoir(volume=v),
        },
        {
            "valve.setpoint": "target.value",
            "valve.pressure": "air.pressure",
            "air.mass_flow": "valve.mass_flow",
        },
    )
    scale = 10.0 ** (3 * gain - 9), 10.0 ** (2 * integral - 8), 10.0 ** (2 * volume - 5)
    return make, (*scale, 2e4 * (target + 0.1), 10.0 ** (4 * limit - 4))


def masses(draw):
    """Two masses of 1 to 30 Hz."""
    omega, damping, ratio, *_ = draw.T
    make = lambda *given: systems.Network({"masses": Oscillator(*given)}, {})  # noqa: E731
    return make, (2 * np.pi * 30.0**omega, 0.3 * damping, 1 + 9 * ratio)


def network_runs(scenes, method) -> tuple[Callable, Callable]:
    make, numbers = scenes
    numbers = tuple(map(jnp.asarray, numbers))

    def run(step):
        def one(*given):
            film = systems.simulate(
                make(*given), 1.0, save=SAVES + 1, step=step, solver=method, throw=False
            )
            return positions(film.state), film.status

        return jax.jit(jax.vmap(one))(*numbers)

    def reference():
        def one(*given):
            film = systems.simulate(
                make(*given),
                1.0,
                save=SAVES + 1,
                rtol=1e-9,
                atol=1e-12,
                throw=False,
                solver=systems.Rodas4(),
                max_steps=100_000,
            )
            return positions(film.state)

        return jax.jit(lambda *x: jax.lax.map(lambda y: one(*y), x))(*numbers)

    return run, reference


def rods(draw, stepper):
    """Fingers that fall from rest: stiffness over a decade and a half, all thicknesses."""
    stiff, thick, damping, *_ = draw.T
    numbers = (10.0 ** (4.8 + 1.5 * stiff), 4e-3 * (1 + thick), 2e-3 * 10.0 ** (1.5 * damping))

    def go(step, saves, every, stepper):
        def one(modulus, radius, damping):
            body = rod.rod(
                SE2(),
                rod.chebyshev(kappa_z=2, sigma_x=1),
                rod.circle(radius),
                length=0.12,
                young_modulus=modulus,
                poisson_ratio=0.45,
                density=1100.0,
                nodes=6,
            )
            forces = rod.Gravity(), rod.Damping(damping)
            rest = jnp.zeros(body.basis.num_dof)
            path = rod.rollout(
                body, rest, rest, forces, step=step, saves=saves, every=every, stepper=stepper
            )
            return [path.q], path.status

        return jax.jit(jax.vmap(one))(*map(jnp.asarray, numbers))

    def run(step):
        every = max(1, round(1.0 / SAVES / step))
        return go(1.0 / SAVES / every, SAVES, every, stepper)

    def reference():
        return go(2e-5, SAVES, round(1.0 / SAVES / 2e-5), DormandPrince())[0]

    return run, reference


def kinds():
    draw = np.random.default_rng(4).uniform(size=(5, DRAWS, 5))
    yield "regulated vessel", "RungeKutta4", *network_runs(regulated(draw[0]), RungeKutta4())
    yield "two masses", "Tsit5", *network_runs(masses(draw[1]), Tsit5())
    yield "rod", "GeneralisedAlpha", *rods(draw[2], GeneralisedAlpha())
    yield "rod", "ImplicitMidpoint", *rods(draw[3], ImplicitMidpoint())
    yield "rod", "RungeKutta4", *rods(draw[4], SecondOrderRungeKutta4())


def judge(found, want):
    """Error of every member, infinite where it is not finite."""
    errors = []
    for x, y in zip(found, want, strict=True):
        x, y = (np.asarray(a).reshape(*a.shape[:2], -1) for a in (x, y))
        motion = np.abs(y - y[:, :1]).max(axis=(1, 2))
        distance = np.abs(x - y).max(axis=(1, 2))
        errors.append(np.where(motion > 0, distance / np.where(motion > 0, motion, 1), 0))
    worst = np.max(errors, axis=0)
    return np.where(np.isfinite(worst), worst, np.inf)


def rows():
    every = []
    for kind, method, run, reference in kinds():
        want = reference()
        for step in (0.05, 0.02, 0.01, 5e-3, 2e-3, 5e-4):
            found, status = run(step)
            errors, good = judge(found, want), np.asarray(status == Status.successful)
            every.append((errors, good))
            count = {
                "accurate": int((errors < 0.01).sum()),
                "of them flagged": int((~good & (errors < 0.01)).sum()),
                "beyond the motion": int((errors > 1).sum()),
                "of them successful": int((good & (errors > 1)).sum()),
            }
            yield Row("sorojax", {"scene": kind, "method": method, "step": step, **count})
    errors, good = (np.concatenate(x) for x in zip(*every, strict=True))
    missed = (good & (errors > 1)).sum()
    flagged = (~good & (errors < 0.01)).sum() / (errors < 0.01).sum()
    wrong, early = {"what": "wrong and successful"}, {"what": "accurate and flagged, share"}
    for settings, error, bar in ((wrong, missed, 0.0), (early, flagged, 0.01)):
        yield Row(
            "sorojax",
            settings,
            error=float(error),
            bar=bar,
            bar_on="error",
            reference=REFERENCE,
        )
