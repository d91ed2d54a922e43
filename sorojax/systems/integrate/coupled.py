"""The method for networks with large bodies: those implicitly, all else along with them."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from sorojax import fem
from sorojax._jax.trace_state import is_traced
from sorojax._types import real
from sorojax.fem.dynamics.step import Interval, Matter, State, begin_step, end_step
from sorojax.fem.equilibrium.jit import known_mask, prepare_traced
from sorojax.fem.equilibrium.linear import Prepared
from sorojax.fem.problem import residual
from sorojax.fem.supports import known_values
from sorojax.math.ode.explicit import AbstractMethod, MethodStep, RungeKutta4, repeated
from sorojax.math.ode.step_control import SearchedAttempt, cut
from sorojax.systems.blocks.driven import exerted
from sorojax.systems.blocks.fem_body import FemBody, acceleration
from sorojax.systems.integrate.fem_step import (
    Drives,
    Equations,
    Fields,
    Stage,
    balanced,
    loaded,
    loaded_step,
    on_the_way,
    search,
)
from sorojax.systems.integrate.march import Rate
from sorojax.systems.network import Network, at_time, inputs_of, rates_of

Names = tuple[str, ...]


class _Known(NamedTuple):
    """Constants of a body for a whole run."""

    matter: Matter
    prepared: Prepared


class Memory(NamedTuple):
    """The memory of the method: acceleration and memory of loads, by body, and whether there
    was a step (1 or 0); and what it keeps."""

    bodies: dict[str, State]
    late: Float[Array, ""]
    known: dict[str, _Known]


class _Given(NamedTuple):
    """All that a part of a step depends on: the state before it, and the part."""

    method: "Coupled"
    network: Network
    inputs: dict[str, Any]
    known: dict[str, _Known]
    t: Float[Array, ""]
    h: Float[Array, ""]
    y: dict[str, PyTree]
    bodies: dict[str, State]
    late: Float[Array, ""]


class Coupled(AbstractMethod):
    """Fixed steps of networks with `FemBody` blocks: generalised-alpha for the bodies, an
    own method for the rest, both solved together in every step.

    Within a step the nodes move along straight lines; on that way the other blocks are
    integrated by `rest`, and what their ports then say are the loads of the bodies at the
    end. Newton's method solves for displacements and loads at once, whatever the
    stiffness of a gas beside that of the walls: there is no iteration between the parts that
    could diverge. Of order 2. A step that does not converge, or would invert a cell, is
    halved, at most `max_cuts` times in a row, and never accepted.

    Differentiable, forward and in reverse, in everything that the network holds: one tangent
    per step, at its solution. The bodies stand in the network itself, not in one within it.

    Attributes:
        rho_inf: Of the bodies: what an oscillation much faster than the step keeps of its
            size in one step.
        rest: Method of all other blocks; `Rodas4()` where a regulator, a valve or a filter
            is much faster than the step.
        substeps: Steps of `rest` in a step.
        newton: Tolerances.
        max_cuts: How often a part of a step may be halved in a row.
    """

    rho_inf: Float[Array, ""] = eqx.field(converter=real, default=0.5)
    rest: AbstractMethod = eqx.field(default_factory=RungeKutta4)
    substeps: int = eqx.field(static=True, default=1)
    newton: fem.Newton = eqx.field(default_factory=fem.Newton)
    max_cuts: int = eqx.field(static=True, default=10)
    num_order: ClassVar[int] = 2
    interpolation_cls: ClassVar = dfx.LocalLinearInterpolation

    @property
    def carries(self) -> bool:
        return True

    def begin(self, field, t, y, h) -> Memory:
        network, inputs = _network(field)
        names = bodies_of(network)
        own = inputs_of(network, t, y, at_time(inputs, t), names)
        known, states = {}, {}
        for name in names:
            block = _block(network, name)
            dynamics = block.dynamics(
                fem.GeneralisedAlpha(0.5).coefficients(), jnp.ones_like(t)
            )
            known[name] = _Known(block.matter(), prepare_traced(block.problem))
            given = block.loaded(block.values(own[name]))
            u, v = y[name]["u"], y[name]["v"]
            kept = y[name].get("strains"), y[name].get("peaks")
            a = acceleration(block, given, known[name].matter, u, v, *kept)
            states[name] = eqx.tree_at(lambda s: s.acceleration, dynamics.start, a)
        return Memory(states, jnp.zeros_like(t), known)

    def advance(self, field, t, y, h, memory):
        network, inputs = _network(field)
        given = (self, network, inputs, memory.known, t)
        start = y, memory.bodies, memory.late
        (new, *kept), converged = cut(_PART, self.max_cuts, given, jnp.asarray(h), start)
        return MethodStep(new, None, Memory(*kept, memory.known), {}, converged)


def bodies_of(block: Any) -> Names:
    """Names of the large bodies of a network."""
    blocks = block.blocks if isinstance(block, Network) else {}
    return tuple(name for name, one in blocks.items() if isinstance(one, FemBody))


def check_places(network: Network, t, y: PyTree | None, inputs: dict[str, Any]) -> None:
    """Refuse bodies whose driven nodes do not begin where their supports are."""
    names = tuple(n for n in bodies_of(network) if _block(network, n).moved)
    if not names or is_traced((network, t, y, inputs)):
        return
    y = network.initial_state() if y is None else y
    for name, far in _strayed(network, t, y, at_time(inputs, t), names).items():
        if far > _OFF * np.max(np.ptp(_block(network, name).problem.mesh.points, axis=0)):
            raise ValueError(
                f"simulate: got `{name}` with nodes {float(far) * 1e3:.3g} mm from where its "
                f"driven supports hold them at {float(t):g} s, need them there. Give "
                "FemBody(..., u=) the displacement at the start, or mesh it at that place."
            )


@eqx.filter_jit
def _strayed(network: Network, t, y, inputs, names: Names) -> dict[str, Float[Array, ""]]:
    """Largest distance of a coordinate of a driven node from where its support is [m]."""
    far, own = {}, inputs_of(network, t, y, inputs, names)
    for name in names:
        block, u = _block(network, name), y[name]["u"]
        supports = block.loaded(block.values(own[name])).supports
        driven = tuple(s for s in supports if s.name in block.moved)
        mask = known_mask(driven, *u.shape)
        off = jnp.abs(known_values(driven, *u.shape) - u.ravel())
        far[name] = jnp.max(jnp.where(mask, off, jnp.zeros_like(off)))
    return far


_OFF = 1e-4  # of the size of a body: farther away nodes would jump in the first step


def _network(field) -> tuple[Network, dict[str, Any]]:
    block = field.block if isinstance(field, Rate) else None
    if not isinstance(block, Network) or not bodies_of(block):
        raise ValueError(
            "Coupled: got no network with a FemBody block, need one, in fixed steps. Call "
            "simulate(network, duration, step=...), with the bodies in the network itself."
        )
    return block, dict(field.inputs)


def _block(network: Network, name: str) -> FemBody:
    block = network.blocks[name]
    assert isinstance(block, FemBody)
    return block


def _part(given, offset, size, state) -> _Given:
    method, network, inputs, known, t = given
    return _Given(method, network, inputs, known, t + offset, size, *state)


def _searched(*part):
    now = _part(*part)
    return search(_EQUATIONS, now.method.newton, now)


def _taken(given, offset, size, state, found):
    """Everything after a part of a step."""
    now = _part(given, offset, size, state)
    u, w = balanced(_EQUATIONS, now, found)
    new, bodies = {}, {}
    stages = _stages(now)
    for name, stage in stages.items():
        end = _ended(now, name, stage, u[name], w[name])
        # what `new` holds goes on
        bodies[name] = dataclasses.replace(end, strains=None, peaks=None)
        new[name] = {
            "u": end.displacement,
            "v": end.velocity,
            "work": end.work,
            "dissipated": end.dissipated,
        }
        if end.strains is not None:
            new[name]["strains"] = end.strains
        if end.peaks is not None:
            new[name]["peaks"] = end.peaks
    pushed = _exerted(now, stages, u, w)
    for name, found in pushed.items():
        new[name]["reactions"] = _later(now, name, found)
    rest = _marched(now, u, pushed)
    after = {name: {**new, **rest}[name] for name in now.y}
    return after, bodies, jnp.ones_like(now.late)


def _stages(now: _Given) -> dict[str, Stage]:
    """The bodies at the start of a step."""
    names = bodies_of(now.network)
    own = inputs_of(now.network, now.t, now.y, at_time(now.inputs, now.t), names)
    scheme = fem.GeneralisedAlpha(now.method.rho_inf).coefficients()
    stages = {}
    for name in names:
        block, state = _block(now.network, name), _state(now, name)
        drives = block.values(own[name])
        dynamics = block.dynamics(scheme, now.h)
        dynamics = eqx.tree_at(lambda d: d.problem, dynamics, block.loaded(drives))
        step = begin_step(dynamics, now.known[name].matter, state, _whole(now.h))
        stages[name] = Stage(dynamics, now.known[name].prepared, state, step, drives)
    return stages


def _whole(h) -> Interval:
    return Interval(jnp.zeros((), jnp.int32), jnp.zeros_like(h), jnp.ones_like(h))


def _state(now: _Given, name: str) -> State:
    y, kept = now.y[name], now.bodies[name]
    return State(
        now.t,
        y["u"],
        y["v"],
        kept.acceleration,
        kept.memory,
        y["work"],
        y["dissipated"],
        kept.share,
        strains=y.get("strains"),
        peaks=y.get("peaks"),
    )


def _ended(now: _Given, name: str, stage: Stage, u, w) -> State:
    step, matter = loaded_step(stage, w), now.known[name].matter
    return end_step(stage.dynamics, matter, stage.state, _whole(now.h), step, u)


Pushed = dict[str, dict[str, Array]]  # what driven supports exert, by body and name


def _answer(now: _Given, stages: dict[str, Stage], u: Fields, w: Drives) -> Drives:
    """What drives the bodies at the end of a step, when they move to `u` under `w`."""
    network, t = now.network, now.t + now.h
    names, pushed = bodies_of(network), _exerted(now, stages, u, w)
    y = {**_marched(now, u, pushed), **_after(now, u, pushed)}
    own = inputs_of(network, t, y, at_time(now.inputs, t), names)
    return {name: _block(network, name).values(own[name]) for name in names}


def _exerted(now: _Given, stages: dict[str, Stage], u: Fields, w: Drives) -> Pushed:
    """What driven supports exert where the forces of a step act, of bodies with some."""
    found = {}
    for name, stage in stages.items():
        block = _block(now.network, name)
        if not block.moved:
            continue
        forces = residual(loaded(stage, w[name]), u[name])
        found[name] = exerted(block.problem.supports, _places(block, stage, w[name]), forces)
    return found


def _places(block: FemBody, stage: Stage, values: dict[str, Array]) -> dict[str, Array]:
    """Where driven supports are when the forces of a step act."""
    return {k: x for k, x in on_the_way(stage, values).items() if k in block.moved}


def _later(now: _Given, name: str, pushed: dict[str, Array]) -> dict[str, dict[str, Array]]:
    """Reactions at the end of a step: on the line through those of two steps."""
    af = fem.GeneralisedAlpha(now.method.rho_inf).coefficients().af
    before = now.y[name]["reactions"]
    return {
        k: {"now": x + now.late * af * (x - before[k]["step"]), "step": x}
        for k, x in pushed.items()
    }


def _during(now: _Given, name: str, pushed: dict[str, Array]) -> dict[str, dict[str, Array]]:
    """Reactions that the other blocks feel in a step: those of its middle, between the one of
    this step and the one before. Held like this whatever mass hangs on a block is as stable
    as one that the method moves itself; of the end of a step, extrapolated, it is not."""
    af = fem.GeneralisedAlpha(now.method.rho_inf).coefficients().af
    share, before = now.late * (0.5 - af), now.y[name]["reactions"]
    return {
        k: {"now": x + share * (before[k]["step"] - x), "step": x} for k, x in pushed.items()
    }


def _marched(now: _Given, u: Fields, pushed: Pushed) -> dict[str, PyTree]:
    """The other blocks at the end of a step."""
    names = tuple(name for name in now.y if name not in u)
    start = {name: now.y[name] for name in names}
    if not jax.tree.leaves(start):
        return start

    def rate(t, x):
        y = {**x, **_between(now, u, pushed, (t - now.t) / now.h)}
        return rates_of(now.network, t, y, at_time(now.inputs, t), names)

    count = now.method.substeps
    return repeated(now.method.rest, rate, now.t, start, now.h / count, count)[0]


def _between(now: _Given, u: Fields, pushed: Pushed, share) -> dict[str, PyTree]:
    """States of the bodies within a step: nodes move along straight lines at the mean
    velocity, so that rates of volumes are those of the volumes, however long the step."""
    af = fem.GeneralisedAlpha(now.method.rho_inf).coefficients().af
    found = {}
    for name, at in u.items():
        start = now.y[name]
        move = (at - start["u"]) / (1 - af)
        found[name] = {**start, "u": start["u"] + share * move, "v": move / now.h}
        if name in pushed:
            found[name]["reactions"] = _during(now, name, pushed[name])
    return found


def _after(now: _Given, u: Fields, pushed: Pushed) -> dict[str, PyTree]:
    """States of the bodies at the end of a step."""
    scheme = fem.GeneralisedAlpha(now.method.rho_inf).coefficients()
    h, found = now.h, {}
    for name, at in u.items():
        start, a = now.y[name], now.bodies[name].acceleration
        move = (at - start["u"]) / (1 - scheme.af)
        late = (move - h * start["v"]) / (scheme.beta * h**2) - (1 / (2 * scheme.beta) - 1) * a
        v = start["v"] + h * ((1 - scheme.gamma) * a + scheme.gamma * late)
        found[name] = {**start, "u": start["u"] + move, "v": v}
        if name in pushed:
            found[name]["reactions"] = _later(now, name, pushed[name])
    return found


_EQUATIONS = Equations(_stages, _answer)
_PART = SearchedAttempt(_searched, _taken)
