"""PPO beside gradients through the physics: one finger, one task, two ways to learn."""

import sys
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import sorojax as sj
from sorojax import envs
from sorojax.envs import finger

ENV = envs.FingerReach(time_step=4e-3, substeps=5, max_steps=96)
THRESHOLD = 0.8  # of unseen fingers and targets, within 5 mm at the end of an episode
FINGERS, STEPS, EPOCHS, PARTS, BLOCK = 256, 48, 4, 8, 10
DISCOUNT, TRACE, CLIP = 0.95, 0.95, 0.2
SCALE = np.repeat([1.0, 10.0, 3.0], [6, 3, 24])  # of observations, to about 1 each


class Agent(eqx.Module):
    """Mean and spread of the change of the commands, and the value of what is seen."""

    actor: eqx.nn.MLP
    critic: eqx.nn.MLP
    log_std: jax.Array

    def mean(self, seen):
        return seen[3:6] + 0.5 * jnp.tanh(self.actor(SCALE * seen))

    def value(self, seen):
        return self.critic(SCALE * seen)

    def log_chance(self, seen, action):
        off = (action - self.mean(seen)) * jnp.exp(-self.log_std)
        return -jnp.sum(0.5 * off**2 + self.log_std)


def agent(key) -> Agent:
    nets = [eqx.nn.MLP(33, n, 64, 2, jax.nn.tanh, key=k)
            for n, k in zip((3, "scalar"), jax.random.split(key), strict=True)]  # fmt: skip
    return Agent(*nets, jnp.full(3, -1.5))


def tried(control, memory, key, count, steps):
    """Episodes of fingers within 4 % of the drawn one, with targets of their own."""

    def one(carry, key):
        state, seen, memory, own = carry
        action, memory = control(seen, memory, key)
        after = envs.step(ENV, key, state, action, own)
        out = seen, action, after.reward, after.info["distance"]
        return (after.state, after.observation, memory, own), out

    def episode(key, own):
        start, *later = jax.random.split(key, steps + 1)
        begin = (*envs.reset(ENV, start, own), memory, own)
        last, out = jax.lax.scan(one, begin, jnp.stack(later))
        return *out, last[1]

    params = envs.randomised(ENV.default_params(), key, 0.04, members=count)
    return jax.vmap(episode)(jax.random.split(key, count), params)


def advantages(agent, seen, reward, last):
    """Generalised advantage of each step of one episode, and its return."""
    value = jax.vmap(agent.value)(seen)
    ahead = jnp.append(value[1:], agent.value(last))

    def back(sum_, x):
        sum_ = x + DISCOUNT * TRACE * sum_
        return sum_, sum_

    gain = jax.lax.scan(back, jnp.zeros(()), reward + DISCOUNT * ahead - value, reverse=True)[1]
    return gain, gain + value


def ppo_loss(agent, data):
    seen, action, before, gain, wanted = data
    ratio = jnp.exp(jax.vmap(agent.log_chance)(seen, action) - before)
    gain = (gain - gain.mean()) / (gain.std() + 1e-8)
    kept = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * gain)
    return jnp.mean((jax.vmap(agent.value)(seen) - wanted) ** 2) - kept.mean()


def ppo(optimiser, carry, key):
    """One update: episodes of noisy commands, and some passes over their steps."""
    agent, moments = carry

    def noisy(seen, memory, key):
        noise = jax.random.normal(key, (3,), seen.dtype)
        return agent.mean(seen) + jnp.exp(agent.log_std) * noise, memory

    seen, action, reward, _, last = tried(noisy, None, key, FINGERS, STEPS)
    gain, wanted = jax.vmap(lambda *x: advantages(agent, *x))(seen, reward, last)
    before = jax.vmap(jax.vmap(agent.log_chance))(seen, action)
    data = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (seen, action, before, gain, wanted))

    def part(carry, rows):
        agent, moments = carry
        slope = eqx.filter_grad(ppo_loss)(agent, [x[rows] for x in data])
        change, moments = optimiser.update(slope, moments)
        return (eqx.apply_updates(agent, change), moments), None
    rows = jnp.concatenate([jax.random.permutation(k, FINGERS * STEPS).reshape(PARTS, -1)
            for k in jax.random.split(key, EPOCHS)])
    return carry_scan(part, carry, rows), reward.mean()


def carry_scan(f, carry, xs):
    dyn, static = eqx.partition(carry, eqx.is_array)
    def g(d, x):
        c, _ = f(eqx.combine(d, static), x)
        return eqx.filter(c, eqx.is_array), None
    return eqx.combine(jax.lax.scan(g, dyn, xs)[0], static)


GF, GS = 64, 32
def gradient(optimiser, carry, key):
    agent, moments = carry
    def loss(agent):
        return -tried(lambda s, m, k: (agent.mean(s), m), None, key, GF, GS)[2].mean()
    value, slope = eqx.filter_value_and_grad(loss)(agent)
    change, moments = optimiser.update(slope, moments)
    return (eqx.apply_updates(agent, change), moments), -value


@eqx.filter_jit
def judge(agent, key):
    out = tried(lambda s, m, k: (agent.mean(s), m), None, key, 256, 96)
    return (out[3][:, -1] < ENV.tolerance).mean(), out[2].mean(), jnp.median(out[3][:, -1])


def learned(method, rate, updates, seed, block, verbose=True):
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))
    carry = agent(jax.random.key(seed))
    carry = carry, optimiser.init(eqx.filter(carry, eqx.is_inexact_array))
    dyn, static = eqx.partition(carry, eqx.is_array)
    @jax.jit
    def many(dyn, keys):
        def g(d, k):
            c, r = method(optimiser, eqx.combine(d, static), k)
            return eqx.filter(c, eqx.is_array), r
        return jax.lax.scan(g, dyn, keys)
    start = time.perf_counter(); curve = []
    for i, keys in enumerate(jax.random.split(jax.random.key(100 + seed), (updates // block, block))):
        dyn, r = many(dyn, keys)
        r = float(r.mean()); t = time.perf_counter() - start
        a = eqx.combine(dyn, static)[0]
        s = [float(x) for x in judge(a, jax.random.key(3))]
        curve.append((i, t, r, *s))
        if verbose and i % 2 == 1: print((i + 1) * block, "%.1f s  r %.4f  success %.3f  ret %.4f median %.2f mm" % (t, r, s[0], s[1], 1e3 * s[2]), "std", np.round(np.exp(np.asarray(a.log_std)), 3), flush=True)
    return a, curve


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_dtype_promotion", "standard")
    kind, n, rate = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    if kind == "ppo":
        learned(ppo, optax.linear_schedule(rate, rate * 0.05, n * EPOCHS * PARTS), n, 0, 10)
    else:
        learned(gradient, optax.cosine_decay_schedule(rate, n), n, 0, 5)
