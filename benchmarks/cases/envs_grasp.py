"""Fingers that handle a thing: reward and error at the end by a script, at random, and idle.

32 episodes each, with a supply and a goal of its own; by the script also with all numbers of
the robot 10 % off. `run_s` is the time of a step by a member, compilation apart.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np

from benchmarks import grasping
from benchmarks.harness import Row, measure_once, quick
from sorojax import envs
from sorojax.units import deg, mm

WORKERS = 1  # nothing here calls the host
MEMBERS = 32
TASKS = {
    "ball turn": (envs.BallTurn(), grasping.turned_in_strokes, deg, "deg"),
    "pick and place": (envs.PickPlace(), grasping.carried_over, mm, "mm"),
}


def rows():
    members = 4 if quick("32 episodes") else MEMBERS
    keys = jax.random.split(jax.random.key(11), members)
    for task, (env, script, unit, name) in TASKS.items():
        controllers = {"script": script, "random": grasping.at_random, "idle": grasping.idle}
        for label, controller in controllers.items():
            program = Program(env, controller)
            for spread in (0.0, 0.1) if label == "script" else (0.0,):
                usual = env.default_params()
                own = envs.randomised(usual, jax.random.key(5), spread, members=members)
                timing, seen = measure_once(program, keys, own)
                end = np.asarray(seen.error[:, -1]) / unit
                told = {
                    "task": task,
                    "controller": label,
                    "numbers off by": spread,
                    "reward of a step": float(np.mean(seen.reward)),
                    "greatest error": float(end.max()),
                    "success": float(np.mean(seen.success[:, -1])),
                    "dropped": float(np.mean(np.any(seen.dropped, axis=1))),
                    "diverged": float(np.mean(np.any(seen.diverged, axis=1))),
                }
                each = timing.per(members * env.max_steps).columns()
                reference = f"median error at the end [{name}]"
                yield Row("sorojax", told, **each, error=float(np.median(end)),
                          reference=reference)  # fmt: skip


class Program(eqx.Module):
    """Episodes of a batch under a controller."""

    env: envs.AbstractEnv
    controller: Callable = eqx.field(static=True)

    def __call__(self, keys, own):
        def one(key, params):
            return grasping.episode(self.env, self.controller, key, params)

        return jax.vmap(one)(keys, own)
