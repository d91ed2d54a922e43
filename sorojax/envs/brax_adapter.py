"""Environments in the shape of Brax and MuJoCo Playground, which neither needs to be there."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.envs import core


class BraxState(eqx.Module):
    """A state as wrappers and trainers of Brax and Playground read and replace it.

    Attributes:
        data: The state of the environment; `pipeline_state` is the same.
        obs: Observation.
        reward: [-].
        done: 1 where the episode is over, 0 elsewhere.
        metrics: Numbers of the task to be logged.
        info: `rng` for the next step, `truncation`, 1 where time was up, and `diverged`.
    """

    data: core.State
    obs: Float[Array, " observations"]
    reward: Float[Array, ""]
    done: Float[Array, ""]
    metrics: dict[str, Float[Array, ""]]
    info: dict[str, Any]

    @property
    def pipeline_state(self) -> core.State:
        """The name that Brax has for `data`."""
        return self.data

    def replace(self, **changes: Any) -> "BraxState":
        """The state with some fields changed, by the name of either."""
        if "pipeline_state" in changes:
            changes["data"] = changes.pop("pipeline_state")
        return dataclasses.replace(self, **changes)


class BraxEnv(eqx.Module):
    """An environment with `reset(rng)` and `step(state, action)`, to be taken by `jax.vmap`.

    Attributes:
        env: The environment.
        params: Numbers of the robot.
    """

    env: core.AbstractEnv
    params: Any

    def reset(self, rng: Array) -> BraxState:
        """The beginning of an episode, from a key of either kind."""
        draw, later = jax.random.split(_typed(rng))
        state, observation = core.reset(self.env, draw, self.params)
        step = jax.eval_shape(core.step, self.env, draw, state, self._still(), self.params)
        zero = jnp.zeros((), observation.dtype)
        metrics = {name: zero for name in step.info if name != "diverged"}
        info = {"rng": _alike(later, rng), "truncation": zero, "diverged": zero}
        return BraxState(state, observation, zero, zero, metrics, info)

    def step(self, state: BraxState, action: Float[Array, " actions"]) -> BraxState:
        """The state after a step."""
        rng = state.info["rng"]
        noise, later = jax.random.split(_typed(rng))
        after = core.step(self.env, noise, state.data, action, self.params)
        number = after.observation.dtype
        news = {name: value.astype(number) for name, value in after.info.items()}
        diverged = news.pop("diverged")
        timed_out = (after.truncated & ~after.terminated).astype(number)
        own = {"rng": _alike(later, rng), "truncation": timed_out, "diverged": diverged}
        done = (after.terminated | after.truncated).astype(number)
        return state.replace(
            data=after.state,
            obs=after.observation,
            reward=after.reward,
            done=done,
            metrics=state.metrics | news,
            info=state.info | own,
        )

    @property
    def observation_size(self) -> int:
        """Numbers of an observation."""
        return self.env.num_observations

    @property
    def action_size(self) -> int:
        """Numbers of an action."""
        return self.env.num_actions

    @property
    def dt(self) -> float:
        """Time between two steps [s]."""
        return self.env.period

    @property
    def unwrapped(self) -> "BraxEnv":
        """This environment, which wraps none of the same kind."""
        return self

    def _still(self) -> Array:
        return jnp.zeros(self.action_size)


def _typed(rng: Array) -> Array:
    """A key that may be two plain numbers."""
    if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key):
        return rng
    return jax.random.wrap_key_data(rng)


def _alike(key: Array, rng: Array) -> Array:
    """The key in the form of another."""
    return key if rng.dtype == key.dtype else jax.random.key_data(key)
