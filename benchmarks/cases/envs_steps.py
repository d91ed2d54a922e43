"""Steps of environments a second: finger reach and tentacle push.

Each member has numbers of its own. A step is 20 ms: 20 steps of physics of 1 ms, measurements,
reward. `run_s` is that of one member of a batch, one over the steps a second. The finger is
timed with five steps of 4 ms too.
"""

import jax

from benchmarks.harness import Row, measure, quick
from sorojax import envs

WORKERS = 1  # nothing here calls the host
SIZES = 1, 64, 1024, 8192
TASKS = {
    "finger reach": envs.FingerReach(),
    "finger reach, 5 of 4 ms": envs.FingerReach(time_step=4e-3, substeps=5),
    "tentacle push": envs.TentaclePush(),
}


def batch(env, members: int):
    """Keys, states, actions and parameters."""
    params = envs.randomised(env.default_params(), jax.random.key(1), 0.1, members=members)
    keys = jax.random.split(jax.random.key(0), members)
    begin = jax.jit(jax.vmap(lambda key, own: envs.reset(env, key, own)[0]))
    actions = jax.random.uniform(keys[0], (members, env.num_actions), minval=-1.0)
    return keys, begin(keys, params), actions, params


def rows():
    sizes = SIZES[:2] if quick("batches above 64") else SIZES
    for name, env in TASKS.items():
        for members in sizes:
            given = batch(env, members)
            step = jax.vmap(lambda *one, env=env: envs.step(env, *one))
            timing = measure(step, *given, repeats=5).per(members)
            found = jax.jit(step)(*given)
            yield Row(
                "sorojax",
                {"case": name, "against": "members", "members": members},
                **timing.columns(),
                error=float(found.info["diverged"].mean()),
                reference="share of members that diverged",
                bar=0.0 if members > 1 else None,
                bar_on="error",
            )
