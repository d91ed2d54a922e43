"""Rows of steps of environments in batches, one for each number of members."""

import jax
import jax.numpy as jnp

from benchmarks.harness import Row, measure_together, quick
from sorojax import envs

SIZES = 1, 64, 1024, 8192


def sizes():
    """Numbers of members."""
    return SIZES[:2] if quick("batches above 64") else SIZES


def batches(env):
    """Keys, states, actions and parameters of as many members, of 64 episodes or fewer."""
    usual, few = env.default_params(), min(64, max(sizes()))
    keys = jax.random.split(jax.random.key(0), few)
    states = jax.jit(jax.vmap(lambda key: envs.reset(env, key, usual)[0]))(keys)
    for members in sizes():
        keys = jax.random.split(jax.random.key(1), members)
        own = envs.randomised(usual, keys[0], 0.1, members=members)
        actions = jax.random.uniform(keys[0], (members, env.num_actions), minval=-1.0)
        index = jnp.arange(members) % few
        yield members, (keys, jax.tree.map(lambda x, i=index: x[i], states), actions, own)


def steps(tasks):
    """Time of a step of one member, and the share of members that diverged."""
    for name, env in tasks.items():
        step = jax.vmap(lambda *one, env=env: envs.step(env, *one))
        for members, given in batches(env):
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
