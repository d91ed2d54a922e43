"""Environments in the shapes that trainers of others take."""

import dataclasses
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from sorojax import _check
from sorojax.envs import core
from sorojax.envs.core import AbstractEnv

if TYPE_CHECKING:
    from sorojax.envs.gym_adapter import GymnasiumEnv, GymnasiumVectorEnv

Autoreset = Literal["NextStep", "SameStep", "Disabled"]


def to_gymnasium(
    env: AbstractEnv, params: PyTree = None, *, render_mode: str | None = None
) -> "GymnasiumEnv":
    """An environment of Gymnasium: one episode at a time, NumPy in and out.

    `register` gives the tasks names for `gymnasium.make`.

    Args:
        env: The environment.
        params: Numbers of the robot; those of `env.default_params()` if omitted.
        render_mode: "rgb_array" for pictures by `render()`.

    Returns:
        A `gymnasium.Env`.

    Raises:
        ModuleNotFoundError: If gymnasium is not installed.
        ValueError: If there is no such mode.

    Example:
        >>> bench = envs.to_gymnasium(envs.FingerReach())
        >>> observation, info = bench.reset(seed=0)
        >>> observation.shape, bench.action_space.shape
        ((33,), (3,))

    Reference:
        Towers et al., Gymnasium: a standard interface for reinforcement learning environments,
        2024.
    """
    made = _adapter("to_gymnasium").GymnasiumEnv
    return made(env, env.default_params() if params is None else params, render_mode)


def to_gymnasium_vector(
    env: AbstractEnv,
    num_envs: int,
    params: PyTree = None,
    *,
    autoreset: Autoreset = "NextStep",
    render_mode: str | None = None,
) -> "GymnasiumVectorEnv":
    """Many members of one environment as a `gymnasium.vector.VectorEnv`, one program for all.

    An integer seed s gives member k that of `to_gymnasium` with the seed s + k.

    Args:
        env: The environment.
        num_envs: Members.
        params: Numbers of the robot, each for all members or with a first axis of one for
            each, as of `randomised`; those of `env.default_params()` if omitted.
        autoreset: What becomes of a member at its end: "NextStep" resets it in place of its
            next step, "SameStep" at once, with `final_obs` and `final_info` among the news,
            "Disabled" waits for `reset(options={"reset_mask": mask})`.
        render_mode: "rgb_array" for pictures by `render()`.

    Returns:
        A `gymnasium.vector.VectorEnv`.

    Raises:
        ModuleNotFoundError: If gymnasium is not installed.
        ValueError: If there is no member, or no such mode.

    Example:
        >>> many = envs.to_gymnasium_vector(envs.FingerReach(), 2, autoreset="SameStep")
        >>> observation, info = many.reset(seed=0)
        >>> observation.shape, many.action_space.shape
        ((2, 33), (2, 3))

    Reference:
        Towers et al., Gymnasium: a standard interface for reinforcement learning environments,
        2024.
    """
    do = "Give how many run side by side."
    _check.positive("to_gymnasium_vector", "num_envs", num_envs, "members", do)
    gym = _adapter("to_gymnasium_vector")
    params = env.default_params() if params is None else params
    mode = gym.AutoresetMode(autoreset)
    return gym.GymnasiumVectorEnv(env, num_envs, params, mode, render_mode)


def register() -> tuple[str, ...]:
    """Names of the tasks for `gymnasium.make` and `gymnasium.make_vec`.

    Both take `params=` and the fields of a task, `max_steps=` for example.

    Returns:
        The names.

    Raises:
        ModuleNotFoundError: If gymnasium is not installed.

    Example:
        >>> envs.register()[:2]
        ('sorojax/BallTurn-v0', 'sorojax/CrawlerRun-v0')
    """
    return _adapter("register").register()


def to_brax(env: AbstractEnv, params: PyTree = None) -> "BraxEnv":
    """An environment with the methods of those of Brax and MuJoCo Playground.

    Args:
        env: The environment.
        params: Numbers of the robot; those of `env.default_params()` if omitted.

    Returns:
        An object with `reset(rng)`, `step(state, action)`, `observation_size` and
        `action_size`; its states have `data` and `pipeline_state`, `obs`, `reward`, `done`,
        `metrics` and `info`.

    Example:
        >>> reach = envs.to_brax(envs.FingerReach())
        >>> state = reach.reset(jax.random.PRNGKey(0))
        >>> after = reach.step(state, jnp.zeros(reach.action_size))
        >>> after.obs.shape, float(after.done)
        ((33,), 0.0)

    Reference:
        Freeman et al., Brax: a differentiable physics engine for large scale rigid body
        simulation, 2021.
    """
    return BraxEnv(env, env.default_params() if params is None else params)


def _adapter(where: str) -> Any:
    """The module that needs gymnasium, or an error that says how to get it."""
    try:
        from sorojax.envs import gym_adapter
    except ImportError as reason:
        raise ModuleNotFoundError(
            f"{where}: gymnasium cannot be imported ({reason}), need it for its interface. "
            "Install it with `pip install 'sorojax[envs]'`."
        ) from reason
    return gym_adapter


# The shape of Brax and MuJoCo Playground, which neither needs to be there


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
