"""Steps of environments a second: reach, tentacle, tracking, crawler, grasps, a reduced solid.

Each member has numbers of its own. A step is 20 ms: 20 steps of physics of 1 ms, or 10 of 2 ms
of grasps, or 5 of 4 ms of the solid, measurements, reward. `run_s` is that of one member of a
batch, one over the steps a second. The finger is timed with five steps of 4 ms too.
"""

import jax
import jax.numpy as jnp

from benchmarks.harness import Row, measure_together, quick
from sorojax import envs

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


def rows():
    sizes = SIZES[:2] if quick("batches above 64") else SIZES
    for name, env in (TASKS | {name: kind() for name, kind in SOLIDS.items()}).items():
        step = jax.vmap(lambda *one, env=env: envs.step(env, *one))
        for members, given in batches(env, sizes):
            found = {}
            timings = measure_together({"step": step}, *given, repeats=5, results=found)
            yield Row(
                "sorojax",
                {"case": name, "against": "members", "members": members},
                **timings["step"].per(members).columns(),
                error=float(found["step"].info["diverged"].mean()),
                reference="share of members that diverged",
                bar=0.0,
                bar_on="error",
            )
