"""A pneumatic finger brings its tip to a point."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.envs.core import Verdict
from sorojax.envs.tasks import finger
from sorojax.units import mm


class ReachGoal(NamedTuple):
    """Where the tip should be [m], and the pressures that hold it there [Pa]."""

    target: Float[Array, "3"]
    pressure: Float[Array, " actions"]


class FingerReach(finger.AbstractFinger):
    """Bring the tip of a hanging finger with three chambers to a point within its reach.

    The finger is a Cosserat rod with two modes of bending in each plane and one of stretch,
    clamped with its axis down. The target is where its tip is at rest under three pressures
    drawn evenly from 0 to the greatest, so it can be held.

    Actions, 3 in [-1, 1]: the commanded pressures, from 0 to the greatest. They arrive by the
    `SupplyLine`.

    Observations, 33: the pressures and the commands, in shares of the greatest from -1 to 1;
    the target less the tip, and four markers now and a step before, in lengths of the finger,
    relative to where they are when it is straight.

    Reward: 1 - d / L - 0.05 |c|^2, with the distance d of the tip to the target, the length L
    and the change c of the commands since the step before, in shares; 1 at best. An episode
    ends by its time alone, or where it diverges. `info` has `distance` [m] and `success`: it
    is below `tolerance`.

    Attributes:
        tolerance: Distance of success [m].
    """

    tolerance: float = eqx.field(static=True, default=5 * mm)
    num_observations: ClassVar[int] = 2 * 3 + 3 + 2 * 4 * 3

    def default_params(self) -> finger.FingerParams:
        return finger.FingerParams()

    def begin(self, key, params):
        pressure = params.max_pressure * jax.random.uniform(key, (3,), params.length.dtype)
        goal = ReachGoal(finger.tip_at_rest(pressure, params), pressure)
        return finger.hanging(params), jnp.zeros_like(pressure), goal

    def observed(self, state, params):
        ahead = (state.goal.target - state.seen[0, -1]) / params.length
        parts = finger.supplied(state, params), ahead, finger.seen(state, params)
        return jnp.concatenate(parts)

    def judged(self, before, action, after, params):
        gap = self.markers(after.body, params)[-1] - after.goal.target
        distance = finger.distance(gap)
        change = finger.change(before, action, params)
        reward = 1 - distance / params.length - 0.05 * change
        news = {"distance": distance, "success": distance < self.tolerance}
        return Verdict(reward, jnp.zeros((), bool), news)

    def scene(self, state, params):
        from sorojax import view

        target = finger.in_picture(state.goal.target[None])
        mark = view.Scene((view.Dots(target, "#c0392b", 9.0, "target"),))
        return view.merge_scenes(finger.scene_of(state, params), mark)
