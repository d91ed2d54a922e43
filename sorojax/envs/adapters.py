"""Environments in the shapes that trainers of others take."""

from typing import TYPE_CHECKING, Any, Literal

from jaxtyping import PyTree

from sorojax import _check
from sorojax.envs.brax_adapter import BraxEnv
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


def to_brax(env: AbstractEnv, params: PyTree = None) -> BraxEnv:
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
