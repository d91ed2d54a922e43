"""Two ways to learn the same: PPO, and gradients through the physics, over five seeds."""

import runpy
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import sorojax as sj
from sorojax.envs import finger

PPO = runpy.run_path(str(Path(__file__).with_name("45_ppo.py")))
ENV, ADAM, agent, episodes = (PPO[name] for name in ("ENV", "ADAM", "agent", "episodes"))
THRESHOLD = 80.0  # per cent of 256 unseen fingers and targets, within 5 mm after 96 steps
FEW, SHORT = 16, 32  # fingers and steps of an update by gradients


def physics_loss(agent, key):
    return -episodes(agent.command, key, FEW, SHORT)[2].mean()


def by_gradients(carry, key):
    return PPO["improved"](physics_loss, 3e-3, carry, key)


def random(seen, key):
    return jax.random.uniform(key, (3,), seen.dtype, -1.0, 1.0)


def integral(inverse, gains, seen, _):
    """PI on the error of the tip, as changes of the last command: it cannot wind up."""
    moved = seen[18:21] - seen[30:33]
    return seen[3:6] + inverse @ (gains[1] * seen[6:9] - gains[0] * moved)


def tuned(proportional, integrating, count):
    """PI with the best of all pairs of gains, and a fixed Jacobian of the tip."""
    params = ENV.default_params()
    half, unit = jnp.full(3, params.max_pressure / 2), params.length
    slope = jax.jacobian(lambda p: finger.tip_at_rest(p * half, params) / unit)(jnp.ones(3))
    gains = jnp.asarray([(p, i) for p in proportional for i in integrating])
    act = Partial(integral, jnp.linalg.inv(slope))

    def reached(each):
        distance = episodes(Partial(act, each), jax.random.key(5), count, ENV.max_steps)[3]
        return (distance[:, -1] < ENV.tolerance).mean()

    best = gains[jnp.argmax(jax.lax.map(reached, gains))]
    return Partial(act, best), best


def learned(block, keys, seed):
    """After each block of updates the seconds until then, and the share reached [%]."""
    carry, spent, curve = (agent(jax.random.key(seed)),), 0.0, []
    carry += (ADAM.init(carry[0]),)
    for each in jax.random.split(jax.random.fold_in(jax.random.key(9), seed), keys):
        start = time.perf_counter()
        carry = jax.block_until_ready(block(carry, each))
        spent += time.perf_counter() - start
        curve.append((spent, 100 * float(test(carry[0].command)[0])))
    return np.array(curve)


test = jax.jit(PPO["tested"])


def main(quick: bool = False, file: Path | None = None) -> dict[str, float]:
    """Baselines, then both ways over some seeds; the first of these compiles."""
    grid = ([0.1], [0.1], 16) if quick else ((0, 0.1, 0.2, 0.4, 0.8), (0.05, 0.1, 0.15, 0.2, 0.3), 128)
    pi, gains = tuned(*grid)
    numbers = {f"{name}: reached [%]": 100 * float(test(act)[0]) for name, act in (("random", random), ("PI", pi))}
    numbers |= {"PI: proportional": float(gains[0]), "PI: integral": float(gains[1])}
    curves = {}
    for name, way, size, each, points in (
        ("PPO", PPO["update"], PPO["FINGERS"] * (PPO["STEPS"] + 1), 3, 1 if quick else 20),
        ("gradients", by_gradients, FEW * SHORT, 5, 2 if quick else 20),
    ):
        block = jax.jit(lambda carry, keys, way=way: jax.lax.scan(way, carry, keys)[0])
        curves[name] = []
        for seed in range(1 if quick else 6):
            curves[name].append((size * each * np.arange(1, points + 1), *learned(block, (points, each), seed).T))
            print(name, seed, [np.round(x[-1], 2) for x in curves[name][-1]], np.round(curves[name][-1][2], 1), np.round(curves[name][-1][1], 1), flush=True)
    import pickle; pickle.dump((numbers, curves), open("/tmp/curves.pkl", "wb"))
    return numbers


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    picture = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, picture).items():
        print(f"{name:<44} {value:.4g}", flush=True)
