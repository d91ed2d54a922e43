"""Forces on assemblies: which part each acts on, and their sum in the coordinates.

A `Gravity` or a damping that is listed by itself acts on every part; any other force names
its part: `PartForce("finger", TipWrench(...))`.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.tree import AssemblyState, clamped, gather, in_own_frames, part_motion
from sorojax.rod.forces import forces as one
from sorojax.rod.forces.forces import (
    AbstractDamping,
    AbstractElastic,
    AbstractForce,
    AbstractPressureMap,
    Gravity,
    Pressurised,
    Relaxation,
)
from sorojax.rod.model.assembly import Assembly, index_of, slices
from sorojax.rod.model.link import LinkOperators, LinkState
from sorojax.rod.model.rod import Rod

_SHAPE_ONLY = (AbstractElastic, AbstractDamping, Pressurised, AbstractPressureMap)


class PartForce(eqx.Module):
    """`force` on one `part`, named as in the assembly; a pressure map gets its pressure in a
    network."""

    part: str = eqx.field(static=True)
    force: AbstractForce | AbstractPressureMap


class AbstractPairForce(eqx.Module):
    """A force between two parts."""

    @abc.abstractmethod
    def __call__(
        self, t: Float[Array, ""], first: RodState | LinkState, second: RodState | LinkState
    ) -> tuple[Float[Array, " first"], Float[Array, " second"]]:
        """Generalised forces in the columns of each motion."""


class PairForce(eqx.Module):
    """`force` between two parts, `first` and `second`, named as in the assembly."""

    first: str = eqx.field(static=True)
    second: str = eqx.field(static=True)
    force: AbstractPairForce


class JointEffort(eqx.Module):
    """`effort` of an actuator in the joint of a part, whose name is `part`: torque [N m] or
    force [N], one for each rate of the joint."""

    part: str = eqx.field(static=True)
    effort: Float[Array, "*joint"] = eqx.field(converter=real)


Load = AbstractForce | PartForce | PairForce | JointEffort


def total_force(
    forces: tuple[Load, ...], t: Float[Array, ""], motion: RodState | AssemblyState
) -> Float[Array, " dof"]:
    """Sum of the listed forces and of the elasticity of rods and joints.

    Args:
        forces: Generalised forces beside elasticity.
        t: Time [s].
        motion: State of the model, from `motion`.

    Returns:
        Generalised force, on the right of the equations of motion.
    """
    if isinstance(motion, RodState):
        return one.total_force(plain(forces, motion.rod.group), t, motion)
    total = gather(motion, part_loads(forces, t, motion))
    for term in _joint_forces(forces, motion):
        total = total + term
    return total


def part_loads(
    forces: tuple[Load, ...], t: Float[Array, ""], motion: AssemblyState
) -> list[Float[Array, " own"] | None]:
    """Loads on each part in its own columns, with the elasticity of a rod; None without one.
    Springs, dampers and actuators of the joints, which act on two parts, are not among them."""
    check(motion.assembly, forces)
    loads: list = [_part_load(forces, t, motion, k) for k in range(len(motion.frames))]
    for force in forces:
        if isinstance(force, Gravity):
            _add(loads, dict(enumerate(_weights(motion, force, t))))
        elif isinstance(force, PairForce):
            ends = [index_of(motion.assembly, name) for name in (force.first, force.second)]
            pair = force.force(t, *(part_motion(motion, k) for k in ends))
            _add(loads, dict(zip(ends, pair, strict=True)))
    return loads


def relaxed(forces: tuple[Load, ...]) -> tuple[Load, ...]:
    """The forces without branches, which bear nothing after a long time."""
    return tuple(force for force in forces if relaxation_of(force) is None)


def relaxation_of(force: Load) -> Relaxation | None:
    """The branches that a force is, on all rods or on a part."""
    inner = force.force if isinstance(force, PartForce) else force
    return inner if isinstance(inner, Relaxation) else None


def on_model(forces: tuple[Load, ...], model: Rod | Assembly) -> tuple[Load, ...]:
    """The forces on `model` alone: what does not move is made, once before a loop."""
    if isinstance(model, Rod):
        return tuple(_on_body(force, model) for force in plain(forces, model.group))
    check(model, forces)
    return tuple(
        PartForce(f.part, _on_body(f.force, model[f.part].body))
        if isinstance(f, PartForce)
        else f
        for f in forces
    )


def _on_body(force: Any, body: Any) -> Any:
    fits = isinstance(body, Rod) and isinstance(force, AbstractForce)
    return force.on_rod(body) if fits else force


def weight(
    gravity: Gravity, t: Float[Array, ""], motion: RodState | AssemblyState
) -> Float[Array, " dof"]:
    """Generalised force of gravity alone."""
    if isinstance(motion, RodState):
        return gravity(t, motion)
    return gather(motion, _weights(motion, gravity, t))


def tangent_stiffness(
    forces: tuple[Load, ...], motion: RodState | AssemblyState
) -> Float[Array, "dof dof"]:
    """Elastic stiffness at the coordinates of `motion`, replaced laws included."""
    if isinstance(motion, RodState):
        return one.tangent_stiffness(plain(forces), motion)
    stiffness = motion.operators.stiffness
    for k, at in enumerate(slices(motion.assembly)):
        listed = _on(forces, motion.assembly, k)
        if any(isinstance(force, AbstractElastic) for force in listed):
            own = one.tangent_stiffness(listed, clamped(motion, k))
            stiffness = stiffness.at[at.rod_v, at.rod_v].set(own)
    return stiffness


def damping_matrix(
    forces: tuple[Load, ...], model: Rod | Assembly, constants
) -> Float[Array, "dof dof"]:
    """Sum of the dampings of rods and joints; zeros without one."""
    if isinstance(model, Rod):
        return one.damping_matrix(plain(forces), constants.stiffness)
    damping = constants.damping
    for k, at in enumerate(slices(model)):
        if isinstance(model.parts[k].body, Rod):
            own = one.damping_matrix(_on(forces, model, k), constants.parts[k].stiffness)
            damping = damping.at[at.rod_v, at.rod_v].set(own)
    return damping


def check(assembly: Assembly, forces: tuple[Load, ...]) -> None:
    """Refuse names of no part, and forces that do not say where they act."""
    for force in forces:
        _in_space("assembly", force, assembly.group)
        names = parts_of(force)
        for name in names:
            index_of(assembly, name)
        if not names and not isinstance(force, Gravity | AbstractDamping):
            raise ValueError(
                f"assembly: the force {type(force).__name__} names no part, need one of "
                f"{', '.join(assembly.names)}. Wrap it: rod.PartForce(name, force)."
            )


def parts_of(force: Load) -> tuple[str, ...]:
    """Names of the parts that a force is on; none of one that is on all."""
    if isinstance(force, PairForce):
        return force.first, force.second
    return (force.part,) if isinstance(force, PartForce | JointEffort) else ()


def _on(forces: tuple[Load, ...], assembly: Assembly, index: int) -> tuple:
    """Forces on one part alone, its share of a common damping included."""
    name, is_rod = assembly.names[index], isinstance(assembly.parts[index].body, Rod)
    return tuple(
        force.force if isinstance(force, PartForce) else force
        for force in forces
        if (is_rod and isinstance(force, AbstractDamping))
        or (isinstance(force, PartForce) and force.part == name)
    )


def plain(forces: tuple[Load, ...], group: Any = None) -> Any:
    """Forces that may act on a single rod, with vectors of its `group` where that is given."""
    for force in forces:
        if isinstance(force, PartForce | PairForce | JointEffort):
            raise ValueError(
                f"rod: got {type(force).__name__}, which names a part, need a plain force. A "
                "single rod has no parts: leave the name out, or build an assembly."
            )
        if group is not None:
            _in_space("rod", force, group)
    return forces


def _in_space(where: str, force: Load, group: Any) -> None:
    each = force.force if isinstance(force, PartForce) else force
    _check.in_space(where, each, dim=group.space_dim, twist=group.algebra_dim)


def _part_load(forces, t, motion: AssemblyState, index: int) -> Array | None:
    """Loads of one part in its columns, with the elasticity of a rod."""
    listed = _on(forces, motion.assembly, index)
    if isinstance(motion.operators.parts[index], LinkOperators):
        terms = [force(t, part_motion(motion, index)) for force in listed]
        return functools.reduce(jnp.add, terms) if terms else None
    shape: Any = tuple(force for force in listed if isinstance(force, _SHAPE_ONLY))
    own = one.total_force(shape, t, clamped(motion, index))
    load = jnp.pad(own, (motion.assembly.group.algebra_dim, 0))
    for force in listed:
        if not isinstance(force, _SHAPE_ONLY):
            load = load + force(t, part_motion(motion, index))
    return load


def _weights(motion: AssemblyState, gravity: Gravity, t) -> list[Array]:
    """Weight of each part in its columns; equal rods together, seen from their frames."""
    dim = motion.assembly.group.space_dim
    g = one.gravity_or_earth(gravity.acceleration, dim, motion.q.dtype)
    local = [frame.rotation.T @ g for frame in motion.frames]
    return in_own_frames(motion, lambda part, g: Gravity(g)(t, part), local)


def _joint_forces(forces, motion: AssemblyState) -> list[Float[Array, " dof"]]:
    """Springs, dampers and actuators of the joints."""
    assembly, found = motion.assembly, []
    for part, at in zip(assembly.parts, slices(assembly), strict=True):
        effort = part.joint.effort(motion.q[at.joint_q], motion.v[at.joint_v])
        if effort is not None:
            found.append(jnp.zeros_like(motion.v).at[at.joint_v].set(effort))
    for force in forces:
        if isinstance(force, JointEffort):
            at = slices(assembly)[index_of(assembly, force.part)]
            found.append(jnp.zeros_like(motion.v).at[at.joint_v].set(force.effort))
    return found


def _add(loads: list, terms: dict[int, Array]) -> None:
    for k, term in terms.items():
        loads[k] = term if loads[k] is None else loads[k] + term


# Forces whose numbers change with time


class TimeVaryingForce(AbstractForce):
    """A force made anew at every instant from a signal: `make(signal(t))`.

    `TimeVaryingForce(TipWrench, wave)` is a tip wrench that follows `wave`, any function of
    time [s]; with a module as the signal its numbers are differentiable and never retrace.

    Attributes:
        make: From the value of the signal to a force.
        signal: From time [s] to what `make` takes, e.g. a reference of `systems`.
    """

    make: Callable[[Any], AbstractForce] = eqx.field(static=True)
    signal: Callable[[Float[Array, ""]], Any]

    def __call__(self, t, motion):
        return self.make(self.signal(t))(t, motion)
