"""Steps of environments of rods a second: reach, tentacle, tracking, crawler.

Each member has numbers of its own. A step is 20 ms: 20 steps of physics of 1 ms, measurements,
reward. `run_s` is that of one member of a batch, one over the steps a second. The finger is
timed with five steps of 4 ms too, and its motion alone, under pressures that stay, beside
soromox, which has no tasks. Grasps and solids are in `envs.contact_steps`.
"""

import dataclasses

import jax
import numpy as np

from benchmarks import peers
from benchmarks.harness import Row, measure
from benchmarks.task_steps import sizes, steps
from sorojax import envs
from sorojax.envs.tasks import finger

WORKERS = 1  # nothing here calls the host
TASKS = {
    "finger reach": envs.FingerReach(),
    "finger reach, 5 of 4 ms": envs.FingerReach(time_step=4e-3, substeps=5),
    "tentacle push": envs.TentaclePush(),
    "tip tracking": envs.TipTracking(),
    "crawler": envs.CrawlerRun(),
}
NUMBERS = (
    "length",
    "radius",
    "young_modulus",
    "density",
    "damping",
    "chamber_offset",
    "chamber_area",
    "gravity",
)
FINE = "tip, by the length, against steps of 0.01 ms"


def tips(env, pressures):
    """Where fingers at rest are after a step of the task under pressures [Pa] that stay [m]."""
    params = env.default_params()

    def tip(pressure):
        held = finger.hanging(params)
        after, _ = env.moved(held, lambda t: pressure, None, params)
        return env.markers(after, params)[-1]

    return jax.vmap(tip)(pressures)


def motions():
    """Of the finger alone, 20 steps of 1 ms, in both codes."""
    env = TASKS["finger reach"]
    params, fine = env.default_params(), envs.FingerReach(time_step=1e-5, substeps=2000)
    case = {"case": "finger, motion alone", "against": "members"}
    draw = np.random.default_rng(0)
    for members in sizes():
        pressures = draw.uniform(0, params.max_pressure, (members, 3))
        want = np.asarray(jax.jit(lambda p: tips(fine, p))(pressures[:8]))

        def error(arrays, want=want):
            return float(np.abs(arrays["tips"][:8] - want).max() / params.length)

        own, programs = lambda p: tips(env, p), []
        timing = measure(own, pressures, repeats=5, keep=programs.append)
        off = error({"tips": np.asarray(programs[0](pressures))})
        settings = case | {"members": members, "method": "midpoint"}
        columns = timing.per(members).columns()
        yield Row("sorojax", settings, **columns, error=off, reference=FINE)
        row = peers.row(
            "soromox",
            "members",
            {"pressures": pressures},
            error,
            FINE,
            nodes=6,
            chambers=3,
            poisson_ratio=finger.POISSON,
            steps=env.substeps,
            dt=env.time_step,
            repeats=3,
            **{name: float(getattr(params, name)) for name in NUMBERS},
        )
        told = {key: row.settings[key] for key in ("version", "reason") if key in row.settings}
        settings = case | {"members": members, "method": "Tsit5"} | told
        yield dataclasses.replace(row, settings=settings)


def rows():
    yield from motions()
    yield from steps(TASKS)
