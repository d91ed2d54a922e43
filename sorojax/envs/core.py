"""What all environments share: their state, a step of it, a reset, and members of a batch that
end alone.

An environment has no batch axis. `jax.vmap` of `step` over keys, states, actions and, where
wanted, parameters makes one; a member that diverges is held, flagged and ends, and the others
are what they would be without it.
"""

import abc
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.envs.supply_line import LATE_STEPS, Delivery, Supplied, SupplyLine, begun, sent
from sorojax.math.ode.explicit import finite

if TYPE_CHECKING:
    from sorojax.view import Scene


class State(eqx.Module):
    """All that a step needs to go on.

    Attributes:
        body: Coordinates and rates of the body.
        supply: What reaches the robot, and the commands on their way.
        goal: What the episode asks for, and what is around the robot in it.
        seen: Positions of the markers as measured [m], now and a step before.
        steps: Steps since the reset.
    """

    body: PyTree
    supply: Supplied
    goal: PyTree
    seen: Float[Array, "2 markers dim"]
    steps: Int[Array, ""]


class Step(NamedTuple):
    """What a step leads to.

    Attributes:
        observation: What a bench measures, in shares of its range.
        state: To go on from.
        reward: [-].
        terminated: Whether the episode is over for good; so is one that diverged.
        truncated: Whether its time is up.
        info: `diverged`, and what the task tells beside.
    """

    observation: Float[Array, " observations"]
    state: State
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    truncated: Bool[Array, ""]
    info: dict[str, Any]


class Verdict(NamedTuple):
    """What a task says of a step."""

    reward: Float[Array, ""]
    terminated: Bool[Array, ""]
    info: dict[str, Float[Array, ""] | Bool[Array, ""]]


class AbstractEnv(eqx.Module):
    """A task: a robot, what it is asked to do, and how that is measured.

    A subclass has `num_actions`, `num_observations`, its parameters by `default_params`, whose
    field `supply` is a `SupplyLine` and whose `marker_noise` is in metres, and the methods
    below, pure functions of arrays.

    Attributes:
        time_step: Of the physics [s].
        substeps: Such steps in one of the environment.
        max_steps: Steps of the environment until an episode is truncated.
    """

    time_step: float = eqx.field(static=True, default=1e-3)
    substeps: int = eqx.field(static=True, default=20)
    max_steps: int = eqx.field(static=True, default=100)

    if TYPE_CHECKING:
        num_actions: ClassVar[int]
        num_observations: ClassVar[int]

    def __check_init__(self):
        name = type(self).__name__
        _check.positive(name, "time_step", self.time_step, "s", "1e-3 suits soft fingers.")
        _check.positive(name, "substeps", self.substeps, "", "20 make 50 steps a second.")
        _check.positive(name, "max_steps", self.max_steps, "", "100 are two seconds.")

    @property
    def period(self) -> float:
        """Time between two commands [s]."""
        return self.time_step * self.substeps

    @abc.abstractmethod
    def default_params(self) -> Any:
        """Numbers of the robot and its surroundings: a pytree to change, or to randomise."""

    @abc.abstractmethod
    def begin(self, key: Array, params: Any) -> tuple[PyTree, Float[Array, " actions"], PyTree]:
        """Body, command and goal at the start of an episode."""

    @abc.abstractmethod
    def commanded(
        self, command: Float[Array, " actions"], action: Float[Array, " actions"], params: Any
    ) -> Float[Array, " actions"]:
        """The command after the last one, in the unit of its actuator, of an action within
        [-1, 1]."""

    def supply_line(self, goal: PyTree, params: Any) -> SupplyLine:
        """The supply of an episode: `params.supply`, unless the goal has its own."""
        return params.supply

    @abc.abstractmethod
    def moved(
        self, body: PyTree, delivery: Delivery, goal: PyTree, params: Any
    ) -> tuple[PyTree, Bool[Array, ""]]:
        """The body a period later, and whether the model can describe it there."""

    @abc.abstractmethod
    def markers(self, body: PyTree, params: Any) -> Float[Array, "markers dim"]:
        """Where the markers are [m]; of a single finger the tip last."""

    @abc.abstractmethod
    def observed(self, state: State, params: Any) -> Float[Array, " observations"]:
        """What a controller on the bench has, in shares of its range."""

    @abc.abstractmethod
    def judged(
        self, before: State, action: Float[Array, " actions"], after: State, params: Any
    ) -> Verdict:
        """Reward, end and news of a step."""

    @abc.abstractmethod
    def scene(self, state: State, params: Any) -> "Scene":
        """What the robot and its task look like, for `view.show`."""


BOUND = 2.0  # of an observation, to both sides


def reset(
    env: AbstractEnv, key: Array, params: Any = None
) -> tuple[State, Float[Array, " observations"]]:
    """The beginning of an episode.

    Args:
        env: The environment.
        key: A typed key: the same one gives the same goal.
        params: Numbers of the robot; those of `env.default_params()` if omitted.

    Returns:
        State and observation.

    Raises:
        ValueError: If the dead time of the supply is longer than two steps.

    Example:
        >>> reach = envs.FingerReach()
        >>> state, observation = envs.reset(reach, jax.random.key(0))
        >>> observation.shape, int(state.steps)
        ((33,), 0)
    """
    params = env.default_params() if params is None else params
    _check_supply(env, params.supply)
    draw, noise = jax.random.split(key)
    body, command, goal = env.begin(draw, params)
    seen = _measured(noise, env.markers(body, params), params)
    zero = jnp.zeros((), jnp.int32)
    state = State(body, begun(command), goal, jnp.stack([seen, seen]), zero)
    return state, _observation(env, state, params)


def step(
    env: AbstractEnv,
    key: Array,
    state: State,
    action: Float[Array, " actions"],
    params: Any = None,
) -> Step:
    """One step of an environment: commands out, some steps of physics, measurements in.

    Where the body is no longer finite, or where its model cannot describe it, the state before
    is held, the episode ends, and `info["diverged"]` says so. Derivatives by it are zero: what
    is not finite on the way back is dropped where it would leave the step.

    Args:
        env: The environment.
        key: A typed key, for the noise of measurements.
        state: Of `reset` or the step before.
        action: One number per actuator; clipped to [-1, 1].
        params: Numbers of the robot; those of `env.default_params()` if omitted.

    Returns:
        Observation, state, reward, the two ends and news.

    Raises:
        ValueError: If the action has the wrong shape.

    Example:
        >>> reach = envs.FingerReach()
        >>> state, _ = envs.reset(reach, jax.random.key(0))
        >>> after = envs.step(reach, jax.random.key(1), state, jnp.zeros(3))
        >>> bool(after.terminated), bool(after.info["diverged"]), int(after.state.steps)
        (False, False, 1)

    Reference:
        Towers et al., Gymnasium: a standard interface for reinforcement learning environments,
        2024, for what `terminated` and `truncated` mean.
    """
    params = env.default_params() if params is None else params
    do = "Give one number in [-1, 1] per actuator."
    _check.shape("envs.step", "action", action, (env.num_actions,), do)
    before, action, params = _without_bad_slopes((state, action, params))
    action = jnp.clip(action, -1.0, 1.0)
    command = env.commanded(before.supply.commands[0], action, params)
    line = env.supply_line(before.goal, params)
    delivery, supply = sent(line, before.supply, command, env.period)
    body, fine = env.moved(before.body, delivery, before.goal, params)
    seen = _measured(key, env.markers(body, params), params)
    seen = jnp.stack([seen, before.seen[0]])
    after = State(body, supply, before.goal, seen, before.steps + 1)
    fine = fine & finite(eqx.filter(after, eqx.is_inexact_array))
    held = eqx.tree_at(lambda s: s.steps, before, after.steps)
    after = jax.tree.map(lambda new, old: jnp.where(fine, new, old), after, held)
    verdict = env.judged(before, action, after, params)
    truncated = after.steps >= env.max_steps
    info = verdict.info | {"diverged": ~fine}
    terminated = verdict.terminated | ~fine
    observation = _observation(env, after, params)
    return Step(observation, after, verdict.reward, terminated, truncated, info)


def step_with_reset(
    env: AbstractEnv,
    key: Array,
    state: State,
    action: Float[Array, " actions"],
    params: Any = None,
) -> Step:
    """As `step`, and a new episode begins where one ends.

    Observation and state are then those of the new episode, `info["final_observation"]` is
    that of the old one, as in every other step. No derivative goes from one to the other.

    Args:
        env: The environment.
        key: A typed key, for noise and the next goal.
        state: Of `reset` or the step before.
        action: One number per actuator; clipped to [-1, 1].
        params: Numbers of the robot; those of `env.default_params()` if omitted.

    Returns:
        Observation, state, reward, the two ends and news.

    Raises:
        ValueError: If the action has the wrong shape.

    Example:
        >>> reach = envs.FingerReach(max_steps=1)
        >>> state, _ = envs.reset(reach, jax.random.key(0))
        >>> after = envs.step_with_reset(reach, jax.random.key(1), state, jnp.zeros(3))
        >>> bool(after.truncated), int(after.state.steps)
        (True, 0)
    """
    params = env.default_params() if params is None else params
    noise, draw = jax.random.split(key)
    after = step(env, noise, state, action, params)
    fresh = reset(env, draw, jax.lax.stop_gradient(params))
    done = after.terminated | after.truncated
    final = after.observation
    state, observation = chosen(done, fresh, (after.state, final))
    info = after.info | {"final_observation": final}
    return after._replace(observation=observation, state=state, info=info)


def chosen(done: Bool[Array, ""], fresh: PyTree, old: PyTree) -> PyTree:
    """`fresh` where an episode is over."""
    return jax.tree.map(lambda a, b: jnp.where(done, a, b), fresh, old)


def randomised(
    params: Any, key: Array, spread: PyTree = 0.1, *, members: int | None = None
) -> Any:
    """Parameters whose numbers are multiplied by random factors, for members of a batch.

    Factors are exp(s x), with x uniform in [-1, 1] and the spread s: 0.1 gives numbers from
    10 % below to 10 % above.

    Args:
        params: A tree of numbers, `env.default_params()` for example.
        key: A typed key.
        spread: s [-], one for all numbers, or a tree of them that begins as `params` does, 0
            for what is to stay.
        members: How many sets are drawn, along a first axis; one without that axis if omitted.

    Returns:
        A tree like `params`.

    Raises:
        ValueError: If a spread is negative.

    Example:
        >>> finger = envs.FingerReach().default_params()
        >>> many = envs.randomised(finger, jax.random.key(0), 0.1, members=8)
        >>> many.length.shape, bool((abs(many.length / finger.length - 1) < 0.11).all())
        ((8,), True)

    Reference:
        Peng et al., Sim-to-real transfer of robotic control with dynamics randomization, ICRA
        2018.
    """
    for each in jax.tree.leaves(spread):
        _check.not_negative("envs.randomised", "spread", each, "", "0.1 means 10 per cent.")
    params = jax.tree.map(real, params)
    leaves, tree = jax.tree.flatten(params)
    spreads = jax.tree.leaves(_spread_over(spread, params))
    keys = jax.random.split(key, len(leaves))
    front = () if members is None else (members,)

    def scaled(x, s, key):
        draw = jax.random.uniform(key, (*front, *x.shape), x.dtype, -1.0, 1.0)
        return jnp.broadcast_to(x, draw.shape) * jnp.exp(jnp.asarray(s, x.dtype) * draw)

    made = [scaled(x, s, key) for x, s, key in zip(leaves, spreads, keys, strict=True)]
    return jax.tree.unflatten(tree, made)


def _spread_over(spread: PyTree, params: PyTree) -> PyTree:
    """One spread for every leaf of `params`."""
    return jax.tree.map(lambda s, part: jax.tree.map(lambda _: s, part), spread, params)


def _check_supply(env: AbstractEnv, line: SupplyLine) -> None:
    most = LATE_STEPS * env.period
    do = "A dead time lasts two steps of the environment at most: take more substeps."
    where = type(env).__name__
    _check.between(where, "supply.dead_time", line.dead_time, 0.0, most, "s", do, "[]")


def _observation(env: AbstractEnv, state: State, params: Any) -> Array:
    return jnp.clip(env.observed(state, params), -BOUND, BOUND)


def _measured(key: Array, markers: Array, params: Any) -> Array:
    """Positions of markers with the noise of a camera."""
    return markers + params.marker_noise * jax.random.normal(key, markers.shape, markers.dtype)


def _without_bad_slopes(tree: PyTree) -> PyTree:
    """The same numbers; on the way back, derivatives that are not finite become zero.

    A state that is held has no part in what diverged, but zero times what is not finite is
    not zero: it would reach all that members of a batch share.
    """

    def same(x: Array) -> Array:
        # a linear equation whose transpose is solved so: forward mode goes on unchanged
        return jax.lax.custom_linear_solve(lambda x: x, x, lambda _, b: b, _finite_part)

    return jax.tree.map(lambda x: same(x) if eqx.is_inexact_array(x) else x, tree)


def _finite_part(_, slope: Array) -> Array:
    return jnp.where(jnp.isfinite(slope), slope, jnp.zeros_like(slope))


def in_shares(value: Numbers, most: Float[Array, ""]) -> Float[Array, "..."]:
    """Numbers from 0 to `most`, as ones from -1 to 1."""
    return 2 * real(value) / most - 1
