"""Steps of environments a second: reach, tentacle, tracking, crawler, grasps, a reduced solid.

Each member has numbers of its own. A step is 20 ms: 20 steps of physics of 1 ms, or 10 of 2 ms
of grasps, or 5 of 4 ms of the solid, measurements, reward. `run_s` is that of one member of a
batch, one over the steps a second. The finger is timed with five steps of 4 ms too, and its
motion alone, under pressures that stay, beside soromox, which has no tasks.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import peers
from benchmarks.harness import Row, measure, measure_together, quick
from sorojax import envs
from sorojax.envs.tasks import finger

WORKERS = 1  # nothing here calls the host
SIZES = 1, 64, 1024, 8192
TASKS = {
    "finger reach": envs.FingerReach(),
    "finger reach, 5 of 4 ms": envs.FingerReach(time_step=4e-3, substeps=5),
    "tentacle push": envs.TentaclePush(),
    "tip tracking": envs.TipTracking(),
    "crawler": envs.CrawlerRun(),
    "ball turn": envs.BallTurn(),
    "pick and place": envs.PickPlace(),
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
SOLIDS = {"solid reach": envs.SolidReach, "solid crawl": envs.SolidCrawl}  # trained once


def batches(env, sizes):
    """Keys, states, actions and parameters of as many members, of 64 episodes or fewer."""
    usual, few = env.default_params(), min(64, max(sizes))
    keys = jax.random.split(jax.random.key(0), few)
    states = jax.jit(jax.vmap(lambda key: envs.reset(env, key, usual)[0]))(keys)
    for members in sizes:
        keys = jax.random.split(jax.random.key(1), members)
        own = envs.randomised(usual, keys[0], 0.1, members=members)
        actions = jax.random.uniform(keys[0], (members, env.num_actions), minval=-1.0)
        index = jnp.arange(members) % few
        yield members, (keys, jax.tree.map(lambda x, i=index: x[i], states), actions, own)


def tips(env, pressures):
    """Where fingers at rest are after a step of the task under pressures [Pa] that stay [m]."""
    params = env.default_params()

    def tip(pressure):
        held = finger.hanging(params)
        after, _ = env.moved(held, lambda t: pressure, None, params)
        return env.markers(after, params)[-1]

    return jax.vmap(tip)(pressures)


def motions(sizes):
    """Of the finger alone, 20 steps of 1 ms, in both codes."""
    env = TASKS["finger reach"]
    params, fine = env.default_params(), envs.FingerReach(time_step=1e-5, substeps=2000)
    case = {"case": "finger, motion alone", "against": "members"}
    draw = np.random.default_rng(0)
    for members in sizes:
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
    sizes = SIZES[:2] if quick("batches above 64") else SIZES
    yield from motions(sizes)
    for name, env in (TASKS | {name: kind() for name, kind in SOLIDS.items()}).items():
        step = jax.vmap(lambda *one, env=env: envs.step(env, *one))
        for members, given in batches(env, sizes):
            found = {}
            repeats = 5 if members < 1000 else 2
            timings = measure_together({"step": step}, *given, repeats=repeats, results=found)
            yield Row(
                "sorojax",
                {"case": name, "against": "members", "members": members},
                **timings["step"].per(members).columns(),
                error=float(found["step"].info["diverged"].mean()),
                reference="share of members that diverged",
                bar=0.0,
                bar_on="error",
            )
