"""A pneumatic finger follows a moving reference, behind a supply whose delay varies."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._types import real
from sorojax.envs.core import Verdict
from sorojax.envs.supply_line import SupplyLine, between
from sorojax.envs.tasks import finger
from sorojax.units import mm

_AHEAD = 1, 2, 4, 8  # steps of the preview
_ONSET = 0.5  # s, in which the reference leaves the tip at rest
_SHARE = 0.8  # of the greatest pressure, in one chamber: two reach 0.87 between their planes


class TrackingParams(finger.FingerParams):
    """Numbers of the finger, its supply and the reference, beside those of `FingerParams`.

    Attributes:
        supply: The slowest supply of an episode.
        fastest: The fastest one.
        max_frequency: Of each of both circles [Hz].
    """

    supply: SupplyLine = eqx.field(default_factory=lambda: SupplyLine(0.1, 0.035))
    fastest: SupplyLine = eqx.field(default_factory=lambda: SupplyLine(0.03, 0.005))
    max_frequency: Float[Array, ""] = eqx.field(converter=real, default=0.8)


class TrackingGoal(NamedTuple):
    """The reference, the sum of two circles, and the supply of the episode.

    Attributes:
        radius: Of each circle [m].
        rate: Angular velocity on each, to either side [rad/s].
        phase: On each at the start [rad].
        reach: The sum of the radii at most [m].
        supply: Dead time and lag.
    """

    radius: Float[Array, "2"]
    rate: Float[Array, "2"]
    phase: Float[Array, "2"]
    reach: Float[Array, ""]
    supply: SupplyLine


class TipTracking(finger.AbstractFinger):
    """Follow a moving reference with the tip of a hanging finger, through a slow supply.

    The finger is that of `FingerReach`. The reference moves across the axis: the sum of two
    circles of random radii, frequencies up to `max_frequency` to either side, and phases; it
    grows from the tip at rest within half a second. Together the radii are 0.5 to 1 of the
    reach, which is how far the tip is aside at rest under 0.8 of the greatest pressure in one
    chamber. Dead time and lag of the supply are drawn for each episode, evenly between
    `fastest` and `supply`, and are not observed.

    Actions, 3 in [-1, 1]: the commanded pressures, from 0 to the greatest. They arrive by the
    supply.

    Observations, 40: the pressures and the commands, in shares of the greatest from -1 to 1;
    in lengths of the finger the reference less the tip (2), the reference 1, 2, 4 and 8 steps
    ahead less that of now (8), and four markers now and a step before, relative to where they
    are when it is straight.

    Reward: 1 - d / r - 0.05 |c|^2, with the distance d of the tip to the reference, both seen
    along the axis, the reach r and the change c of the commands since the step before, in
    shares; 1 at best. An episode ends by its time alone, or where it diverges. `info` has
    `distance` [m] and `success`: it is below `tolerance`.

    Attributes:
        tolerance: Distance of success [m].
    """

    max_steps: int = eqx.field(static=True, default=200)
    tolerance: float = eqx.field(static=True, default=3 * mm)
    num_observations: ClassVar[int] = 2 * 3 + 2 + 2 * len(_AHEAD) + 2 * 4 * 3

    def default_params(self) -> TrackingParams:
        return TrackingParams()

    def begin(self, key, params):
        draw = jax.random.uniform(key, (8,), params.length.dtype)
        one = jnp.zeros(3, draw.dtype).at[0].set(_SHARE * params.max_pressure)
        reach = finger.distance(finger.tip_at_rest(one, params)[1:])
        radius = (0.5 + 0.5 * draw[0]) * reach * jnp.stack([draw[1], 1 - draw[1]])
        rate = 2 * jnp.pi * params.max_frequency * (2 * draw[2:4] - 1)
        line = between(params.fastest, params.supply, draw[4:6])
        phase = 2 * jnp.pi * draw[6:8]
        goal = TrackingGoal(radius, rate, phase, reach, line)
        return finger.hanging(params), jnp.zeros_like(one), goal

    def supply_line(self, goal, params):
        return goal.supply

    def observed(self, state, params):
        ahead = self.reference(state.goal, state.steps + np.array([0, *_AHEAD], np.int32))
        gap = ahead[0] - state.seen[0, -1, 1:]
        told = jnp.concatenate([gap, (ahead[1:] - ahead[:1]).ravel()]) / params.length
        parts = finger.supplied(state, params), told, finger.seen(state, params)
        return jnp.concatenate(parts)

    def judged(self, before, action, after, params):
        wanted = self.reference(after.goal, after.steps[None])[0]
        distance = finger.distance(self.markers(after.body, params)[-1, 1:] - wanted)
        change = finger.change(before, action, params)
        reward = 1 - distance / after.goal.reach - 0.05 * change
        news = {"distance": distance, "success": distance < self.tolerance}
        return Verdict(reward, jnp.zeros((), bool), news)

    def reference(
        self, goal: TrackingGoal, steps: Int[Array, " times"]
    ) -> Float[Array, "times 2"]:
        """Where the tip should be across the axis [m], at some numbers of steps."""
        t = steps.astype(goal.rate.dtype)[:, None] * self.period
        share = jnp.minimum(t / _ONSET, 1.0)
        angle = goal.rate[None] * t + goal.phase[None]
        aside = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1) @ goal.radius
        return share**2 * (3 - 2 * share) * aside

    def scene(self, state, params):
        from sorojax import view

        def below(aside):
            """At the height of the tip of a straight finger."""
            depth = jnp.broadcast_to(params.length, (len(aside), 1))
            return finger.in_picture(jnp.concatenate([depth, aside], axis=1))

        path = below(self.reference(state.goal, jnp.arange(self.max_steps + 1)))
        now = below(self.reference(state.goal, state.steps[None]))
        marks = (
            view.Lines([path], "#c0392b", 0.8, name="reference"),
            view.Dots(now, "#c0392b", 9.0),
        )
        return view.merge_scenes(finger.scene_of(state, params), view.Scene(marks))
