"""Assemblies: a tree of rods and rigid links with joints between them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._arguments import axis_lengths
from sorojax._display import displayed
from sorojax._types import optional_real, real
from sorojax.rod.model.closure import Closure, check_closure
from sorojax.rod.model.joint import AbstractJoint, Fixed, Group
from sorojax.rod.model.link import Link, is_massless
from sorojax.rod.model.rod import Rod


class Part(eqx.Module):
    """A rod or a link, and what it is mounted on.

    Attributes:
        body: The rod or link; its frame starts at the base of the rod.
        joint: How it moves on its mount.
        on: Name of the part that carries it; None for the ground.
        offset: Pose of the joint in the frame that carries it, homogeneous, position [m]:
            that of the link, or of the section at `s` of the rod. The same if omitted.
        s: Where on a rod that carries it, in [0, 1].
    """

    body: Rod | Link
    joint: AbstractJoint = eqx.field(default_factory=Fixed)
    on: str | None = eqx.field(static=True, default=None)
    offset: Float[Array, "h h"] | None = eqx.field(converter=optional_real, default=None)
    s: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    def __check_init__(self):
        if _check.is_concrete(self.s) and not 0 <= float(self.s) <= 1:
            raise ValueError(f"Part: `s` is {self.s}, need a point of the rod in [0, 1].")


@displayed
class Assembly(eqx.Module):
    """A tree of parts. The coordinates are those of the parts in their order: of the joint,
    then of the rod.

    Attributes:
        group: `SE2()` or `SE3()`.
        names: Names of the parts; a part comes after what carries it.
        parts: The parts.
        loops: Names of the closures.
        closures: Joints that close loops, or hold parts to the ground; `with_closures` adds
            them.
    """

    group: Group
    names: tuple[str, ...] = eqx.field(static=True)
    parts: tuple[Part, ...]
    loops: tuple[str, ...] = eqx.field(static=True, default=())
    closures: tuple[Closure, ...] = ()

    def __check_init__(self):
        if not self.parts:
            raise ValueError("assembly: got no part, need one or more. Name it: arm=Part(rod).")
        for index, (name, part) in enumerate(zip(self.names, self.parts, strict=True)):
            _check_part(self.group, name, part, self.names[:index])
        for name in self.loops:
            check_closure(self, name)
        carriers = {part.on for part in self.parts}
        for name, part in zip(self.names, self.parts, strict=True):
            _check_mass(self.group, name, part, name in carriers)

    def __getitem__(self, name: str) -> Part:
        return self.parts[index_of(self, name)]

    def _text(self) -> str:
        rows = [f"Assembly in {type(self.group).__name__}: {num_coordinates(self)} coordinates"]
        for name, part in zip(self.names, self.parts, strict=True):
            where = f"on {part.on}" if part.on else "on the ground"
            kind, joint = type(part.body).__name__, type(part.joint).__name__
            rows.append(f"  {name}: {kind}, {joint} joint {where}")
        for name, closure in zip(self.loops, self.closures, strict=True):
            where, joint = closure.on or "the ground", type(closure.joint).__name__
            rows.append(f"  {name}: {joint} joint of {closure.part} on {where}, closes a loop")
        return "\n".join(rows)


class Slices(NamedTuple):
    """Where a part has its numbers: in q those of its joint, `joint_q`, and of its rod,
    `rod_q`, in v `joint_v` and `rod_v`."""

    joint_q: slice
    rod_q: slice
    joint_v: slice
    rod_v: slice


def assembly(group: Group, **parts: Part) -> Assembly:
    """A tree of rods and rigid links with joints between them.

    Args:
        group: `SE2()` for a planar, `SE3()` for a spatial assembly, that of all its rods.
        **parts: Parts by name, each after the one that carries it: a rod or link, its joint,
            the name of the part that it is mounted on (the ground by default) and its offset.

    Returns:
        The assembly; its coordinates are those of the parts in their order, of the joint before
        those of the rod.

    Raises:
        ValueError: If there is no part, one comes before the part that carries it, or a rod or
            link is of another group.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> chain = rod.assembly(SE2(), lower=rod.Part(finger, rod.Revolute()),
        ...                      upper=rod.Part(finger, on="lower"))
        >>> rod.num_coordinates(chain)
        7

    Reference:
        Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 4.
    """
    return Assembly(group, tuple(parts), tuple(parts.values()))


def serial(*rods: Rod, joint: AbstractJoint | None = None) -> Assembly:
    """Rods end to end, clamped to each other: `segment_0`, `segment_1`, ...

    Args:
        *rods: The segments, from the base on.
        joint: Between the ground and the first; clamped if omitted.

    Returns:
        The assembly.
    """
    if not rods:
        raise ValueError("serial: got no rod, need one or more.")
    first = Part(rods[0], Fixed() if joint is None else joint)
    others = [Part(rod, on=f"segment_{k}") for k, rod in enumerate(rods[1:])]
    names = tuple(f"segment_{k}" for k in range(len(rods)))
    return Assembly(rods[0].group, names, (first, *others))


def with_closures(model: Rod | Assembly, **closures: Closure) -> Assembly:
    """The model with joints between points of its parts, or to the ground, beside those of its
    tree: rings, four-bars, parallel robots, rods held or driven at both ends.

    Where the coordinates are q, the closures ask g(q, t) = 0 and give the forces G(q)' lambda
    with G = dg/dq: `equilibrium`, paths of it and `rollout` find the reactions lambda.

    Args:
        model: A rod, which becomes an assembly with the part `rod`, or an assembly.
        **closures: Closures by name.

    Returns:
        The assembly; its coordinates are those of the tree.

    Raises:
        ValueError: If a closure names no part, a name is taken, or a joint cannot close a loop.

    Example:
        >>> beam = rod.rod(SE2(), rod.chebyshev(kappa_z=4), rod.circle(5 * mm), length=0.1,
        ...                young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> held = rod.with_closures(beam, tip=rod.Closure("rod", rod.Roller(),
        ...                                        offset=rod.tip_pose(beam, rod.rest(beam))))
        >>> rest = rod.equilibrium(held, (rod.Gravity(),))
        >>> print(f"{float(rest.reactions['tip'][2]) * 1e3:.1f} mN")
        28.9 mN

    Reference:
        Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 8.
    """
    if isinstance(model, Rod):
        model = Assembly(model.group, ("rod",), (Part(model),))
    if taken := set(closures).intersection(model.loops):
        raise ValueError(
            f"with_closures: there is a closure `{min(taken)}` already. Rename one."
        )
    return Assembly(
        model.group,
        model.names,
        model.parts,
        (*model.loops, *closures),
        (*model.closures, *closures.values()),
    )


def index_of(assembly: Assembly, name: str) -> int:
    """Position of a part in the order of the parts."""
    if name not in assembly.names:
        raise ValueError(
            f"assembly: there is no part `{name}`, need one of {', '.join(assembly.names)}."
        )
    return assembly.names.index(name)


def parents(assembly: Assembly) -> tuple[int | None, ...]:
    """Index of the carrier of each part."""
    names = assembly.names
    return tuple(None if p.on is None else names.index(p.on) for p in assembly.parts)


def closure_ends(assembly: Assembly) -> tuple[int | None, ...]:
    """Index of the part that each closure holds, then of the part that carries it, in turn."""
    names = [name for c in assembly.closures for name in (c.part, c.on)]
    return tuple(None if name is None else index_of(assembly, name) for name in names)


def slices(assembly: Assembly) -> tuple[Slices, ...]:
    """Where each part has its coordinates and rates.

    Args:
        assembly: The assembly.

    Returns:
        Slices of q and v, of the joint and of the rod, one entry per part.
    """
    found, q, v, group = [], 0, 0, assembly.group
    for part in assembly.parts:
        body = part.body.basis.num_dof if isinstance(part.body, Rod) else 0
        # by its class, as a module makes an object of each method that is taken from it
        joint, kind = part.joint, type(part.joint)
        jq, jv = kind.num_coordinates(joint, group), kind.num_dof(joint, group)
        ends = (slice(q, q + jq), slice(q + jq, q + jq + body))
        rates = (slice(v, v + jv), slice(v + jv, v + jv + body))
        found.append(Slices(*ends, *rates))
        q, v = q + jq + body, v + jv + body
    return tuple(found)


def num_coordinates(model: Rod | Assembly) -> int:
    """Length of q.

    Args:
        model: The rod or assembly.

    Returns:
        The number of coordinates.
    """
    return model.basis.num_dof if isinstance(model, Rod) else slices(model)[-1].rod_q.stop


def num_dof(model: Rod | Assembly) -> int:
    """Length of v, and of generalised forces.

    Args:
        model: The rod or assembly.

    Returns:
        The number of rates.
    """
    return model.basis.num_dof if isinstance(model, Rod) else slices(model)[-1].rod_v.stop


@axis_lengths(Rod)
@axis_lengths(Assembly)
def _(model: Rod | Assembly) -> dict[str, int]:
    return {"coordinates": num_coordinates(model), "dof": num_dof(model)}


def rest(model: Rod | Assembly) -> Float[Array, " coordinates"]:
    """Coordinates at which rods are unstrained and joints at rest.

    Args:
        model: The rod or assembly.

    Returns:
        The coordinates.
    """
    dtype = dtype_of(model)
    if isinstance(model, Rod):
        return jnp.zeros(model.basis.num_dof, dtype)
    return _by_part(
        model,
        lambda joint, at: joint.rest(model.group, dtype),
        lambda at: jnp.zeros(at.rod_q.stop - at.rod_q.start, dtype),
    )


def retract(
    model: Rod | Assembly, q: Array, increment: Float[Array, " dof"]
) -> Float[Array, " coordinates"]:
    """Coordinates after an increment."""
    if is_flat(model):
        return q + increment
    return _by_part(
        model,
        lambda joint, at: joint.retract(model.group, q[at.joint_q], increment[at.joint_v]),
        lambda at: q[at.rod_q] + increment[at.rod_v],
    )


def rate(model: Rod | Assembly, q: Array, v: Array) -> Float[Array, " coordinates"]:
    """dq/dt at the rates v; v itself but for quaternions."""
    if is_flat(model):
        return v
    return _by_part(
        model,
        lambda joint, at: joint.rate(model.group, q[at.joint_q], v[at.joint_v]),
        lambda at: v[at.rod_v],
    )


def increments(model: Rod | Assembly, q: Array) -> Float[Array, " dof"]:
    """The coordinates in the places of their rates; zero where those are others, as those of
    a quaternion, which stores no energy."""
    if is_flat(model):
        return q

    def of_joint(joint: AbstractJoint, at: Slices) -> Array:
        count = at.joint_v.stop - at.joint_v.start
        own = q[at.joint_q]
        return own if own.shape[0] == count else jnp.zeros(count, q.dtype)

    return _by_part(model, of_joint, lambda at: q[at.rod_q])


def _by_part(
    assembly: Any,
    of_joint: Callable[[AbstractJoint, Slices], Array],
    of_rod: Callable[[Slices], Array],
) -> Array:
    """One vector of what the joint and the rod of every part give."""
    pieces = []
    for part, at in zip(assembly.parts, slices(assembly), strict=True):
        pieces += [of_joint(part.joint, at), of_rod(at)]
    return jnp.concatenate(pieces)


def is_flat(model: Rod | Assembly) -> bool:
    """Whether dq/dt = v for every joint."""
    return num_coordinates(model) == num_dof(model)


def dtype_of(model: Rod | Assembly):
    """Type of the numbers of the model."""
    if isinstance(model, Rod):
        return model.length.dtype
    kinds = [p.body.length if isinstance(p.body, Rod) else p.body.mass for p in model.parts]
    return np.result_type(*(kind.dtype for kind in kinds))


def _check_part(group: Group, name: str, part: Part, before: tuple[str, ...]) -> None:
    where = f"assembly: part `{name}`"
    if part.on is not None and part.on not in before:
        raise ValueError(
            f"{where} is on `{part.on}`, need one of the parts before it "
            f"({', '.join(before) or 'none'}). List the carrier first."
        )
    body_group = part.body.group if isinstance(part.body, Rod) else group
    if type(body_group) is not type(group):
        raise ValueError(
            f"{where} is a {type(body_group).__name__} rod, need {type(group).__name__} as "
            "the assembly has. Give all rods one group."
        )
    if part.offset is not None:
        size = group.space_dim + 1
        do = "Give a homogeneous matrix, e.g. sorojax.math.lie.homogeneous(R, p)."
        _check.shape(where, "offset", part.offset, (size, size), do)


def _check_mass(group: Group, name: str, part: Part, carries: bool) -> None:
    bare = isinstance(part.body, Link) and is_massless(part.body)
    if bare and not carries and type(part.joint).num_dof(part.joint, group) > 0:
        raise ValueError(
            f"assembly: the link `{name}` moves and has no mass, need one, or a part that it "
            "carries. Give its mass [kg] and inertia [kg m^2]."
        )
