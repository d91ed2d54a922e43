"""Slopes of environments: a step by its state, its action and the numbers of the robot."""

import equinox as eqx
import jax
import jax.numpy as jnp

from sorojax import envs
from tests.derivatives.case import Case

NONE = {
    "a goal is drawn, and the way to it has no slope of use": "reset step_with_reset",
    "names of Gymnasium": "register",
    "a training, which chooses cells": "solid_crawler solid_finger",
    "numbers for the host": "to_gymnasium to_gymnasium_vector",
    "a step of the same environment in another shape": "to_brax",
}

# no middle of a step is where the command arrives, 10 ms, a kink of what is delivered
ENV = envs.FingerReach(time_step=5e-3, substeps=3)
KEY = jax.random.key(0)


def step():
    params = ENV.default_params()
    state = jax.jit(lambda key: envs.reset(ENV, key, params)[0])(KEY)
    state = eqx.tree_at(lambda s: s.body.q, state, jnp.asarray([1.5, 0.2, -2.0, 0.3, 0.02]))
    at = state.body, state.supply.value, jnp.asarray([0.3, -0.2, 0.5]), params

    def call(at):
        body, value, action, params = at
        now = eqx.tree_at(lambda s: (s.body, s.supply.value), state, (body, value))
        after = envs.step(ENV, KEY, now, action, params)
        return after.reward, after.observation, after.state.body

    return Case(call, at)


CASES = {
    "randomised": Case(
        lambda x: envs.randomised(x, KEY, 0.2, members=3), {"a": jnp.asarray([1.0, 2.0])}
    ),
    "step": step,
}
