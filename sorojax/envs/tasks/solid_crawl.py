"""A soft crawler of finite elements goes forward on a rough floor."""

from dataclasses import replace
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.contact import DirectionalCoulomb
from sorojax.envs import solids
from sorojax.envs.supply_line import SupplyLine
from sorojax.envs.tasks.crawl import AbstractCrawler, FloorGoal, observations, on_floor
from sorojax.envs.tasks.solid_crawler import (
    LENGTH,
    MAX_PRESSURE,
    PORTS,
    SolidCrawler,
    solid_crawler,
)
from sorojax.math.compiled import chunked_lanes
from sorojax.systems.blocks.modal_basis import displacement
from sorojax.systems.blocks.modal_body import ModalBody
from sorojax.systems.blocks.sampled_force import SampledForce
from sorojax.systems.blocks.surface_contact import Stretch
from sorojax.systems.integrate.modal_step import modal_step
from sorojax.units import deg, mm

_GRAVITY = 9.81  # m/s^2
_WITHIN = 2 / 3  # of a step: where forces act at rho_inf 1/2
_PASSES = 30  # of a step at most
_LANES = 4  # members at once on a CPU: a step takes as long as the longest of them


class SolidCrawlParams(eqx.Module):
    """Numbers of the crawler, its supply and the floor; those of its rubber and its friction
    over those of the training.

    Attributes:
        stiffness: Of the rubber [-].
        damping: Its viscosity [-].
        density: Inertia and weight [-].
        max_pressure: Of the supply [Pa].
        max_slope: Of the floor, up or down [rad].
        friction: Of the bristles on the floor, both ways [-].
        supply: Dead time and lag of the pressures.
        marker_noise: Standard deviation of measured positions [m].
    """

    stiffness: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    damping: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    density: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    max_pressure: Float[Array, ""] = eqx.field(converter=real, default=MAX_PRESSURE)
    max_slope: Float[Array, ""] = eqx.field(converter=real, default=1 * deg)
    friction: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    supply: SupplyLine = eqx.field(default_factory=lambda: SupplyLine(0.04, 0.01))
    marker_noise: Float[Array, ""] = eqx.field(converter=real, default=0.2 * mm)


class CrawlingSolid(NamedTuple):
    """Coordinates of the crawler, rates, accelerations, and the springs of its friction."""

    q: Float[Array, " modes"]
    v: Float[Array, " modes"]
    acceleration: Float[Array, " modes"]
    stretch: tuple[Stretch, ...]


class SolidCrawl(AbstractCrawler):
    """Crawl forward on a rough floor with a body of finite elements in contact.

    The crawler is the side view of a `robots.Crawler`: a soft body with two groups of chambers
    on a stiff sole, free to move on three feet, whose bristles slide forward at a third of the
    friction that holds them back. It moves in a few shapes, with the force of a few weighted
    points and the contact of its feet (`systems.sampled_body`). Friction holds without creep.
    Whenever a group arches the back and lets it down the feet go forward. The floor rises or
    falls ahead by an angle drawn evenly up to `max_slope`, which is not observed.

    Actions, observations and reward are those of `CrawlerRun`, for two chambers. An episode
    ends by its time alone, or where it diverges: forces of a step do not balance, or a chosen
    point is strained by more than 1.25 times the largest strain of the training. `info` has
    `velocity` [m/s].

    Attributes:
        body: The crawler, from `solid_crawler`; that without arguments if omitted, which trains
            for a minute on a computer where it has not been trained before.
    """

    num_actions: ClassVar[int] = len(PORTS)
    num_observations: ClassVar[int] = observations(len(PORTS))
    time_step: float = eqx.field(static=True, default=2e-3)
    substeps: int = eqx.field(static=True, default=10)
    body: SolidCrawler = eqx.field(
        converter=lambda body: solid_crawler() if body is None else body, default=None
    )

    def default_params(self) -> SolidCrawlParams:
        return SolidCrawlParams()

    def length(self, params):
        return jnp.asarray(LENGTH, params.stiffness.dtype)

    def resting(self, params):
        q = -LENGTH / 2 * self.body.weight[0]
        springs = tuple(one.unstretched() for one in self.body.reduced.body.contacts)
        return CrawlingSolid(q, jnp.zeros_like(q), jnp.zeros_like(q), springs)

    def moved(self, body, delivery, goal, params):
        h = jnp.asarray(self.time_step, body.q.dtype)
        numbers = jnp.arange(self.substeps, dtype=body.q.dtype)

        def run(small: ModalBody, body: CrawlingSolid):
            def one(now: CrawlingSolid, number: Array):
                air = delivery((number + _WITHIN) * h) / params.density
                inputs = {port: x for (_, port, *_), x in zip(small.ports, air, strict=True)}
                state = {"q": now.q, "v": now.v, "stretch": now.stretch}
                new = modal_step(small, inputs, state, now.acceleration, h, passes=_PASSES)
                moved = (new.state[key] for key in ("q", "v"))
                after = CrawlingSolid(*moved, new.acceleration, new.state["stretch"])
                return after, new.resolved

            after, resolved = jax.lax.scan(one, body, numbers)
            return after, jnp.all(resolved)

        small = self._solid(params, goal)
        after, resolved = chunked_lanes(run, _LANES)(small, body)
        return after, resolved & small.is_known(after.q)

    def markers(self, body, params):
        return solids.places(self.body.reduced.body, body.q)

    def scene(self, state, params):
        from sorojax import view

        cells, basis = self.body.mesh, self.body.reduced.body.basis
        moved = np.asarray(cells.points) + np.asarray(displacement(basis, state.body.q))
        drawn = view.scene_of(eqx.tree_at(lambda m: m.points, cells, jnp.asarray(moved)))
        middle = float(self.markers(state.body, params)[:, 0].mean())
        return on_floor(replace(drawn, title=""), middle, LENGTH)

    def _solid(self, params: SolidCrawlParams, goal: FloorGoal) -> ModalBody:
        """The body of this rubber on this floor, its forces over its density."""
        small = self.body.reduced.body
        down = -_GRAVITY * jnp.stack([jnp.sin(goal.slope), jnp.cos(goal.slope)])
        (floor,) = small.contacts
        assert floor.slider is not None and isinstance(small.force, SampledForce)
        law = floor.slider.law
        assert isinstance(law, DirectionalCoulomb)
        return eqx.tree_at(
            lambda b: (
                b.force.volumes,
                b.force.loads.terms,
                b.damping,
                b.contacts[0].areas,
                b.contacts[0].slider.law.forward,
                b.contacts[0].slider.law.backward,
            ),
            small,
            (
                small.force.volumes * params.stiffness / params.density,
                (down @ self.body.weight,),
                small.damping * params.damping / params.density,
                floor.areas / params.density,
                law.forward * params.friction,
                law.backward * params.friction,
            ),
        )
