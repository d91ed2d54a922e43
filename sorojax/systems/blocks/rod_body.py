"""A rod as a block: pressures and tensions in, volumes, lengths of tendons and tip out."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import optional_real
from sorojax.math.lie import homogeneous
from sorojax.math.linalg.dense import solve_symmetric
from sorojax.math.ode.held import accelerate
from sorojax.math.status import Status
from sorojax.rod import (
    AbstractForce,
    AbstractPressureMap,
    Assembly,
    Closure,
    Free,
    JointEffort,
    PartForce,
    Pressurised,
    Rod,
    Tendons,
    TipWrench,
    acceleration,
    inertia,
    motion,
    num_coordinates,
    num_dof,
    operators,
    rest,
    slices,
    thread_lengths,
    thread_rates,
    tip_angle,
    tip_pose,
    total_force,
)
from sorojax.rod.dynamics.closures import closure_wrenches, held
from sorojax.rod.dynamics.dynamics import PULL
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.moving import spin_cross
from sorojax.rod.forces.loads import Load, relaxed
from sorojax.rod.forces.relaxation import begun, borne, branches_of, memory_rate
from sorojax.rod.model.assembly import increments, index_of, rate
from sorojax.rod.model.closure import is_closed
from sorojax.rod.statics.equilibrium import checked_status
from sorojax.systems.blocks.block import AbstractBlock, Input, Output

SERVO = 500.0  # 1/s: how fast the joint of a closure follows an input
_FLUID = {"volume": "m^3", "volume_rate": "m^3/s", "compliance": "m^3/Pa"}
_THREAD = {"tendon_length": "m", "tendon_rate": "m/s"}


class RodBody(AbstractBlock):
    """A rod with its forces; the state is {q, v}, and with a `rod.Relaxation` among the forces
    {q, v, memory}: what its branches remember.

    It has the outputs `tip_position` [m], `q`, `v` and, in the plane, `tip_angle` [rad].
    A pressure map among the forces opens the ports `pressure`, `volume`, `volume_rate` (at
    held pressure) and `compliance` of the walls. All come from the same potential as the
    force, so no energy is lost between fluid and rod.

    `rod.Tendons(routes)` without a tension opens the input `tension` [N] and the outputs
    `tendon_length` and `tendon_rate`, a number for one tendon, else one each. A tendon pulls:
    what a negative command asks for is no tension.

    Attributes:
        rod: The rod.
        forces: Its forces; at most one pressure map (of one or several ports), and one
            `rod.Tendons` (of one or several routings) that is commanded.
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
        if (count := sum(map(_is_commanded, self.forces))) > 1:
            raise ValueError(
                f"RodBody: got {count} Tendons without tension, need at most one. List all "
                "routings in one: it then has one port per tendon."
            )

    @property
    def inputs(self):
        chamber = self._chamber()
        ports = {"effort": Input(None, self._dof(), 0.0)} if self.driven else {}
        if chamber is not None:
            ports["pressure"] = Input("Pa", chamber.ports, 0.0)
        if (tendons := self._tendons()) is not None:
            ports["tension"] = Input("N", tendons.ports, 0.0)
        return ports

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
            ports |= {name: Output(unit, chamber.ports, needs) for name, unit in _FLUID.items()}
        if (tendons := self._tendons()) is not None:
            ports |= {name: Output(unit, tendons.ports) for name, unit in _THREAD.items()}
        return ports

    def initial_state(self):
        zero = jnp.zeros(self._dof(), self.rod.length.dtype)
        q = zero if self.q is None else self.q
        state = {"q": q, "v": zero if self.v is None else self.v}
        return state | _first_memory(self.rod, self.forces, q)

    def output(self, name, t, state, inputs):
        q, v = state["q"], state["v"]
        if name in ("q", "v"):
            return state[name]
        if name == "tip_position":
            return tip_pose(self.rod, q)[:-1, -1]
        if name == "tip_angle":
            return tip_angle(motion(self.rod, q))
        if name in _THREAD:
            tendons = self._tendons()
            assert tendons is not None
            return _threaded(tendons, name, self.rod, q, v)
        chamber = self._chamber()
        assert chamber is not None
        return _fluid(chamber, name, q, v, inputs["pressure"])

    def vector_field(self, t, state, inputs):
        moment = motion(self.rod, state["q"], state["v"])
        mass, coriolis = inertia(moment)
        force = total_force(relaxed(self._bound(inputs)), t, moment)
        if self.driven:
            force = force + inputs["effort"]
        pull, rates = _branches(self.rod, self.forces, state, moment.operators)
        force = force if pull is None else force + pull
        return {"q": state["v"], "v": solve_symmetric(mass, force - coriolis)} | rates

    def path_status(self, path):
        return checked_status(Status.successful, self.rod, path["q"])

    def _bound(self, inputs) -> tuple[AbstractForce, ...]:
        return tuple(_under(force, inputs, "") for force in self.forces)

    def _tendons(self) -> Tendons | None:
        return next(
            (f for f in self.forces if isinstance(f, Tendons) and _is_commanded(f)), None
        )

    def _chamber(self) -> AbstractPressureMap | None:
        maps = (f for f in self.forces if isinstance(f, AbstractPressureMap))
        return next(maps, None)

    def _dof(self) -> tuple[int]:
        return (self.rod.basis.num_dof,)


def body_motion(body: RodBody, state) -> RodState:
    """The fields of the rod in a state of the body, for pictures and energies.

    Args:
        body: The rod as a block.
        state: Its state.

    Returns:
        What forces and pictures read.
    """
    return motion(body.rod, state["q"], state["v"])


# An assembly as a block: pressures of its rods in, volumes, tips and joint efforts


class AssemblyBody(AbstractBlock):
    """An assembly with its forces; the state is {q, v}, and with a `rod.Relaxation` among the
    forces {q, v, memory}: what the branches remember.

    Ports of a part are named after it. A pressure map, `PartForce("finger", map)`, opens
    `finger_pressure`, `finger_volume`, `finger_volume_rate` (at held pressure) and
    `finger_compliance`, all from one potential. Tendons without a tension,
    `PartForce("finger", rod.Tendons(routes))`, open `finger_tension`, `finger_tendon_length`
    and `finger_tendon_rate`. A driven joint opens `wrist_effort`. Each part has
    `finger_position`, of its tip or of the frame of a link.

    Closures hold to the tolerance of the run: what a step opens is pulled shut at 50 1/s. Each
    has the output `base_wrench`, on the part that it holds [N m], [N]. Ends are driven by a
    `motion` in time of the closure, or by the network: a closure that is `moved` takes the
    input `base_velocity` [rad/s], [m/s], along the axes of the frame that holds it, and its
    joint follows what that adds up to, kept in the state, as a servo of 500 1/s does.

    A part that is `carrying` something has the output `palm_pose`, a homogeneous matrix of its
    tip or of the frame of a link, and takes the input `palm_reaction`: the wrench about that
    place, along the axes of the world and moment [N m] first, that it exerts on what it
    carries. A solid on a link is `FemBody(problem, driven=("grip",))` with a `fem.Carried`
    support, wired both ways: `{"solid.grip": "arm.palm_pose", "arm.palm_reaction":
    "solid.grip_wrench"}`.

    Attributes:
        assembly: The assembly.
        forces: Its forces; at most one pressure map and one commanded set of tendons per rod.
        driven: Parts whose joints take an effort from outside.
        q, v: Coordinates and rates at the start; at rest if omitted.
        carrying: Parts that another block is fixed to.
        moved: Closures whose joint an input moves.
    """

    assembly: Assembly
    forces: tuple[Load, ...] = ()
    driven: tuple[str, ...] = eqx.field(static=True, converter=tuple, default=())
    q: Float[Array, " coordinates"] | None = eqx.field(converter=optional_real, default=None)
    v: Float[Array, " dof"] | None = eqx.field(converter=optional_real, default=None)
    carrying: tuple[str, ...] = eqx.field(static=True, converter=tuple, default=())
    moved: tuple[str, ...] = eqx.field(static=True, converter=tuple, default=())

    def __check_init__(self):
        names = [part for part, _ in _maps(self.forces)]
        pulled = [part for part, _ in _tendons(self.forces)]
        for parts, what in ((names, "pressure maps"), (pulled, "Tendons without tension")):
            twice = {name for name in parts if parts.count(name) > 1}
            if twice:
                raise ValueError(
                    f"AssemblyBody: `{min(twice)}` has {parts.count(min(twice))} {what}, need "
                    "at most one per rod. Return several volumes from one map, and list all "
                    "routings of a rod in one Tendons."
                )
        for name in (*names, *pulled, *self.driven, *self.carrying):
            index_of(self.assembly, name)
        for name in self.moved:
            if name not in self.assembly.loops or self._closure(name).motion is not None:
                raise ValueError(
                    f"AssemblyBody: `moved` names `{name}`, need a closure without a motion of "
                    f"its own, of {', '.join(self.assembly.loops) or 'none'}. Add one by "
                    "rod.with_closures."
                )

    @property
    def inputs(self):
        ports = {f"{k}_pressure": Input("Pa", m.ports, 0.0) for k, m in self._maps().items()}
        for part, tendons in _tendons(self.forces):
            ports[f"{part}_tension"] = Input("N", tendons.ports, 0.0)
        for name in self.driven:
            ports[f"{name}_effort"] = Input(None, (self._joint_dof(name),), 0.0)
        twist = self.assembly.group.algebra_dim
        wrenches = {f"{name}_reaction": Input(None, (twist,), 0.0) for name in self.carrying}
        moved = {f"{name}_velocity": Input(None, (twist,), 0.0) for name in self.moved}
        return ports | wrenches | moved

    @property
    def outputs(self):
        dim = self.assembly.group.space_dim
        ports = {f"{name}_position": Output("m", (dim,)) for name in self.assembly.names}
        ports |= {f"{k}_pose": Output(None, (dim + 1, dim + 1)) for k in self.carrying}
        ports["q"] = Output(None, (num_coordinates(self.assembly),))
        felt, twist = frozenset(self.inputs), self.assembly.group.algebra_dim
        ports |= {f"{k}_wrench": Output(None, (twist,), felt) for k in self.assembly.loops}
        for name, chamber in self._maps().items():
            needs = frozenset({f"{name}_pressure"})
            for kind, unit in _FLUID.items():
                ports[f"{name}_{kind}"] = Output(unit, chamber.ports, needs)
        for part, tendons in _tendons(self.forces):
            ports |= {f"{part}_{k}": Output(unit, tendons.ports) for k, unit in _THREAD.items()}
        return ports

    def initial_state(self):
        start = rest(self.assembly)
        zero = jnp.zeros(num_dof(self.assembly), start.dtype)
        q = start if self.q is None else self.q
        state = {"q": q, "v": zero if self.v is None else self.v}
        group = self.assembly.group
        places = {f"{name}_place": Free().rest(group, q.dtype) for name in self.moved}
        return state | places | _first_memory(self.assembly, self.forces, q)

    def output(self, name, t, state, inputs):
        q, v = state["q"], state["v"]
        if name == "q":
            return q
        for loop in self.assembly.loops:
            if name == f"{loop}_wrench":
                moment, _, reactions, _ = self.solved(t, state, inputs)
                assert reactions is not None  # there is a loop
                return closure_wrenches(moment, t, reactions)[loop]
        for part, chamber in self._maps().items():
            kind = name.removeprefix(f"{part}_")
            if name != kind and kind in _FLUID:
                at = slices(self.assembly)[index_of(self.assembly, part)]
                own = (q[at.rod_q], v[at.rod_v])
                return _fluid(chamber, kind, *own, inputs[f"{part}_pressure"])
        for part, tendons in _tendons(self.forces):
            kind, body = name.removeprefix(f"{part}_"), self.assembly[part].body
            if name != kind and kind in _THREAD:
                at = slices(self.assembly)[index_of(self.assembly, part)]
                assert isinstance(body, Rod)  # links have no threads
                return _threaded(tendons, kind, body, q[at.rod_q], v[at.rod_v])
        if name in (f"{part}_pose" for part in self.carrying):
            return tip_pose(self.assembly, q)[name.removesuffix("_pose")]
        return tip_pose(self.assembly, q)[name.removesuffix("_position")][:-1, -1]

    def vector_field(self, t, state, inputs):
        q, v = state["q"], state["v"]
        if not is_closed(self.assembly) and branches_of(self.assembly, self.forces) is None:
            constants, forces = operators(self.assembly), self.acting(inputs)
            a = acceleration(self.assembly, constants, t, q, v, forces)
            return {"q": rate(self.assembly, q, v), "v": a}
        _, a, _, rates = self.solved(t, state, inputs)
        return {"q": rate(self.assembly, q, v), "v": a} | rates

    def moment(self, state) -> Any:
        """The assembly as it moves in a state."""
        return motion(self.assembly, state["q"], state["v"])

    def solved(
        self, t, state, inputs, added: Callable[[Any], tuple[Any, Any]] | None = None
    ) -> tuple[Any, Array, Array | None, dict[str, Array]]:
        """The moment, the acceleration, the reactions of closures, and the rates of what is
        kept beside q and v; with the mass and the force that are `added` at a moment."""
        model, rates = self._with_motions(t, state, inputs)
        constants = operators(model)
        pull, remembering = _branches(model, self.forces, state, constants)
        moment: Any = motion(model, state["q"], state["v"], constants=constants)
        mass, coriolis = inertia(moment)
        force = total_force(relaxed(self.acting(inputs)), t, moment) - coriolis
        force = force if pull is None else force + pull
        if added is not None:
            more = added(moment)
            mass, force = mass + more[0], force + more[1]
        rates = rates | remembering
        if not is_closed(model):
            return moment, solve_symmetric(mass, force), None, rates
        found = accelerate(mass, force, held(moment, t, SERVO if self.moved else PULL))
        return moment, found.x, found.reactions, rates

    def _with_motions(self, t, state, inputs) -> tuple[Assembly, dict[str, Array]]:
        """The assembly with moved closures where they are, and the rates of their places."""
        model, rates, closures = self.assembly, {}, []
        for name, closure in zip(model.loops, model.closures, strict=True):
            if name in self.moved:
                place, twist = state[f"{name}_place"], inputs[f"{name}_velocity"]
                pose = Free().pose(model.group, place)
                closure = dataclasses.replace(closure, motion=_Moving(*pose, twist, t))
                rates[f"{name}_place"] = Free().rate(model.group, place, twist)
            closures.append(closure)
        return dataclasses.replace(model, closures=tuple(closures)), rates

    def _closure(self, name: str) -> Closure:
        return self.assembly.closures[self.assembly.loops.index(name)]

    def path_status(self, path):
        return checked_status(Status.successful, self.assembly, path["q"])

    def acting(self, inputs) -> tuple[Load, ...]:
        """The forces under given inputs: maps with their pressures, joints with efforts."""
        plain: list[Load] = []
        bound: list[Load] = []
        for force in self.forces:
            if isinstance(force, PartForce) and _takes_input(force.force):
                bound.append(
                    PartForce(force.part, _under(force.force, inputs, f"{force.part}_"))
                )
            else:
                plain.append(force)
        driven = tuple(JointEffort(name, inputs[f"{name}_effort"]) for name in self.driven)
        carried = tuple(
            PartForce(name, TipWrench(-inputs[f"{name}_reaction"])) for name in self.carrying
        )
        return (*plain, *bound, *driven, *carried)

    def _maps(self) -> dict[str, AbstractPressureMap]:
        return dict(_maps(self.forces))

    def _joint_dof(self, name: str) -> int:
        return self.assembly[name].joint.num_dof(self.assembly.group)


class _Moving(eqx.Module):
    """A pose that moves with a twist: exact to the first order in time from `now`."""

    rotation: Float[Array, "dim dim"]
    position: Float[Array, " dim"]
    twist: Float[Array, " twist"]
    now: Float[Array, ""]

    def __call__(self, t):
        ahead, rot = t - self.now, self.twist.shape[0] - self.position.shape[0]
        spun = spin_cross(self.twist[None, :rot], self.rotation.T).T
        position = self.position + ahead * self.twist[rot:]
        return homogeneous(self.rotation + ahead * spun, position)


def _is_commanded(force: Any) -> TypeGuard[Tendons]:
    return isinstance(force, Tendons) and force.tension is None


def _takes_input(force: Any) -> bool:
    """Whether a force has its pressure or tension from the network."""
    return isinstance(force, AbstractPressureMap) or _is_commanded(force)


def _under(force: Any, inputs, prefix: str) -> AbstractForce:
    """A force under the inputs that it takes."""
    if isinstance(force, AbstractPressureMap):
        return Pressurised(force, inputs[f"{prefix}pressure"])
    return force.pulled(inputs[f"{prefix}tension"]) if _is_commanded(force) else force


def _threaded(tendons: Tendons, name: str, rod: Rod, q: Array, v: Array) -> Array:
    """Lengths of tendons, or their rates."""
    if name == "tendon_length":
        return thread_lengths(rod, tendons.routes, q).reshape(tendons.ports)
    return thread_rates(rod, tendons.routes, q, v).reshape(tendons.ports)


def _tendons(forces: tuple[Load, ...]) -> list[tuple[str, Tendons]]:
    """The commanded tendons, with the parts that they are in."""
    on = [force for force in forces if isinstance(force, PartForce)]
    return [(f.part, f.force) for f in on if _is_commanded(f.force)]


def _maps(forces: tuple[Load, ...]) -> list[tuple[str, AbstractPressureMap]]:
    """The pressure maps, with the parts that they are on."""
    on = [force for force in forces if isinstance(force, PartForce)]
    return [(f.part, f.force) for f in on if isinstance(f.force, AbstractPressureMap)]


def _first_memory(model: Rod | Assembly, forces: tuple[Any, ...], q: Array) -> dict:
    """The memory of branches that have relaxed at `q`, of a body that has some."""
    branches = branches_of(model, forces)
    return {} if branches is None else {"memory": begun(branches, increments(model, q))}


def _branches(model: Rod | Assembly, forces: tuple[Any, ...], state, constants):
    """The force of the branches, None without any, and the rate of their memory."""
    branches = branches_of(model, forces, constants)
    if branches is None:
        return None, {}
    x, memory = increments(model, state["q"]), state["memory"]
    return borne(branches, x, memory), {"memory": memory_rate(branches, x, memory)}


def _fluid(chamber: AbstractPressureMap, kind: str, q: Array, v: Array, pressure: Array):
    volume = jax.grad(chamber.coenergy, argnums=1)
    if kind == "volume":
        return volume(q, pressure)
    if kind == "compliance":
        one = jnp.ones_like(pressure)
        return jax.jvp(lambda p: volume(q, p), (pressure,), (one,))[1]
    return jax.jvp(lambda q: volume(q, pressure), (q,), (v,))[1]
