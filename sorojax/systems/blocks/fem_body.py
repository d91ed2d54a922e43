"""A finite-element body as a block: loads in, volumes, places and energies out."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import fem
from sorojax._jax.trace_state import is_traced
from sorojax._types import optional_real
from sorojax.fem.dynamics.damping import AbstractDamping
from sorojax.fem.dynamics.masses import kinetic_energy, swing_force, with_masses
from sorojax.fem.dynamics.methods import Coefficients
from sorojax.fem.dynamics.step import Dynamics, Mass, Matter, State, matter
from sorojax.fem.equilibrium.jit import known_mask
from sorojax.fem.loads.facets import open_nodes
from sorojax.fem.loads.loads import AbstractLoad, remembers
from sorojax.fem.problem import body, load_force, residual, with_terms
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
from sorojax.fem.supports import AbstractSupport
from sorojax.math.linalg import sparse
from sorojax.systems.blocks.block import AbstractBlock, Input, Output
from sorojax.systems.blocks.driven import (
    drivable,
    exerted,
    port_of,
    reaction_port,
    unit_of,
    value_of,
    volume,
    with_places,
    with_values,
)


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

    A support that is driven opens an input too: "clamp", a `Prescribed`, the displacement
    `clamp` [m] and the output `clamp_force` [N] that it exerts on the body; a `Rotated` its
    angle [rad] and `clamp_torque` [N m]; a `Carried` the pose of its frame, a homogeneous
    matrix, and `clamp_wrench` about its origin along the axes of the world, moment [N m]
    first: what `AssemblyBody(carrying=...)` gives and takes. Nodes that are driven have the
    velocities and accelerations of their motion; `u` and `v` have to begin with it. Of such a
    body the state holds the `reactions` too; it moves by `Coupled()` only. A chamber that is
    open where a driven support holds its edge has no volume of its own and is refused.

    The equations are stiff and many. `Coupled()` steps them implicitly, together with what
    the rest of the network answers within the step: the default of `simulate(network,
    duration, step=...)` for networks with such a body. Adaptive and explicit methods take
    the block as a system of ordinary differential equations; they suit tests of few cells.

    Attributes:
        problem: Body, supports and loads; its material has a density.
        damping: `fem.Rayleigh(...)` or `fem.KelvinVoigt(...)`.
        driven: Names of the loads and supports that follow an input; every pressure if
            omitted.
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
        names = [one.name for one in drivable(self.problem)]
        for name in self.driven or ():
            if names.count(name) != 1:
                raise ValueError(
                    f"FemBody: `{name}` names {names.count(name)} loads and supports of "
                    f"{names}, need one. Give each a `name=` of its own."
                )
        ports = [*self.inputs, *self.outputs]
        if twice := {port for port in ports if ports.count(port) > 1}:
            raise ValueError(
                f"FemBody: {min(twice)} is the name of two ports. Rename a load or a marker."
            )
        for damping in self.damping:
            damping.check(self.problem)
        self._check_chambers()

    def _check_chambers(self):
        """Refuse a pressure on an open run of facets whose ends a driven support moves."""
        moved = list(self.moved.values())
        pressures = [x for x in self.problem.loads if isinstance(x, fem.Pressure)]
        if not moved or is_traced((moved, pressures)):
            return
        taken = np.concatenate([np.asarray(support.nodes) for support in moved])
        for load in pressures:
            ends = open_nodes(self.problem.mesh.element, np.asarray(load.facets))
            if (ends := np.intersect1d(ends, taken)).size:
                raise ValueError(
                    f"FemBody: the pressure `{load.name}` acts on facets with an open end at "
                    f"nodes {ends[:4].tolist()}, which a driven support moves, so that its "
                    "volume is not known, need a closed chamber. Close it by a wall of the "
                    "mesh."
                )

    @property
    def drives(self) -> dict[str, AbstractLoad]:
        """Loads that follow an input, by name."""
        loads = self.problem.loads
        if self.driven is None:
            return {x.name: x for x in loads if isinstance(x, fem.Pressure)}
        by_name = {x.name: x for x in loads}
        return {name: by_name[name] for name in self.driven if name in by_name}

    @property
    def moved(self) -> dict[str, AbstractSupport]:
        """Supports that follow an input, by name."""
        supports = {x.name: x for x in self.problem.supports if x.ramped is not None}
        return {name: supports[name] for name in self.driven or () if name in supports}

    @property
    def inputs(self):
        return {
            port_of(one): Input(unit_of(one), value_of(one).shape, 0.0)
            for one in (*self.drives.values(), *self.moved.values())
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
        for support in self.moved.values():
            name, port = reaction_port(support)
            ports[name] = port
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
        state |= {name: x for name, x in kept.items() if x is not None}
        return state | self._first_reactions(u, v) if self.moved else state

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
            own = jnp.sum(v.ravel() * sparse.product(system, mass, v.ravel())) / 2
            return own + kinetic_energy(self.problem, u, v)
        for marker, node in self.markers:
            if name == f"{marker}_position":
                return self.problem.mesh.points[node] + u[node]
        for support in self.moved.values():
            if name == reaction_port(support)[0]:
                return state["reactions"][support.name]["now"]
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
        if "reactions" in state:
            raise ValueError(
                f"FemBody: got supports that are driven, {sorted(self.moved)}, whose "
                "acceleration is that of a step, and a method for differential equations, need "
                "one of fixed steps. Call simulate(network, duration, step=...) with "
                "Coupled(), its default."
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
        """Values of the driven loads and supports, by name, from the inputs of the block."""
        driven = {**self.drives, **self.moved}
        return {name: inputs[port_of(one)] for name, one in driven.items()}

    def loaded(self, values: Mapping[str, Array]) -> fem.Problem:
        """The problem with driven loads and supports of these values."""
        terms = (
            with_values(self.problem.loads, values),
            with_places(self.problem.supports, values),
        )
        return with_terms(self.problem, terms)

    def matter(self) -> Matter:
        """Mass and constant damping."""
        return matter(self.dynamics(fem.GeneralisedAlpha().coefficients(), jnp.ones(())))

    def dynamics(self, scheme: Coefficients, h: Float[Array, ""]) -> Dynamics:
        """Data of a step of `h` [s] of this body."""
        zero = jnp.zeros_like(self.problem.mesh.points)
        none = jnp.zeros((), zero.dtype)
        loads = self.problem.loads
        memory = tuple(
            load.in_motion(self.problem) if remembers(load) else None for load in loads
        )
        rest = State(none, zero, zero, zero, memory, none, none, jnp.ones_like(none))
        loads = tuple(None for _ in self.problem.loads)
        supports = tuple(None for _ in self.problem.supports)
        return Dynamics(self.problem, self.damping, scheme, loads, supports, rest, h, self.mass)

    def _first_reactions(self, u, v) -> dict[str, Any]:
        """Reactions at the start, where held nodes do not accelerate."""
        known, problem = self.matter(), self.problem
        kept = relaxed(body(problem), u), first_peaks(body(problem), u)
        a = acceleration(self, problem, known, u, v, *kept)
        loaded = at_instant(problem, known.moduli, *kept)
        force = residual(loaded, u).ravel() + damping_force(self, known, u, v)
        force = force + swing_force(problem, u, v).ravel()
        mass = with_masses(problem, u, known.mass)
        force = force + sparse.product(problem.space.system, mass, a.ravel())
        places = {name: value_of(support) for name, support in self.moved.items()}
        found = exerted(problem.supports, places, force.reshape(u.shape))
        return {"reactions": {name: {"now": x, "step": x} for name, x in found.items()}}

    def _cavities(self) -> dict[str, fem.Pressure]:
        return {n: x for n, x in self.drives.items() if isinstance(x, fem.Pressure)}


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
    force = force - swing_force(loaded, u, v).ravel()
    mask = known_mask(loaded.supports, *u.shape)
    matrix = sparse.fix(system, with_masses(loaded, u, known.mass), mask)
    free = jnp.where(mask, jnp.zeros_like(force), force)
    return sparse.solve(system, matrix, free).reshape(u.shape)


def _pairs(
    markers: Mapping[str, int] | Sequence[tuple[str, int]],
) -> tuple[tuple[str, int], ...]:
    items = markers.items() if isinstance(markers, Mapping) else markers
    return tuple((str(name), int(np.asarray(node))) for name, node in items)
