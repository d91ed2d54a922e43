"""Environments in the shape of Gymnasium, alone and in batches; imported where it is used."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Bool, Float

from sorojax._types import real
from sorojax.envs import core
from sorojax.envs.tasks.ball_turn import BallTurn
from sorojax.envs.tasks.crawler_run import CrawlerRun
from sorojax.envs.tasks.finger_reach import FingerReach
from sorojax.envs.tasks.pick_place import PickPlace
from sorojax.envs.tasks.solid_crawl import SolidCrawl
from sorojax.envs.tasks.solid_reach import SolidReach
from sorojax.envs.tasks.tentacle_push import TentaclePush
from sorojax.envs.tasks.tip_tracking import TipTracking
from sorojax.math.compiled import jit_trees

TASKS: dict[str, type[core.AbstractEnv]] = {
    "BallTurn": BallTurn,
    "CrawlerRun": CrawlerRun,
    "FingerReach": FingerReach,
    "PickPlace": PickPlace,
    "SolidCrawl": SolidCrawl,
    "SolidReach": SolidReach,
    "TentaclePush": TentaclePush,
    "TipTracking": TipTracking,
}


def _spaces(env: core.AbstractEnv) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Of an observation and of an action."""
    seen = gymnasium.spaces.Box(-core.BOUND, core.BOUND, (env.num_observations,), np.float32)
    return seen, gymnasium.spaces.Box(-1.0, 1.0, (env.num_actions,), np.float32)


class GymnasiumEnv(gymnasium.Env):
    """One environment; numbers leave it in single precision."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(self, env: core.AbstractEnv, params: Any, render_mode: str | None = None):
        _check_mode(render_mode)
        self.env, self.params, self.render_mode = env, params, render_mode
        self.metadata = self.metadata | {"render_fps": round(1 / env.period)}
        self.observation_space, self.action_space = _spaces(env)
        self._key: Any = None
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        number = int(self.np_random.integers(2**31)) if seed is None else seed
        self._key = jax.random.key(number)
        self._state, observation = _begin(self.env, self._key, self.params)
        return _single(observation), {}

    def step(self, action):
        _check_begun("step", self._state)
        action = real(np.asarray(action, np.float64))
        after = _advance(self.env, self._key, self._state, action, self.params)
        self._state = after.state
        info = {name: np.asarray(value).item() for name, value in after.info.items()}
        ends = bool(after.terminated), bool(after.truncated)
        return _single(after.observation), float(after.reward), *ends, info

    def render(self):
        if self.render_mode is None:
            return None
        _check_begun("render", self._state)
        return _pixels(self.env, self._state, self.params)


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv):
    """Members of a batch in one compiled program, with every mode of autoreset."""

    def __init__(
        self,
        env: core.AbstractEnv,
        num_envs: int,
        params: Any,
        autoreset_mode: AutoresetMode,
        render_mode: str | None = None,
    ):
        _check_mode(render_mode)
        self.env, self.num_envs, self.params = env, num_envs, params
        self.render_mode, self._mode = render_mode, autoreset_mode
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": round(1 / env.period),
            "autoreset_mode": autoreset_mode,
        }
        self.single_observation_space, self.single_action_space = _spaces(env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._keys: Any = None
        self._states: Any = None
        self._observation: Any = None
        self._over = np.zeros(num_envs, bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ):
        super().reset(seed=seed if isinstance(seed, int) else None)
        mask = self._mask(options)
        keys = jax.vmap(jax.random.key)(jnp.asarray(self._seeds(seed)))
        fresh = _begin_all(self.env, keys, self.params)
        old = fresh if self._states is None else (self._states, self._observation)
        both = (*fresh, keys), (*old, keys if self._keys is None else self._keys)
        self._states, self._observation, self._keys = _chosen(mask, *both)
        self._over = self._over & ~mask
        return _single(self._observation), {}

    def step(self, actions):
        _check_begun("step", self._states)
        if self._mode == AutoresetMode.DISABLED and self._over.any():
            raise ValueError(
                f"sorojax VectorEnv.step: {self._over.sum()} members are at their end, need "
                'none without autoreset. Call reset(options={"reset_mask": mask}) before.'
            )
        actions = real(np.asarray(actions, np.float64))
        given = self._keys, self._states, actions, self.params, jnp.asarray(self._over)
        after, final, self._keys = _advance_all(self.env, self._mode.value, *given)
        self._states, self._observation = after.state, after.observation
        ends = np.asarray(after.terminated), np.asarray(after.truncated)
        over = ends[0] | ends[1]
        self._over = np.zeros_like(over) if self._mode == AutoresetMode.SAME_STEP else over
        info = {}
        if self._mode == AutoresetMode.SAME_STEP and over.any():
            info = _final_info(over, final, after.info)
            info |= _with_masks(after.info, ~over)
        else:
            info = _with_masks(after.info, np.ones_like(over))
        return _single(after.observation), np.asarray(after.reward, np.float64), *ends, info

    def render(self):
        if self.render_mode is None:
            return None
        _check_begun("render", self._states)
        states = [jax.tree.map(lambda x, k=k: x[k], self._states) for k in range(self.num_envs)]
        axes = _axes(self.env, self.params)
        params = [_member(self.params, axes, k) for k in range(self.num_envs)]
        both = zip(states, params, strict=True)
        return tuple(_pixels(self.env, state, numbers) for state, numbers in both)

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int]:
        """One for each member."""
        drawn = [int(number) for number in self.np_random.integers(2**31, size=self.num_envs)]
        if seed is None:
            return drawn
        if isinstance(seed, int):
            return [seed + k for k in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(
                f"sorojax VectorEnv.reset: got {len(seed)} seeds, need {self.num_envs}. Give "
                "one for each member, or a single number."
            )
        return [d if s is None else s for s, d in zip(seed, drawn, strict=True)]

    def _mask(self, options: dict[str, Any] | None) -> Bool[np.ndarray, " members"]:
        """Which members are reset."""
        mask = (options or {}).get("reset_mask")
        if mask is None or self._states is None:
            return np.ones(self.num_envs, bool)
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"sorojax VectorEnv.reset: got a `reset_mask` of shape {mask.shape} and type "
                f"{mask.dtype} with {mask.sum()} set, need {self.num_envs} booleans, one of "
                "them True. Give terminations | truncations."
            )
        return mask


def make(task: str, *, params: Any = None, render_mode: str | None = None, **options: Any):
    """What `gymnasium.make` calls: options are those of the task."""
    env = TASKS[task](**options)
    return GymnasiumEnv(env, env.default_params() if params is None else params, render_mode)


def make_vector(
    task: str,
    *,
    num_envs: int = 1,
    params: Any = None,
    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
    **options: Any,
):
    """What `gymnasium.make_vec` calls: options are those of the task."""
    env = TASKS[task](**options)
    params = env.default_params() if params is None else params
    return GymnasiumVectorEnv(env, num_envs, params, AutoresetMode(autoreset_mode), render_mode)


def register() -> tuple[str, ...]:
    """The names of the tasks, known to Gymnasium from now on."""
    names = []
    for task in TASKS:
        names.append(f"sorojax/{task}-v0")
        if names[-1] not in gymnasium.registry:
            gymnasium.register(
                names[-1],
                entry_point=f"{__name__}:make",
                vector_entry_point=f"{__name__}:make_vector",
                kwargs={"task": task},
            )
    return tuple(names)


# The programs, of pytrees and without a batch axis of their own

_NEXT = 2**31 - 1  # what makes the key of the next episode; steps are fewer


@jit_trees
def _begin(env, key, params):
    return core.reset(env, jax.random.fold_in(key, 0), params)


@jit_trees
def _advance(env, key, state, action, params):
    return core.step(env, jax.random.fold_in(key, state.steps + 1), state, action, params)


@jit_trees
def _begin_all(env, keys, params):
    axes = _axes(env, params)
    return jax.vmap(lambda key, own: _begin(env, key, own), in_axes=(0, axes))(keys, params)


@jit_trees
def _chosen(mask, fresh, old):
    return jax.vmap(core.chosen)(mask, fresh, old)


@jit_trees
def _advance_all(env, mode, keys, states, actions, params, over):
    """The step of all members, their observations before any reset, and their keys."""

    def one(key, state, action, own):
        return _advance(env, key, state, action, own)

    axes = _axes(env, params)
    after = jax.vmap(one, in_axes=(0, 0, 0, axes))(keys, states, actions, params)
    final = after.observation
    if mode == AutoresetMode.DISABLED.value:
        return after, final, keys
    is_next = mode == AutoresetMode.NEXT_STEP.value
    begins = over if is_next else after.terminated | after.truncated
    later = jax.vmap(lambda key: jax.random.fold_in(key, _NEXT))(keys)
    old = (after.state, final, keys)

    def with_new() -> Any:
        fresh = (*_begin_all(env, later, params), later)
        return jax.vmap(core.chosen)(begins, fresh, old)

    state, observation, keys = jax.lax.cond(jnp.any(begins), with_new, lambda: old)
    after = after._replace(state=state, observation=observation)
    if is_next:  # the step of a member that begins is its reset
        after = after._replace(
            reward=jnp.where(begins, jnp.zeros_like(after.reward), after.reward),
            terminated=after.terminated & ~begins,
            truncated=after.truncated & ~begins,
            info=jax.tree.map(lambda x: jnp.where(begins, jnp.zeros_like(x), x), after.info),
        )
    return after, final, keys


def _axes(env: core.AbstractEnv, params: Any) -> Any:
    """Which numbers have an axis of members."""
    usual = jax.eval_shape(env.default_params)
    return jax.tree.map(lambda x, one: 0 if np.ndim(x) > one.ndim else None, params, usual)


def _member(params: Any, axes: Any, k: int) -> Any:
    """The parameters of one member."""
    own = [x if axis is None else x[k] for x, axis in _pairs(params, axes)]
    return jax.tree.unflatten(jax.tree.structure(params), own)


def _pairs(params: Any, axes: Any):
    listed = jax.tree.leaves(axes, is_leaf=lambda axis: axis is None)
    return zip(jax.tree.leaves(params), listed, strict=True)


# Numbers for the host


def _single(numbers: Array) -> Float[np.ndarray, "..."]:
    return np.asarray(numbers, np.float32)


def _with_masks(info: dict[str, Array], known: Bool[np.ndarray, " members"]) -> dict[str, Any]:
    """News with the masks of the members that have them."""
    rows = {name: np.asarray(value) for name, value in info.items()}
    return rows | {f"_{name}": known.copy() for name in rows}


def _final_info(over: np.ndarray, final: Array, info: dict[str, Array]) -> dict[str, Any]:
    """The last observations of episodes that are over, and the news of their last step."""
    rows = np.full(len(over), None, object)
    seen = _single(final)
    for k in np.flatnonzero(over):
        rows[k] = seen[k]
    kept = {"final_obs": rows, "_final_obs": over.copy()}
    return kept | {"final_info": _with_masks(info, over), "_final_info": over.copy()}


def _pixels(env: core.AbstractEnv, state: core.State, params: Any) -> np.ndarray:
    """The picture of a state, as rows of red, green and blue."""
    import matplotlib.pyplot as plt

    from sorojax import view

    figure = view.show(env.scene(state, params), renderer="own").figure
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # pyright: ignore
    plt.close(figure)
    return pixels


def _check_mode(render_mode: str | None) -> None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(
            f'sorojax environment: got render_mode="{render_mode}", need "rgb_array" or None. '
            "Films are made by view.animate."
        )


def _check_begun(verb: str, state: Any) -> None:
    if state is None:
        raise ValueError(f"sorojax environment: got {verb} before reset, need a reset first.")
