"""What crawlers are asked to do, whatever their body is: to go forward on a rough floor."""

import abc
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.envs.core import AbstractEnv, Verdict, in_shares
from sorojax.units import mm

if TYPE_CHECKING:
    from sorojax.view import Scene

MARKERS = 5
_TICK = 10 * mm  # of the floor in pictures; that of the start is longer
_WINDOW = (-0.7, -0.1), (0.7, 0.45)  # of pictures, around the middle, over the length


class FloorGoal(NamedTuple):
    """Angle by which the floor rises ahead [rad]."""

    slope: Float[Array, ""]


def observations(chambers: int) -> int:
    """How many numbers a crawler observes: pressures, commands, and markers twice."""
    return 2 * chambers + 2 * MARKERS * 2


class AbstractCrawler(AbstractEnv):
    """A crawler with chambers from the rear to the front, three of them unless told otherwise,
    which arch its back; its body is left open. `max_pressure` and `max_slope` are among the
    parameters."""

    max_steps: int = eqx.field(static=True, default=200)
    num_actions: ClassVar[int] = 3
    num_observations: ClassVar[int] = observations(3)

    @abc.abstractmethod
    def length(self, params: Any) -> Float[Array, ""]:
        """Of the crawler [m]."""

    @abc.abstractmethod
    def resting(self, params: Any) -> Any:
        """The body at the start, its middle at x = 0."""

    def begin(self, key, params):
        body = self.resting(params)
        number = params.max_slope.dtype
        slope = params.max_slope * jax.random.uniform(key, (), number, -1.0)
        return body, jnp.zeros(self.num_actions, number), FloorGoal(slope)

    def commanded(self, command, action, params):
        return params.max_pressure * (1 + action) / 2

    def observed(self, state, params):
        middle = jnp.mean(state.seen[0, :, 0])
        seen = state.seen.at[:, :, 0].add(-middle) / self.length(params)
        supplied = jnp.stack([state.supply.value, state.supply.commands[0]])
        shares = in_shares(supplied, params.max_pressure)
        return jnp.concatenate([shares.ravel(), seen.ravel()])

    def judged(self, before, action, after, params):
        start, end = (self.markers(x.body, params)[:, 0] for x in (before, after))
        velocity = jnp.mean(end - start) / self.period
        change = action - in_shares(before.supply.commands[0], params.max_pressure)
        reward = 10 * velocity / self.length(params) - 0.1 * jnp.sum(change**2) / 4
        return Verdict(reward, jnp.zeros((), bool), {"velocity": velocity})


def on_floor(drawn: "Scene", middle: float, length: float) -> "Scene":
    """A picture of a body with the floor, whose ticks are 10 mm apart, about `middle` [m]."""
    from sorojax import view

    lower, upper = (np.array([middle + x * length, y * length]) for x, y in _WINDOW)
    first, last = np.ceil(lower[0] / _TICK), np.floor(upper[0] / _TICK)
    deep = 0.3 * lower[1]
    floor = [np.array([[lower[0], 0.0], [upper[0], 0.0]])]
    for x in _TICK * np.arange(first, last + 1):
        floor.append(np.array([[x, 0.0], [x, deep * (2.5 if x == 0 else 1)]]))
    merged = view.merge_scenes(drawn, view.Scene((view.Lines(floor),)))
    return replace(merged, extent=(lower, upper))
