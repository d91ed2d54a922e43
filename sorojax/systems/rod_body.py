"""A rod as a block: pressure in, volume and tip out."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import optional_real
from sorojax.math.dense import solve_symmetric
from sorojax.math.status import Status
from sorojax.rod import (
    AbstractForce,
    AbstractPressureMap,
    Motion,
    Pressurised,
    Rod,
    inertia,
    motion,
    tip_angle,
    tip_pose,
    total_force,
)
from sorojax.rod.validity import checked_status
from sorojax.systems.block import AbstractBlock, Input, Output


class RodBody(AbstractBlock):
    """A rod with its forces; the state is {q, v}.

    A pressure map among the forces opens the ports `pressure`, `volume`, `volume_rate` (at
    held pressure) and `compliance` of the walls. All come from the same potential as the
    force, so no energy is lost between fluid and rod.

    Attributes:
        rod: The rod.
        forces: Its forces; at most one pressure map (of one or several ports).
        q, v: Coordinates and rates at the start; zero if omitted.
        driven: Open an input `effort`, a generalised force from outside.
    """

    rod: Rod
    forces: tuple[AbstractForce | AbstractPressureMap, ...] = ()
    q: Float[Array, " dof"] | None = eqx.field(converter=optional_real, default=None)
    v: Float[Array, " dof"] | None = eqx.field(converter=optional_real, default=None)
    driven: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        maps = [f for f in self.forces if isinstance(f, AbstractPressureMap)]
        if len(maps) > 1:
            raise ValueError(
                f"RodBody: got {len(maps)} pressure maps, need at most one. Return several "
                "volumes from one map: it then has one port per chamber."
            )

    @property
    def inputs(self):
        chamber = self._chamber()
        effort = {"effort": Input(None, self._dof(), 0.0)} if self.driven else {}
        if chamber is None:
            return effort
        return effort | {"pressure": Input("Pa", chamber.ports, default=0.0)}

    @property
    def outputs(self):
        dim = self.rod.group.space_dim
        ports = {"tip_position": Output("m", (dim,)), "q": Output(None, self._dof())}
        ports["v"] = Output(None, self._dof())
        if dim == 2:
            ports["tip_angle"] = Output("rad")
        chamber = self._chamber()
        if chamber is not None:
            needs = frozenset({"pressure"})
            units = {"volume": "m^3", "volume_rate": "m^3/s", "compliance": "m^3/Pa"}
            ports |= {name: Output(unit, chamber.ports, needs) for name, unit in units.items()}
        return ports

    def initial_state(self):
        zero = jnp.zeros(self._dof(), self.rod.length.dtype)
        return {
            "q": zero if self.q is None else self.q,
            "v": zero if self.v is None else self.v,
        }

    def output(self, name, t, state, inputs):
        q, v = state["q"], state["v"]
        if name in ("q", "v"):
            return state[name]
        if name == "tip_position":
            return tip_pose(self.rod, q)[:-1, -1]
        if name == "tip_angle":
            return tip_angle(motion(self.rod, q))
        chamber = self._chamber()
        assert chamber is not None
        pressure = inputs["pressure"]
        volume = jax.grad(chamber.coenergy, argnums=1)
        if name == "compliance":
            one = jnp.ones_like(pressure)
            return jax.jvp(lambda p: volume(q, p), (pressure,), (one,))[1]
        value, rate = jax.jvp(lambda q: volume(q, pressure), (q,), (v,))
        return value if name == "volume" else rate

    def vector_field(self, t, state, inputs):
        moment = motion(self.rod, state["q"], state["v"])
        mass, coriolis = inertia(moment)
        force = total_force(self._bound(inputs), t, moment)
        if self.driven:
            force = force + inputs["effort"]
        return {"q": state["v"], "v": solve_symmetric(mass, force - coriolis)}

    def path_status(self, path):
        return checked_status(Status.successful, self.rod, path["q"])

    def _bound(self, inputs) -> tuple[AbstractForce, ...]:
        return tuple(
            Pressurised(force, inputs["pressure"])
            if isinstance(force, AbstractPressureMap)
            else force
            for force in self.forces
        )

    def _chamber(self) -> AbstractPressureMap | None:
        maps = (f for f in self.forces if isinstance(f, AbstractPressureMap))
        return next(maps, None)

    def _dof(self) -> tuple[int]:
        return (self.rod.basis.num_dof,)


def body_motion(body: RodBody, state) -> Motion:
    """The fields of the rod in a state of the body, for pictures and energies."""
    return motion(body.rod, state["q"], state["v"])
