"""Two ways to learn the same: PPO, and gradients through the physics, over five seeds.

Agent, task and test are those of example 45. The threshold was set when the PI was known and
before any training. Reached are 93 % by PPO (worst seed 92), 89 % by gradients (worst 86),
76 % by the best PI of 25 and 1 % by random pressures. PPO passes the threshold after 339,000
steps of the environment and 9 s of one core, gradients after 20,500 and 1.6 s (medians), with
15 and 33 s of compilation before.
"""

import runpy
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import sorojax as sj
from sorojax.envs.tasks import finger

PPO = runpy.run_path(str(Path(__file__).with_name("45_ppo.py")))
ENV, ADAM, agent, episodes = (PPO[name] for name in ("ENV", "ADAM", "agent", "episodes"))
THRESHOLD = 80.0  # per cent of 256 unseen fingers and targets, within 5 mm after 96 steps
FEW, SHORT = 16, 32  # fingers and steps of an update by gradients
PROPORTIONAL, INTEGRAL = (0, 0.1, 0.2, 0.4, 0.8), (0.05, 0.1, 0.15, 0.2, 0.3)


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
    return Partial(act, best)


test = jax.jit(PPO["tested"])


def learned(block, updates, blocks, seed):
    """After each block of updates the seconds of the processor, and the share reached [%]."""
    first, spent, curve = agent(jax.random.key(seed)), 0.0, []
    carry, key = (first, ADAM.init(first)), jax.random.fold_in(jax.random.key(9), seed)
    for keys in jax.random.split(key, (blocks, updates)):
        start = time.process_time()
        carry = jax.block_until_ready(block(carry, keys))
        spent += time.process_time() - start
        curve.append((spent, 100 * float(test(carry[0].command)[0])))
    return np.array(curve)


def main(quick: bool = False, file: Path | None = None) -> dict[str, float]:
    """Baselines, then both ways over some seeds."""
    grid = ([0.1], [0.1], 16) if quick else (PROPORTIONAL, INTEGRAL, 128)
    numbers, curves, seeds = {}, {}, range(1 if quick else 5)
    for name, act in ("random", Partial(random)), ("PI", tuned(*grid)):
        numbers[f"{name}: reached [%]"] = 100 * float(test(act)[0])
    full = PPO["FINGERS"] * (PPO["STEPS"] + 1)
    ways = ("PPO", PPO["update"], 3, 15, full), ("gradients", by_gradients, 5, 24, FEW * SHORT)
    for name, way, updates, blocks, size in ways:
        block = jax.jit(lambda carry, keys, way=way: jax.lax.scan(way, carry, keys)[0])
        compiled = learned(block, updates, 1, 99)[0, 0]
        runs = np.stack([learned(block, updates, 2 if quick else blocks, k) for k in seeds])
        steps, (spent, reached) = size * updates * np.arange(1, runs.shape[1] + 1), runs.T
        passed, k = reached > THRESHOLD, np.argmax(reached > THRESHOLD, axis=0)
        until = np.where(passed.any(axis=0), (steps[k], spent[k, seeds]), np.inf)
        curves[name] = steps, spent, reached
        numbers[f"{name}: seconds of compilation"] = float(compiled - spent[0].min())
        numbers[f"{name}: reached, mean [%]"] = float(reached[-1].mean())
        numbers[f"{name}: reached, worst [%]"] = float(reached[-1].min())
        numbers[f"{name}: steps to the threshold"] = float(np.median(until[0]))
        numbers[f"{name}: seconds to the threshold"] = float(np.median(until[1]))
    if file is not None:
        draw(curves, numbers, file)
    return numbers


def draw(curves, numbers: dict[str, float], file: Path) -> None:
    """Share of unseen targets reached, by steps of the environment and by seconds."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(
        1, 2, figsize=(9, 3.6), sharey=True, layout="constrained"
    )
    for colour, (name, (steps, spent, reached)) in zip(
        ("#1f5f8b", "#c0392b"), curves.items(), strict=True
    ):
        left.plot(np.repeat(steps[:, None], reached.shape[1], 1), reached, color=colour, lw=0.8)
        left.plot(steps, reached.mean(axis=1), color=colour, lw=2.5, label=name)
        right.plot(spent, reached, color=colour, lw=0.8)
        right.plot(spent.mean(axis=1), reached.mean(axis=1), color=colour, lw=2.5, label=name)
    lines = {"asked for": (THRESHOLD, "-"), "PI": (numbers["PI: reached [%]"], "--")}
    lines["random"] = numbers["random: reached [%]"], ":"
    for axes in (left, right):
        for share, style in lines.values():
            axes.axhline(share, color="#8a8f98", ls=style, lw=1.2)
        axes.spines[["top", "right"]].set_visible(False)
    for name, (share, _) in lines.items():
        above = "top" if name == "PI" else "bottom"
        place = {"transform": right.get_yaxis_transform(), "ha": "right", "va": above}
        right.text(0.99, share, name, fontsize=8, **place)
    left.set(
        xlabel="steps of the environment", ylabel="unseen targets reached [%]", xscale="log"
    )
    right.set(xlabel="seconds of one core, compilation apart")
    right.legend(frameon=False, loc="center right")
    figure.savefig(file, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    sj.enable_compilation_cache()
    quick = "--quick" in sys.argv
    picture = None if quick else Path(__file__).with_suffix(".png")
    for name, value in main(quick, picture).items():
        print(f"{name:<44} {value:.4g}")
