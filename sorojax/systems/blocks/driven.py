"""What a network drives on a finite-element body: loads and supports, by name, and what the
body answers at them."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import fem
from sorojax._types import real
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.fem.problem import body
from sorojax.fem.supports import AbstractSupport, known_values
from sorojax.systems.blocks.block import Output

Driven = AbstractLoad | AbstractSupport

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
    fem.Prescribed: "m",
    fem.Rotated: "rad",
}
#: What a support exerts, as output: the name after its own, and the unit.
_REACTIONS = {
    fem.Prescribed: ("force", "N"),
    fem.Rotated: ("torque", "N m"),
    fem.Carried: ("wrench", None),
}


def value_of(driven: Driven) -> Array:
    """The number or array that an input sets; the pose of the frame that carries nodes."""
    if isinstance(driven, fem.Carried):
        return driven.pose
    return getattr(driven, _field(driven))


def unit_of(driven: Driven) -> str | None:
    return _UNITS.get(type(driven))


def port_of(driven: Driven, kind: str = "pressure") -> str:
    """Name of a port of a load or support."""
    if not isinstance(driven, fem.Pressure):
        return driven.name
    return kind if driven.name == "pressure" else f"{driven.name}_{kind}"


def reaction_port(support: AbstractSupport) -> tuple[str, Output]:
    """Name of the output of what a support exerts on the body, and the output."""
    word, unit = _REACTIONS[type(support)]
    shape = value_of(support).shape
    if isinstance(support, fem.Carried):
        shape = ({2: 3, 3: 6}[support.points.shape[1]],)
    return f"{support.name}_{word}", Output(unit, shape)


def drivable(problem: fem.Problem) -> list[Driven]:
    """What an input may set."""
    return [*problem.loads, *(s for s in problem.supports if s.ramped is not None)]


def with_values(
    loads: tuple[AbstractLoad, ...], values: Mapping[str, Array]
) -> tuple[AbstractLoad, ...]:
    """The loads, those that are named with other values."""
    return tuple(_set(load, values) for load in loads)


def with_places(
    supports: tuple[AbstractSupport, ...], values: Mapping[str, Array]
) -> tuple[AbstractSupport, ...]:
    """The supports, those that are named moved elsewhere."""
    return tuple(s if s.ramped is None else _set(s, values) for s in supports)


def _set(driven: Any, values: Mapping[str, Array]) -> Any:
    if driven.name not in values:
        return driven
    if isinstance(driven, fem.Carried):
        return driven.at(values[driven.name])
    field = _field(driven)
    return eqx.tree_at(lambda d: getattr(d, field), driven, real(values[driven.name]))


def _field(driven: Driven) -> str:
    if isinstance(driven, AbstractLoad):
        return "value"
    assert driven.ramped is not None
    return driven.ramped


def volume(problem: fem.Problem, load: fem.Pressure, u: Float[Array, "nodes dim"]) -> Array:
    """Volume [m^3] that a pressure works on."""
    one = eqx.tree_at(lambda load: load.value, load, jnp.ones((), u.dtype))
    return -one.potential(body(problem), u)


def exerted(
    supports: tuple[AbstractSupport, ...],
    values: Mapping[str, Array],
    forces: Float[Array, "nodes dim"],
) -> dict[str, Array]:
    """What the supports that are driven to `values` exert on a body, by name: the reaction
    `forces` [N] in the direction that each value moves their nodes in, so that its rate times
    the answer is power [W]; of nodes that a frame carries the wrench about its origin, moment
    [N m] first, along the axes of the world."""
    named = {s.name: values[s.name] for s in supports if s.name in values}

    def held(named):
        return known_values(with_places(supports, named), *forces.shape)

    found = jax.vjp(held, named)[1](forces.ravel())[0]
    frames = [s.name for s in supports if isinstance(s, fem.Carried) and s.name in found]
    return found | {name: _wrench(found[name][:-1], values[name]) for name in frames}


def _wrench(slope: Float[Array, "dim h"], pose: Float[Array, "h h"]) -> Float[Array, " twist"]:
    """Of forces f at places x of a frame, from the sum of f x' beside that of f."""
    spread = pose[:-1, :-1] @ slope[:, :-1].T  # the sum of (R x) f'
    turn = spread - spread.T
    pairs = ((0, 1),) if len(turn) == 2 else ((1, 2), (2, 0), (0, 1))
    moment = jnp.stack([turn[i, j] for i, j in pairs])
    return jnp.concatenate([moment, slope[:, -1]])
