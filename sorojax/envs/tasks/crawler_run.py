"""A soft crawler goes forward on a rough floor by the pressures of its three chambers."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.contact import LinePenalty
from sorojax.envs.rods import Inflated, RodBody, places, rolled
from sorojax.envs.supply_line import SupplyLine
from sorojax.envs.tasks.crawl import MARKERS, AbstractCrawler, FloorGoal, on_floor
from sorojax.math.lie import SE2
from sorojax.math.ode.linearly_implicit import LinearlyImplicit
from sorojax.rod import (
    AbstractPressureMap,
    Assembly,
    Damping,
    Free,
    Gravity,
    ObstacleContact,
    Part,
    PartForce,
    Pressurised,
    Straight,
    assembly,
    circle,
    legendre,
    piecewise,
    rest,
    rod,
    thread_chambers,
)
from sorojax.sdf import HalfPlane
from sorojax.units import deg, kPa, mm

_MARKERS = np.linspace(0.0, 1.0, MARKERS)
_POISSON, _POINTS = 0.49, 24
_STIFF = 0.2  # of the floor, in Young's moduli: it carries no more than the weight
_NAME = "crawler"  # of the only part


class CrawlerParams(eqx.Module):
    """Numbers of the crawler, its supply and the floor.

    Attributes:
        length: [m].
        radius: [m].
        young_modulus: [Pa].
        density: [kg/m^3].
        damping: Retardation time of the rubber [s].
        chamber_offset: Of the chambers, above the axis [m].
        chamber_area: Of each chamber across [m^2].
        max_pressure: Of the supply [Pa].
        gravity: [m/s^2].
        max_slope: Of the floor, up or down [rad].
        friction: Coefficient between crawler and floor [-].
        supply: Dead time and lag of the pressures.
        marker_noise: Standard deviation of measured positions [m].
    """

    length: Float[Array, ""] = eqx.field(converter=real, default=150 * mm)
    radius: Float[Array, ""] = eqx.field(converter=real, default=8 * mm)
    young_modulus: Float[Array, ""] = eqx.field(converter=real, default=200 * kPa)
    density: Float[Array, ""] = eqx.field(converter=real, default=1070.0)
    damping: Float[Array, ""] = eqx.field(converter=real, default=0.02)
    chamber_offset: Float[Array, ""] = eqx.field(converter=real, default=5 * mm)
    chamber_area: Float[Array, ""] = eqx.field(converter=real, default=30 * mm**2)
    max_pressure: Float[Array, ""] = eqx.field(converter=real, default=100 * kPa)
    gravity: Float[Array, ""] = eqx.field(converter=real, default=9.81)
    max_slope: Float[Array, ""] = eqx.field(converter=real, default=3 * deg)
    friction: Float[Array, ""] = eqx.field(converter=real, default=0.6)
    supply: SupplyLine = eqx.field(default_factory=lambda: SupplyLine(0.04, 0.01))
    marker_noise: Float[Array, ""] = eqx.field(converter=real, default=0.2 * mm)


class CrawlerRun(AbstractCrawler):
    """Crawl forward on a rough floor by arching the back, third by third.

    The crawler is a planar Cosserat rod, seen from the side and free to move, with a constant
    and a linear mode of bending in each third. A chamber above the axis of each third arches
    it. The floor pushes and rubs along the whole belly, alike in both directions, so it is
    the order of the chambers that makes a way. The floor rises or falls ahead by an angle
    drawn evenly up to `max_slope`, which is not observed.

    Actions, 3 in [-1, 1]: the commanded pressures from the rear to the front, from 0 to the
    greatest. They arrive by the `SupplyLine`.

    Observations, 26: the pressures and the commands, in shares of the greatest from -1 to 1;
    five markers from the rear to the front, now and a step before, in lengths of the crawler:
    along the floor from the middle of those of now, and above it.

    Reward: 10 v / L - 0.1 |c|^2, with the speed v of the mean of the markers along the floor
    [m/s], the length L and the change c of the commands since the step before, in shares: 1
    is a tenth of the length a second. An episode ends by its time alone, or where it
    diverges: the axis is below the floor, for example. `info` has `velocity` [m/s].
    """

    def default_params(self) -> CrawlerParams:
        return CrawlerParams()

    def length(self, params):
        return params.length

    def resting(self, params):
        q = rest(_crawler(params)[0])  # angle, place of the rear, strains
        q = q.at[1].set(-params.length / 2).at[2].set(params.radius)
        return RodBody(q, jnp.zeros_like(q))

    def moved(self, body, delivery, goal, params):
        model, chambers = _crawler(params)
        after = rolled(
            model,
            body,
            (PartForce(_NAME, Inflated(chambers, delivery)), *_always(params, goal)),
            LinearlyImplicit(),
            time_step=self.time_step,
            steps=self.substeps,
        )
        line = places(model, after.q, np.linspace(0.0, 1.0, 2 * _POINTS))
        wide = jnp.max(line[:, 0]) - jnp.min(line[:, 0])
        return after, jnp.all(line[:, 1] > 0) & (wide < 2 * params.length)

    def markers(self, body, params):
        return places(_crawler(params)[0], body.q, _MARKERS)

    def scene(self, state, params):
        from sorojax import view

        model, chambers = _crawler(params)
        inside = (PartForce(_NAME, Pressurised(chambers, state.supply.value)),)
        drawn = view.scene_of(model, np.asarray(state.body.q), forces=inside)
        middle = float(self.markers(state.body, params)[:, 0].mean())
        return on_floor(drawn, middle, float(params.length))


def _crawler(params: CrawlerParams) -> tuple[Assembly, AbstractPressureMap]:
    """The rod on nothing, and its chambers."""
    body = rod(
        SE2(),
        piecewise(legendre(kappa_z=2), 3),
        circle(params.radius),
        length=params.length,
        young_modulus=params.young_modulus,
        poisson_ratio=_POISSON,
        density=params.density,
        nodes=9,
    )
    above = jnp.asarray([1.0, 0.0], params.length.dtype) * params.chamber_offset
    routes = tuple(Straight(above, k / 3, (k + 1) / 3, nodes=4) for k in range(3))
    areas = jnp.broadcast_to(params.chamber_area, (3,))
    return assembly(SE2(), **{_NAME: Part(body, Free())}), thread_chambers(body, routes, areas)


def _always(params: CrawlerParams, goal: FloorGoal) -> tuple[Any, ...]:
    """Weight, the floor, and the damping of the rubber."""
    down = -params.gravity * jnp.stack([jnp.sin(goal.slope), jnp.cos(goal.slope)])
    floor = HalfPlane([0.0, 0.0], [0.0, 1.0])
    law = LinePenalty(
        _STIFF * params.young_modulus, 0.02 * params.radius, params.friction, slip=2e-3
    )
    touch = ObstacleContact(floor, params.radius, law, points=_POINTS, caps="both")
    return Gravity(down), PartForce(_NAME, touch), Damping(params.damping)
