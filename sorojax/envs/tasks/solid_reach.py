"""A finger of finite elements brings its tip to a point."""

from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.envs import solids
from sorojax.envs.core import AbstractEnv, Verdict, in_shares
from sorojax.envs.supply_line import SupplyLine
from sorojax.envs.tasks.finger import distance
from sorojax.envs.tasks.finger_reach import ReachGoal
from sorojax.envs.tasks.solid_finger import LENGTH, MAX_PRESSURE, SolidFinger, solid_finger
from sorojax.systems.blocks.modal_basis import displacement
from sorojax.units import mm

_WINDOW = (-0.55, -1.2), (0.55, 0.05)  # of pictures, over the length


class SolidParams(eqx.Module):
    """Numbers of the finger and its supply; those of its rubber over those of the training.

    Attributes:
        stiffness: Of the rubber [-].
        damping: Its viscosity [-].
        density: Inertia and weight [-].
        max_pressure: Of the supply [Pa].
        supply: Dead time and lag of the pressures.
        marker_noise: Standard deviation of measured positions [m].
    """

    stiffness: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    damping: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    density: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    max_pressure: Float[Array, ""] = eqx.field(converter=real, default=MAX_PRESSURE)
    supply: SupplyLine = eqx.field(default_factory=lambda: SupplyLine(0.05, 0.01))
    marker_noise: Float[Array, ""] = eqx.field(converter=real, default=0.1 * mm)


class SolidReach(AbstractEnv):
    """Bring the tip of a planar finger of finite elements to a point within its reach.

    The finger of silicone hangs down, clamped at its upper end, with a row of chambers on each
    side of a spine: air in the left ones bends it to the right. It moves in a few shapes, with
    the force of a few weighted cells (`systems.sampled_body`), in the steps of an implicit
    midpoint rule. The target is where its tip is at rest under two pressures drawn evenly from
    0 to the greatest, so it can be held.

    Actions, 2 in [-1, 1]: the commanded pressures, left and right, from 0 to the greatest. They
    arrive by the `SupplyLine`.

    Observations, 22: the pressures and the commands, in shares of the greatest from -1 to 1;
    the target less the tip, and four markers of the spine now and a step before, in lengths of
    the finger, relative to where they are in the drawing.

    Reward: 1 - d / L - 0.05 |c|^2, with the distance d of the tip to the target, the length L
    and the change c of the commands since the step before, in shares; 1 at best. An episode
    ends by its time alone, or where it diverges: a chosen cell is strained by more than 1.25
    times the largest strain of the training. `info` has `distance` [m] and `success`: it is
    below `tolerance`.

    Attributes:
        tolerance: Distance of success [m].
        body: The finger, from `solid_finger`; that without arguments if omitted, which trains
            for a minute on a computer where it has not been trained before.
    """

    time_step: float = eqx.field(static=True, default=4e-3)
    substeps: int = eqx.field(static=True, default=5)
    tolerance: float = eqx.field(static=True, default=2 * mm)
    body: SolidFinger = eqx.field(default_factory=solid_finger)
    num_actions: ClassVar[int] = 2
    num_observations: ClassVar[int] = 2 * 2 + 2 + 2 * 4 * 2

    def default_params(self) -> SolidParams:
        return SolidParams()

    def begin(self, key, params):
        solid = self._solid(params)
        pressure = params.max_pressure * jax.random.uniform(key, (2,), params.stiffness.dtype)
        held = jnp.stack([jnp.zeros_like(pressure), pressure])
        rest = jax.vmap(lambda each: solids.settled(solid, each).q)(held)
        goal = ReachGoal(solids.places(solid.body, rest[1])[-1], pressure)
        return solids.SolidBody(rest[0], jnp.zeros_like(rest[0])), held[0], goal

    def commanded(self, command, action, params):
        return params.max_pressure * (1 + action) / 2

    def moved(self, body, delivery, goal, params):
        solid = self._solid(params)
        after = solids.rolled(
            solid, body, delivery, time_step=self.time_step, steps=self.substeps
        )
        return after, solid.body.is_known(after.q)

    def markers(self, body, params):
        return solids.places(self.body.reduced.body, body.q)

    def observed(self, state, params):
        both = jnp.stack([state.supply.value, state.supply.commands[0]])
        drawn = solids.places(self.body.reduced.body, jnp.zeros_like(state.body.q))
        ahead = (state.goal.target - state.seen[0, -1]) / LENGTH
        seen = (state.seen - drawn[None]) / LENGTH
        shares = in_shares(both, params.max_pressure)
        return jnp.concatenate([shares.ravel(), ahead, seen.ravel()])

    def judged(self, before, action, after, params):
        gap = distance(self.markers(after.body, params)[-1] - after.goal.target)
        change = action - in_shares(before.supply.commands[0], params.max_pressure)
        reward = 1 - gap / LENGTH - 0.05 * jnp.sum(change**2) / 4
        news = {"distance": gap, "success": gap < self.tolerance}
        return Verdict(reward, jnp.zeros((), bool), news)

    def scene(self, state, params):
        from sorojax import view

        finger, points = self.body, np.asarray(self.body.mesh.points)
        moved = points + np.asarray(displacement(finger.reduced.body.basis, state.body.q))
        drawn = view.scene_of(eqx.tree_at(lambda m: m.points, finger.mesh, jnp.asarray(moved)))
        target = view.Dots(np.asarray(state.goal.target)[None], "#c0392b", 9.0, "target")
        tip = view.Dots(np.asarray(self.markers(state.body, params))[-1:], size=5.0)
        merged = view.merge_scenes(drawn, view.Scene((target, tip)))
        lower, upper = (LENGTH * np.array(corner) for corner in _WINDOW)
        return replace(merged, title="", extent=(lower, upper))

    def _solid(self, params: SolidParams) -> solids.Solid:
        rubber = solids.Rubber(params.stiffness, params.damping, params.density)
        return solids.of_rubber(self.body.reduced.body, rubber)
