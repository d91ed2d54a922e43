"""Scripted controllers of the tasks in which fingers handle a thing, and their episodes.

Both know the true place of the thing; supply and noise they do not know.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sorojax import envs

_OPEN, _CLOSE, _SWEEP = 0.35, 0.45, 0.9  # s, of the phases of a stroke
_NEAR, _LEAD, _ENOUGH = 0.5, 0.1, 0.04  # rad, s, rad
_ABOVE, _HIGH, _FULL = 68e-3, 45e-3, 0.9  # m, from box to foot; m; share of the pressure
# s; 1 over the target; height over the place where the box is taken or put; 1 with pressure
_TIMES = np.array([0, 1.0, 1.5, 2.0, 2.9, 3.6, 4.6, 5.0, 5.6, 5.8, 6.1, 6.4, 7.0])
_THERE = np.array([0, 0, 0, 0, 0, 0, 1.0, 1, 1, 1, 1, 1, 1])
_UP = np.array([1.0, 1, 0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 1])
_HOLD = np.array([0, 0, 0, 0, 1.0, 1, 1, 1, 1, 1, 0, 0, 0])


class Episode(NamedTuple):
    """What came of every step; after an end reward is zero and `success` false."""

    reward: jax.Array
    error: jax.Array
    success: jax.Array
    dropped: jax.Array
    diverged: jax.Array
    state: envs.State


class Stroke(NamedTuple):
    """Phase of the hand (0 open, 1 closes, 2 sweeps), time in it [s], place of the sweep from
    -1 to 1, and the angle that was left [rad]."""

    phase: jax.Array
    clock: jax.Array
    sweep: jax.Array
    left: jax.Array


def turned_in_strokes(env, start, now, params, memory, step):
    """Open, close, sweep until the ball is where it should be, or open again."""
    w, _, _, z = jnp.unstack(now.body.q[-7:-3])
    left = now.goal.turn - 2 * jnp.arctan2(z, w)
    left = (left + jnp.pi) % (2 * jnp.pi) - jnp.pi
    zero = jnp.zeros_like(left)
    memory = Stroke(jnp.zeros((), jnp.int32), zero, zero, left) if memory is None else memory
    phase, clock = memory.phase, memory.clock + env.period
    side = jnp.where(left >= 0, 1.0, -1.0)
    over = (memory.sweep * side >= 1) & (jnp.abs(left) >= _ENOUGH)
    ends = jnp.stack([clock > _OPEN, clock > _CLOSE, over])[phase]
    phase = jnp.where(ends, (phase + 1) % 3, phase)
    clock = jnp.where(ends, 0.0, clock)
    rate = jnp.clip((left - memory.left) / env.period, -6, 6)
    way = jnp.clip((left + _LEAD * rate) / _NEAR, -1, 1) * 2 / _SWEEP * env.period
    sweep = jnp.clip(jnp.where(phase == 2, memory.sweep + way, -side), -1, 1)
    both = jnp.clip(jnp.stack([1 + sweep, 1 - sweep]), 0, 1)
    both = jnp.where(phase == 0, jnp.zeros_like(both), both)
    return Stroke(phase, clock, sweep, left), jnp.tile(2 * both - 1, 3)


def carried_over(env, start, now, params, memory, step):
    """A plan by the clock: over the box, down, close, up, over the shelf, down, open, up."""
    t = (step + 1).astype(params.box_height.dtype) * env.period
    low = jnp.stack([params.box_height / 2, start.goal.target[1]]) + _ABOVE - params.foot_height
    from_to = jnp.stack([start.body.q[-2], start.goal.target[0]])
    there = _THERE[:, None] * np.array([[-1.0, 1.0]]) + np.array([[1.0, 0.0]])
    places = jnp.stack([there @ from_to, there @ low + _HIGH * _UP])
    place = jnp.stack([jnp.interp(t, _TIMES, row) for row in places])
    gap = place - now.supply.commands[0, :2]
    rate = jnp.clip(gap / (2 * params.max_travel) * env.full_range / env.period, -1, 1)
    return (), jnp.append(rate, 2 * _FULL * jnp.interp(t, _TIMES, jnp.asarray(_HOLD)) - 1)


def at_random(env, start, now, params, memory, step):
    """Another action in every step."""
    key = jax.random.fold_in(jax.random.key(0), now.steps)
    key = jax.random.fold_in(key, (1e9 * jnp.abs(start.goal[0])).sum().astype(jnp.int32))
    return (), jax.random.uniform(key, (env.num_actions,), minval=-1.0)


def idle(env, start, now, params, memory, step):
    """No pressure, no motion."""
    zero = jnp.zeros(env.num_actions)
    return (), zero.at[2].set(-1.0) if isinstance(env, envs.PickPlace) else zero - 1


def episode(env, controller, key, params) -> Episode:
    """One episode under a controller."""
    key, begin = jax.random.split(key)
    start, _ = envs.reset(env, begin, params)
    memory, _ = controller(env, start, start, params, None, jnp.zeros((), jnp.int32))
    error = "angle" if isinstance(env, envs.BallTurn) else "distance"

    def one(carry, given):
        state, memory, alive = carry
        step, key = given
        memory, action = controller(env, start, state, params, memory, step)
        after = envs.step(env, key, state, action, params)
        info, goes_on = after.info, alive & ~after.terminated
        told = Episode(
            jnp.where(alive, after.reward, 0.0),
            info[error],
            info["success"] & goes_on,
            info["dropped"] & alive,
            info["diverged"] & alive,
            after.state,
        )
        return (after.state, memory, goes_on), told

    steps = jnp.arange(env.max_steps, dtype=jnp.int32), jax.random.split(key, env.max_steps)
    return jax.lax.scan(one, (start, memory, jnp.ones((), bool)), steps)[1]
