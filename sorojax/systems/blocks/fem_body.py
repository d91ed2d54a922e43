"""A finite-element body as a block: loads in, volumes, places and energies out."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import fem
from sorojax._types import optional_real
from sorojax.fem.dynamics.damping import AbstractDamping
from sorojax.fem.dynamics.methods import Coefficients
from sorojax.fem.dynamics.step import Dynamics, Mass, Matter, State, matter
from sorojax.fem.equilibrium.jit import known_mask
from sorojax.fem.loads.loads import AbstractLoad, remembers
from sorojax.fem.problem import body, load_force, residual
from sorojax.fem.relaxation import (
    Peaks,
    Strains,
    at_instant,
    first_peaks,
    moduli,
    relaxed,
    stored_energy,
    strain_rates,
)
from sorojax.math.linalg import sparse
from sorojax.systems.blocks.block import AbstractBlock, Input, Output

_UNITS = {
    fem.Pressure: "Pa",
    fem.Traction: "Pa",
    fem.Force: "N",
    fem.Tendon: "N",
    fem.Cable: "m",
    fem.Gravity: "m/s^2",
    fem.Torque: "N m",
    fem.EmbeddedRod: "-",
    fem.BondedRod: "-",
}


class FemBody(AbstractBlock):
    """A hyperelastic body in motion; the state holds displacement u and velocity v of every
    node, and the energies `work` of its loads and `dissipated` by damping since the start; of
    a viscoelastic body also the `strains` that its branches remember, of one that softens the
    `peaks` [J/m^3] of energy.

    A `Pressure` of the name "air" opens the input `air_pressure` (gauge) and the outputs
    `air_volume` and `air_volume_rate`; one of the default name opens `pressure`, `volume`
    and `volume_rate`. Pressure and volume are conjugate in the potential of the load, so no
    energy is lost between gas and body. Other driven loads open an input of their name.
    Each marker opens `<marker>_position`.

    The equations are stiff and many. `Coupled()` steps them implicitly, together with what
    the rest of the network answers within the step: the default of `simulate(network,
    duration, step=...)` for networks with such a body. Adaptive and explicit methods take
    the block as a system of ordinary differential equations; they suit tests of few cells.

    Attributes:
        problem: Body, supports and loads; its material has a density.
        damping: `fem.Rayleigh(...)` or `fem.KelvinVoigt(...)`.
        driven: Names of the loads that follow an input; every pressure if omitted.
        markers: Nodes whose places are outputs, by name.
        u, v: Displacement and velocity at the start [m], [m/s]; zero if omitted.
        energies: Open the outputs `kinetic_energy`, `elastic_energy`, `work`, `dissipated`.
        mass: "consistent" or "lumped".
    """

    problem: fem.Problem
    damping: tuple[AbstractDamping, ...] = eqx.field(
        converter=lambda d: (d,) if isinstance(d, AbstractDamping) else tuple(d), default=()
    )
    driven: tuple[str, ...] | None = eqx.field(static=True, default=None)
    markers: tuple[tuple[str, int], ...] = eqx.field(
        static=True, converter=lambda m: _pairs(m), default=()
    )
    u: Float[Array, "nodes dim"] | None = eqx.field(converter=optional_real, default=None)
    v: Float[Array, "nodes dim"] | None = eqx.field(converter=optional_real, default=None)
    energies: bool = eqx.field(static=True, default=False)
    mass: Mass = eqx.field(static=True, default="consistent")
    large: ClassVar[bool] = True

    def __check_init__(self):
        if self.problem.material.density is None:
            raise ValueError(
                "FemBody: the material has no density, need one [kg/m^3]. Rubber has about "
                "1070: material.neo_hookean(..., density=1070.0)."
            )
        names = [load.name for load in self.problem.loads]
        for name in self.driven or ():
            if names.count(name) != 1:
                raise ValueError(
                    f"FemBody: `{name}` names {names.count(name)} loads of {names}, need one. "
                    "Give loads a `name=` of their own."
                )
        ports = [*self.inputs, *self.outputs]
        if twice := {port for port in ports if ports.count(port) > 1}:
            raise ValueError(
                f"FemBody: {min(twice)} is the name of two ports. Rename a load or a marker."
            )
        for damping in self.damping:
            damping.check(self.problem)

    @property
    def drives(self) -> dict[str, AbstractLoad]:
        """Loads that follow an input, by name."""
        loads = self.problem.loads
        wanted = [x.name for x in loads if isinstance(x, fem.Pressure)]
        wanted = wanted if self.driven is None else self.driven
        return {name: next(x for x in loads if x.name == name) for name in wanted}

    @property
    def inputs(self):
        return {
            port_of(load): Input(_UNITS.get(type(load)), load.value.shape, 0.0)
            for load in self.drives.values()
        }

    @property
    def outputs(self):
        dim = self.problem.mesh.element.dim
        ports = {}
        for load in self._cavities().values():
            ports[port_of(load, "volume")] = Output("m^3")
            ports[port_of(load, "volume_rate")] = Output("m^3/s")
        for name, _ in self.markers:
            ports[f"{name}_position"] = Output("m", (dim,))
        if self.energies:
            names = ("kinetic_energy", "elastic_energy", "work", "dissipated")
            ports |= {name: Output("J") for name in names}
        return ports

    def initial_state(self):
        rest = jnp.zeros_like(self.problem.mesh.points)
        none = jnp.zeros((), rest.dtype)
        u = rest if self.u is None else self.u
        v = rest if self.v is None else self.v
        state = {"u": u, "v": v, "work": none, "dissipated": none}
        bare = body(self.problem)
        kept = {"strains": relaxed(bare, u), "peaks": first_peaks(bare, u)}
        return state | {name: x for name, x in kept.items() if x is not None}

    def output(self, name, t, state, inputs):
        u, v = state["u"], state["v"]
        if name in ("work", "dissipated"):
            return state[name]
        if name == "elastic_energy":
            bare = body(self.problem)
            kept = state.get("strains"), u, state.get("peaks")
            return stored_energy(bare, moduli(bare), *kept)
        if name == "kinetic_energy":
            system, mass = self.problem.space.system, self.matter().mass
            return jnp.sum(v.ravel() * sparse.product(system, mass, v.ravel())) / 2
        for marker, node in self.markers:
            if name == f"{marker}_position":
                return self.problem.mesh.points[node] + u[node]
        for load in self._cavities().values():
            if name == port_of(load, "volume"):
                return volume(self.problem, load, u)
            if name == port_of(load, "volume_rate"):
                return jax.jvp(lambda u, at=load: volume(self.problem, at, u), (u,), (v,))[1]
        raise KeyError(name)

    def vector_field(self, t, state, inputs):
        if "peaks" in state:
            raise ValueError(
                "FemBody: got a body that softens, whose memory changes abruptly, and a "
                "method for differential equations, need one of fixed steps. Call "
                "simulate(network, duration, step=...) with Coupled(), its default."
            )
        u, v = state["u"], state["v"]
        loaded = self.loaded(self.values(inputs))
        known = self.matter()
        resisting = damping_force(self, known, u, v)
        given = jnp.sum(load_force(loaded, u) * v)
        strains = state.get("strains")
        rates = {
            "u": v,
            "v": acceleration(self, loaded, known, u, v, strains),
            "work": given,
            "dissipated": jnp.sum(resisting * v.ravel()),
        }
        if strains is None:
            return rates
        rate, taken = strain_rates(body(self.problem), known.moduli, strains, u, v)
        return {**rates, "strains": rate, "dissipated": rates["dissipated"] + taken}

    def values(self, inputs: Mapping[str, Any]) -> dict[str, Array]:
        """Values of the driven loads, by name, from the inputs of the block."""
        return {name: inputs[port_of(load)] for name, load in self.drives.items()}

    def loaded(self, values: Mapping[str, Array]) -> fem.Problem:
        """The problem under driven loads of these values."""
        loads = with_values(self.problem.loads, values)
        return eqx.tree_at(lambda p: p.loads, self.problem, loads)

    def matter(self) -> Matter:
        """Mass and constant damping."""
        return matter(self.dynamics(fem.GeneralisedAlpha().coefficients(), jnp.ones(())))

    def dynamics(self, scheme: Coefficients, h: Float[Array, ""]) -> Dynamics:
        """Data of a step of `h` [s] of this body."""
        zero = jnp.zeros_like(self.problem.mesh.points)
        none = jnp.zeros((), zero.dtype)
        memory = tuple(load if remembers(load) else None for load in self.problem.loads)
        rest = State(none, zero, zero, zero, memory, none, none, jnp.ones_like(none))
        loads = tuple(None for _ in self.problem.loads)
        supports = tuple(None for _ in self.problem.supports)
        return Dynamics(self.problem, self.damping, scheme, loads, supports, rest, h, self.mass)

    def _cavities(self) -> dict[str, fem.Pressure]:
        return {n: x for n, x in self.drives.items() if isinstance(x, fem.Pressure)}


def port_of(load: AbstractLoad, kind: str = "pressure") -> str:
    """Name of a port of a load."""
    if not isinstance(load, fem.Pressure):
        return load.name
    return kind if load.name == "pressure" else f"{load.name}_{kind}"


def with_values(
    loads: tuple[AbstractLoad, ...], values: Mapping[str, Array]
) -> tuple[AbstractLoad, ...]:
    """The loads, those that are named with other values."""
    return tuple(
        eqx.tree_at(lambda load: load.value, load, values[load.name])
        if load.name in values
        else load
        for load in loads
    )


def volume(problem: fem.Problem, load: fem.Pressure, u: Float[Array, "nodes dim"]) -> Array:
    """Volume [m^3] that a pressure works on."""
    one = eqx.tree_at(lambda load: load.value, load, jnp.ones((), u.dtype))
    return -one.potential(body(problem), u)


def damping_force(block: FemBody, known: Matter, u, v) -> Float[Array, " dofs"]:
    """C v [N]."""
    problem = body(block.problem)
    varying = [d.matrix(problem, known.mass, u) for d in block.damping if not d.constant]
    terms = varying if known.damping is None else [*varying, known.damping]
    system, moving = problem.space.system, v.ravel()
    total = jnp.zeros_like(moving)
    for matrix in terms:
        total = total + sparse.product(system, matrix, moving)
    return total


def acceleration(
    block: FemBody,
    loaded: fem.Problem,
    known: Matter,
    u,
    v,
    strains: Strains | None,
    peaks: Peaks | None = None,
) -> Float[Array, "nodes dim"]:
    """Acceleration [m/s^2] that balances a state under loads."""
    system = loaded.space.system
    loaded = at_instant(loaded, known.moduli, strains, peaks)
    force = -residual(loaded, u).ravel() - damping_force(block, known, u, v)
    mask = known_mask(loaded.supports, *u.shape)
    matrix = sparse.fix(system, known.mass, mask)
    free = jnp.where(mask, jnp.zeros_like(force), force)
    return sparse.solve(system, matrix, free).reshape(u.shape)


def _pairs(
    markers: Mapping[str, int] | Sequence[tuple[str, int]],
) -> tuple[tuple[str, int], ...]:
    items = markers.items() if isinstance(markers, Mapping) else markers
    return tuple((str(name), int(np.asarray(node))) for name, node in items)
