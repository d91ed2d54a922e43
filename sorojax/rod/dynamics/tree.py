"""State of an assembly at one time: rods of equal structure in batches, and the tree that
carries them.

Each part is seen in its own frame: its columns are the twist of the frame and its own
coordinates, so the cost of a rod does not grow with the length of the chain that carries it.
Only the tree knows the coordinates of the assembly: twists pass outwards, inertia and loads
inwards. A rod takes the planar or the spatial equations according to its group.

Reference:
    Featherstone, Rigid Body Dynamics Algorithms, 2008, chapters 5 and 6, for the passes.
"""

from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax.rod.dynamics import moving, planar, spatial
from sorojax.rod.dynamics.fields import Operators, RodState, operators
from sorojax.rod.dynamics.moving import release, spin_cross, turned_twists
from sorojax.rod.dynamics.points import Points, from_base
from sorojax.rod.model.assembly import (
    Assembly,
    closure_ends,
    dtype_of,
    num_coordinates,
    num_dof,
    parents,
    slices,
)
from sorojax.rod.model.link import (
    Link,
    LinkOperators,
    link_inertia,
    link_motion,
    link_operators,
    place_link,
)
from sorojax.rod.model.rod import Rod

_KERNEL = {2: planar, 3: spatial}


def rod_motion(
    rod: Rod,
    q: Float[Array, " dof"],
    v: Float[Array, " dof"] | None = None,
    constants: Operators | None = None,
) -> RodState:
    """The fields of a rod clamped at the origin."""
    do = f"The rod has {rod.basis.num_dof} coordinates, ordered as its basis."
    _check.shape("rod", "q", q, (rod.basis.num_dof,), do)
    constants = operators(rod) if constants is None else constants
    v = jnp.zeros_like(q) if v is None else v
    return _KERNEL[rod.group.space_dim].motion(rod, constants, q, v)


def rod_inertia(moment: RodState) -> tuple[Float[Array, "dof dof"], Float[Array, " dof"]]:
    """Mass matrix and Coriolis force of a moment."""
    return _KERNEL[moment.rod.group.space_dim].inertia(moment)


def bias_rates(moment: RodState) -> tuple[Float[Array, "quad rot"], Float[Array, "quad dim"]]:
    """d/ds of the accelerations at zero coordinate acceleration, angular and linear."""
    return _KERNEL[moment.rod.group.space_dim].bias_rates(moment)


# An assembly at one moment: batches of equal rods, and the tree that carries them


class AssemblyOperators(NamedTuple):
    """Constant arrays of an assembly.

    Attributes:
        parts: Those of each part.
        batches: Those of equal rods, stacked.
        rows: Integrals from the base of the carrier to each mount [m].
        stiffness, damping: Linear elasticity of rods and joints, damping of joints.
        ends: Integrals from the base of a rod to where each closure holds it, then to where
            it carries that closure [m]; None of links and of the ground.
    """

    parts: tuple[Operators | LinkOperators, ...]
    batches: tuple[Operators, ...]
    rows: tuple[Float[Array, "1 quad"] | None, ...]
    stiffness: Float[Array, "dof dof"]
    damping: Float[Array, "dof dof"]
    ends: tuple[Float[Array, "1 quad"] | None, ...] = ()


class Mount(NamedTuple):
    """How a part moves on its carrier.

    Attributes:
        carried: Twist of the part per twist and coordinate of the carrier; the ground has none.
        axes: Twist of the part per rate of the joint.
        turn: Rotation from the carrier's frame to the part's.
        joint_axes: Twist per rate of the joint along the carrier's axes.
        arm: From the section of the carrier to the part, along the carrier's axes [m]; None of
            a part that sits there.
        spin: Angular Jacobian of that section in the columns of the carrier.
    """

    carried: Float[Array, "twist carrier"]
    axes: Float[Array, "twist joint"]
    turn: Float[Array, "dim dim"]
    joint_axes: Float[Array, "twist joint"]
    arm: Float[Array, " dim"] | None
    spin: Float[Array, "rot carrier"]


class Frame(NamedTuple):
    """Frame of a part in the world: `rotation`, whose columns are its axes, `position` [m], and
    its `twist` along these axes."""

    rotation: Float[Array, "dim dim"]
    position: Float[Array, " dim"]
    twist: Float[Array, " twist"]


Section = tuple[Array, Array, Array, Array]


class AssemblyState(eqx.Module):
    """An assembly at one moment; forces see its parts by `part_motion`.

    Attributes:
        assembly: The assembly.
        operators: Its constants.
        q, v: Coordinates and rates.
        batches: Motions of equal rods, clamped in their own frames, stacked.
        mounts, frames: How each part is carried, and where it is.
        ends: Sections that each closure holds and that carry it, in turn.
    """

    assembly: Assembly
    operators: AssemblyOperators
    q: Float[Array, " coordinates"]
    v: Float[Array, " dof"]
    batches: tuple[RodState, ...]
    mounts: tuple[Mount, ...]
    frames: tuple[Frame, ...]
    ends: tuple[Section, ...]


def batches(assembly: Assembly) -> tuple[tuple[int, ...], ...]:
    """Indices of the rods of equal structure, which are computed together."""
    kinds: list = []
    found: list[list[int]] = []
    for index, part in enumerate(assembly.parts):
        if isinstance(part.body, Rod):
            leaves, structure = jax.tree.flatten(part.body)
            kind = (structure, [(leaf.shape, leaf.dtype) for leaf in leaves])
            if kind not in kinds:
                kinds.append(kind)
                found.append([])
            found[kinds.index(kind)].append(index)
    return tuple(tuple(members) for members in found)


def assembly_operators(assembly: Assembly) -> AssemblyOperators:
    """The constant arrays of `assembly`; differentiable in all its leaves."""
    dtype, total = dtype_of(assembly), num_dof(assembly)
    parts, rows = [], []
    stiffness, damping = jnp.zeros((total, total), dtype), jnp.zeros((total, total), dtype)
    for part, at in zip(assembly.parts, slices(assembly), strict=True):
        body = part.body
        own = operators(body) if isinstance(body, Rod) else link_operators(body, dtype)
        parts.append(own)
        rows.append(_rows(assembly, part.on, part.s))
        spring, damper = part.joint.matrices(assembly.group, dtype)
        stiffness = stiffness.at[at.joint_v, at.joint_v].set(spring)
        damping = damping.at[at.joint_v, at.joint_v].set(damper)
        if isinstance(body, Rod):
            stiffness = stiffness.at[at.rod_v, at.rod_v].set(own.stiffness)
    stacks = tuple(
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *(parts[k] for k in members))
        for members in batches(assembly)
    )
    closures = assembly.closures
    held = [x for c in closures for x in ((c.part, c.at), (c.on, c.s))]
    ends = tuple(_rows(assembly, *place) for place in held)
    return AssemblyOperators(tuple(parts), stacks, tuple(rows), stiffness, damping, ends)


def _rows(assembly: Assembly, part: str | None, s: Array) -> Float[Array, "1 quad"] | None:
    """Weights that integrate a field from the base of a rod to `s` [m]; None of a link and of
    the ground."""
    body = None if part is None else assembly[part].body
    return from_base(body, s[None]) if isinstance(body, Rod) else None


def assembly_motion(
    assembly: Assembly,
    q: Float[Array, " coordinates"],
    v: Float[Array, " dof"] | None = None,
    constants: AssemblyOperators | None = None,
) -> AssemblyState:
    """The fields of all parts at (q, v)."""
    count = num_coordinates(assembly)
    do = f"The assembly has {count} coordinates and {num_dof(assembly)} rates; see `rest`."
    _check.shape("assembly", "q", q, (count,), do)
    v = jnp.zeros(num_dof(assembly), q.dtype) if v is None else v
    _check.shape("assembly", "v", v, (num_dof(assembly),), do)
    constants = assembly_operators(assembly) if constants is None else constants
    places = slices(assembly)
    moments = []
    for members, stack in zip(batches(assembly), constants.batches, strict=True):
        rod = assembly.parts[members[0]].body
        assert isinstance(rod, Rod)
        own_q = jnp.stack([q[places[k].rod_q] for k in members])
        own_v = jnp.stack([v[places[k].rod_v] for k in members])
        every = eqx.filter_vmap(lambda c, q, v, rod=rod: rod_motion(rod, q, v, c))
        moments.append(every(stack, own_q, own_v))
    blank = AssemblyState(assembly, constants, q, v, tuple(moments), (), (), ())
    return AssemblyState(assembly, constants, q, v, tuple(moments), *_carry(blank))


def clamped(moment: AssemblyState, index: int) -> RodState:
    """The motion of a rod in its own frame, clamped there."""
    for members, stack in zip(batches(moment.assembly), moment.batches, strict=True):
        if index in members:
            one = _taken(stack, members.index(index))
            own = moment.operators.parts[index]
            both = (moment.assembly.parts[index].body, own)
            return eqx.tree_at(lambda m: (m.rod, m.operators), one, both)
    raise ValueError(f"assembly: `{moment.assembly.names[index]}` is a link, need a rod.")


def _taken(stack: RodState, at: int | slice | np.ndarray) -> RodState:
    return jax.tree.map(lambda leaf: leaf[at] if eqx.is_array(leaf) else leaf, stack)


def in_own_frames(
    moment: AssemblyState,
    function: Callable[..., Any],
    *more: Sequence[Array],
    among: Collection[int] | None = None,
) -> list[Any]:
    """`function` of each part as it moves, in its own frame, and of its entries in `more`:
    equal rods together, `among` those alone of whose kind one is among these, and no links."""
    found: list[Any] = [None] * len(moment.frames)
    rows = [frame.twist for frame in moment.frames], *more
    for members, stack in zip(batches(moment.assembly), moment.batches, strict=True):
        if among is not None and not set(among).intersection(members):
            continue
        every = eqx.filter_vmap(lambda m, twist, *rest: function(release(m, twist), *rest))
        answers = every(stack, *(jnp.stack([row[k] for k in members]) for row in rows))
        for place, k in enumerate(members):
            found[k] = jax.tree.map(lambda leaf, place=place: leaf[place], answers)
    for k, part in enumerate(moment.assembly.parts):
        if among is None and isinstance(part.body, Link):
            constants: Any = moment.operators.parts[k]
            twist, *rest = (row[k] for row in rows)
            found[k] = function(link_motion(part.body, constants, twist), *rest)
    return found


def part_motion(moment: AssemblyState, index: int) -> Any:
    """A part in the world frame, a `RodState` or a `LinkState`; its columns are its own twist
    and coordinates.

    Args:
        moment: State of the assembly, from `motion`.
        index: Number of the part, in the order of the assembly.

    Returns:
        The state of the part.
    """
    rotation, position, twist = moment.frames[index]
    body = moment.assembly.parts[index].body
    if isinstance(body, Rod):
        return moving.place(moving.release(clamped(moment, index), twist), rotation, position)
    constants = moment.operators.parts[index]
    assert isinstance(constants, LinkOperators)
    return place_link(link_motion(body, constants, twist), rotation, position)


def sections(
    moment: AssemblyState, places: Sequence[tuple[int | None, Float[Array, "1 quad"] | None]]
) -> list[Section]:
    """Rotation, position and Jacobians (angular, linear) of sections of parts, in the frame
    and the columns of the part: where `rows` integrate to, of a link its frame, and the ground
    where the part is None; those of equal rods together."""
    group, dtype = moment.assembly.group, moment.q.dtype
    dim, rot, twist = group.space_dim, group.rotation_dim, group.algebra_dim
    eye = jnp.asarray(np.eye(twist), dtype)
    ground = (jnp.asarray(np.eye(dim), dtype), jnp.zeros(dim, dtype), eye[:rot], eye[rot:])
    found: list[Section] = [ground] * len(places)
    on = [index for index, _ in places]
    weights = {k: rows for k, (_, rows) in enumerate(places) if rows is not None}
    for members, stack in zip(batches(moment.assembly), moment.batches, strict=True):
        carried = [k for k in weights if on[k] in members]
        if not carried:
            continue
        taken = [members.index(on[k]) for k in carried]  # pyright: ignore[reportArgumentType]
        rows = jnp.stack([weights[k] for k in carried])
        # A slice is a view, a gather a loop.
        in_row = taken == list(range(taken[0], taken[0] + len(taken)))
        at = slice(taken[0], taken[0] + len(taken)) if in_row else np.array(taken)
        every = eqx.filter_vmap(_section)(_taken(stack, at), rows)
        for nth, k in enumerate(carried):
            rotation, centre, angular, linear = (field[nth] for field in every)
            found[k] = rotation, centre, angular, linear
    return found


def _section(moment: RodState, rows: Float[Array, "1 quad"]) -> Section:
    at, dim = Points(moment, rows), moment.tangent.shape[1]
    centre, angular = at.position[0], at.angular_jacobian[0]
    rot, dtype = angular.shape[0], angular.dtype
    eye = jnp.asarray(np.eye(rot + dim), dtype)
    linear = eye[rot:].at[:, :rot].set(moving.levers(centre[None])[0])
    angular = jnp.concatenate([eye[:rot], angular], axis=1)
    linear = jnp.concatenate([linear, at.linear_jacobian[0]], axis=1)
    return at.directors[0], centre, angular, linear


def _carry(
    moment: AssemblyState,
) -> tuple[tuple[Mount, ...], tuple[Frame, ...], tuple[Section, ...]]:
    """The pass from the ground outwards: poses and twists; and the ends of closures."""
    assembly, mounts, frames = moment.assembly, [], []
    rows = list(zip(parents(assembly), moment.operators.rows, strict=True))
    held = zip(closure_ends(assembly), moment.operators.ends, strict=True)
    places, carriers = slices(assembly), sections(moment, [*rows, *held])
    for index, on in enumerate(parents(assembly)):
        mount, position = _mount(moment, index, on, carriers[index])
        v = moment.v[places[index].joint_v]
        twist, rotation = mount.axes @ v, mount.turn
        if on is not None:
            carrier = frames[on]
            own = jnp.concatenate([carrier.twist, moment.v[places[on].rod_v]])
            twist = twist + mount.carried @ own
            rotation, moved = moving.turned_pose(carrier.rotation, rotation, position)
            position = carrier.position + moved
        mounts.append(mount)
        frames.append(Frame(rotation, position, twist))
    return tuple(mounts), tuple(frames), tuple(carriers[len(rows) :])


def _mount(
    moment: AssemblyState, index: int, on: int | None, carrier: Section
) -> tuple[Mount, Array]:
    """The mount of a part, and its position in the frame of the carrier."""
    assembly, dtype = moment.assembly, moment.q.dtype
    part, group = assembly.parts[index], assembly.group
    dim, rot = group.space_dim, group.rotation_dim
    rotation, centre, angular, linear = carrier
    arm = None
    if part.offset is not None:
        offset = part.offset.astype(dtype)
        rotation, arm = moving.turned_pose(rotation, offset[:dim, :dim], offset[:dim, dim])
    turn = rotation
    if part.joint.num_dof(group) > 0:
        turned_by, shift = part.joint.pose(group, moment.q[slices(assembly)[index].joint_q])
        turn, shift = moving.turned_pose(rotation, turned_by, shift)
        arm = shift if arm is None else arm + shift
    along = moving.turned_twists(rotation, part.joint.axes(group, dtype), rot)
    axes = moving.turned_twists(turn.T, along, rot)
    if on is None:
        angular, linear = angular[:, :0], linear[:, :0]
    if arm is not None:
        centre, linear = centre + arm, linear + moving.swept(angular[None], arm[None])[0]
    carried = moving.turned_twists(turn.T, jnp.concatenate([angular, linear]), rot)
    return Mount(carried, axes, turn, along, arm, angular), centre


# Rows of equal structure worked on together: a program holds the work once


def each(
    function: Callable[..., Any], rows: Sequence[tuple[Any, ...]], at_once: bool = False
) -> list[Any]:
    """`[function(*row) for row in rows]`; rows that differ in numbers alone share a loop, or
    are worked on `at_once`."""
    groups: dict[Any, list[int]] = {}
    parted = [eqx.partition(row, eqx.is_array) for row in rows]
    for place, (arrays, rest) in enumerate(parted):
        leaves, form = jax.tree.flatten(arrays)
        others, rest_form = jax.tree.flatten(rest)
        kinds = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        groups.setdefault((form, kinds, rest_form, tuple(others)), []).append(place)
    found: list[Any] = [None] * len(rows)
    for places in groups.values():
        if len(places) == 1:
            found[places[0]] = function(*rows[places[0]])
            continue
        rest = parted[places[0]][1]
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *(parted[k][0] for k in places))
        one = lambda row, rest=rest: function(*eqx.combine(row, rest))  # noqa: E731
        answers = jax.vmap(one)(stacked) if at_once else jax.lax.map(one, stacked)
        for nth, place in enumerate(places):
            found[place] = jax.tree.map(lambda leaf, nth=nth: leaf[nth], answers)
    return found


def part_columns(moment: AssemblyState) -> tuple[Float[Array, "own dof"], ...]:
    """Twist and coordinates of each part per rate of the assembly."""
    dof = moment.v.shape[0]
    still = jnp.zeros((moment.assembly.group.algebra_dim, dof), moment.v.dtype)
    columns = columns_of(moment, np.arange(dof))
    return tuple(still if own is None else own for own in columns)


def columns_of(
    moment: AssemblyState, rates: Int[np.ndarray, " some"]
) -> list[Float[Array, "own some"] | None]:
    """The same per rate in `rates` alone; None of what these do not move."""
    assembly, found = moment.assembly, []
    chosen, dtype = np.eye(moment.v.shape[0])[:, rates], moment.v.dtype
    for on, at, mount in zip(parents(assembly), slices(assembly), moment.mounts, strict=True):
        joint, rod = chosen[at.joint_v], chosen[at.rod_v]
        twist = mount.axes @ jnp.asarray(joint, dtype) if joint.any() else None
        if on is not None and found[on] is not None:
            carried = mount.carried @ found[on]
            twist = carried if twist is None else twist + carried
        if twist is None and not rod.any():
            found.append(None)
            continue
        if twist is None:
            twist = jnp.zeros((mount.axes.shape[0], len(rates)), dtype)
        found.append(jnp.concatenate([twist, jnp.asarray(rod, dtype)]))
    return found


# Inertia and loads of an assembly, from those of its parts


def assembly_inertia(
    moment: AssemblyState,
) -> tuple[Float[Array, "dof dof"], Float[Array, " dof"]]:
    """Mass matrix and Coriolis force; cost of order dof^2 beyond that of the parts."""
    carriers, size = parents(moment.assembly), moment.assembly.group.algebra_dim
    masses, biases = part_inertias(moment)
    rows: list[Array] = []
    for index in reversed(range(len(carriers))):
        on, mount = carriers[index], moment.mounts[index]
        joint = mount.axes.T @ masses[index][:size]
        rows.append(jnp.concatenate([joint, masses[index][size:]]))
        if on is not None:
            whole = masses[index][:size, :size]
            masses[on] = masses[on] + mount.carried.T @ whole @ mount.carried
    columns = part_columns(moment)
    lower = jnp.concatenate(
        [row @ column for row, column in zip(reversed(rows), columns, strict=True)]
    )
    # Parts come after what carries them, so the rows hold the lower triangle.
    lower = jnp.tril(lower)
    mass = lower + lower.T - jnp.diag(jnp.diagonal(lower))
    return _with_rotors(mass, moment.assembly), gather(moment, biases)


def _with_rotors(mass: Float[Array, "dof dof"], assembly: Assembly) -> Float[Array, "dof dof"]:
    for part, at in zip(assembly.parts, slices(assembly), strict=True):
        rotor = part.joint.rotor_inertia()
        if rotor is not None:
            every = jnp.broadcast_to(rotor, at.joint_v.stop - at.joint_v.start)
            mass = mass.at[at.joint_v, at.joint_v].add(jnp.diag(every.astype(mass.dtype)))
    return mass


def gather(
    moment: AssemblyState, loads: Sequence[Float[Array, "*rows own"] | None]
) -> Float[Array, "*rows dof"]:
    """Generalised force of loads on the parts, each in the columns of its part: the pass
    inwards; of several cases of loads at once where they are rows. None is no load."""
    carriers, size = parents(moment.assembly), moment.assembly.group.algebra_dim
    rows = next((load.shape[:-1] for load in loads if load is not None), ())
    total: list = list(loads)
    pieces = []
    for index in reversed(range(len(carriers))):
        on, mount, load = carriers[index], moment.mounts[index], total[index]
        if load is None:
            at = slices(moment.assembly)[index]
            count = at.rod_v.stop - at.joint_v.start
            pieces.append(jnp.zeros((*rows, count), moment.v.dtype))
            continue
        twist, own = load[..., :size], load[..., size:]
        pieces.append(jnp.concatenate([twist @ mount.axes, own], axis=-1))
        if on is not None:
            passed = twist @ mount.carried
            total[on] = passed if total[on] is None else total[on] + passed
    return jnp.concatenate(pieces[::-1], axis=-1)


def part_inertias(moment: AssemblyState) -> tuple[list[Array], list[Array]]:
    """Mass matrix and Coriolis force of each part in its own columns and frame."""
    own = in_own_frames(
        moment, lambda m: rod_inertia(m) if isinstance(m, RodState) else link_inertia(m)
    )
    masses, biases = ([pair[k] for pair in own] for k in range(2))
    size = moment.assembly.group.algebra_dim
    for k, frame in enumerate(bias_accelerations(moment)):
        if frame is not None:
            biases[k] = biases[k] + masses[k][:, :size] @ frame
    return masses, biases


def bias_accelerations(moment: AssemblyState) -> tuple[Float[Array, " twist"] | None, ...]:
    """Acceleration of each frame at zero coordinate acceleration, along its own axes; None
    on the ground, where there is none."""
    assembly, found = moment.assembly, []
    carriers = parents(assembly)
    # Of all equal rods, not of the carriers: inertia needs the same, and XLA makes it once.
    rates = in_own_frames(moment, bias_rates, among={on for on in carriers if on is not None})
    for index, on in enumerate(carriers):
        if on is None:
            found.append(None)
            continue
        size, before = assembly.group.algebra_dim, found[on]
        own = _section_bias(moment, index, on, rates[on])
        if before is not None:
            own = own + moment.mounts[index].carried[:, :size] @ before
        found.append(own)
    return tuple(found)


def _section_bias(
    moment: AssemblyState, index: int, on: int, rates: tuple[Array, Array] | None
) -> Float[Array, " twist"]:
    """Acceleration of a part on a carrier whose frame and coordinates do not accelerate: that
    of the section that carries it, at the end of its arm; what is absent costs nothing."""
    mount, at = moment.mounts[index], slices(moment.assembly)
    rot, arm, v = moment.assembly.group.rotation_dim, mount.arm, moment.v[at[index].joint_v]
    spin = mount.spin @ jnp.concatenate([moment.frames[on].twist, moment.v[at[on].rod_v]])
    rows, angular = moment.operators.rows[index], jnp.zeros_like(spin)
    linear = jnp.zeros(mount.turn.shape[0], spin.dtype)
    swept = None if arm is None else _cross(spin, arm)
    if rows is not None and rates is not None:
        angular, linear = rows[0] @ rates[0], rows[0] @ rates[1]
        linear = linear if arm is None else linear + _cross(angular, arm)
    if v.shape[0] > 0:
        joint = mount.joint_axes @ v
        swept = 2 * joint[rot:] if swept is None else swept + 2 * joint[rot:]
        angular = angular + _cross(spin, joint[:rot]) if rot == 3 else angular
    linear = linear if swept is None else linear + _cross(spin, swept)
    both = jnp.concatenate([angular, linear])[:, None]
    return turned_twists(mount.turn.T, both, rot)[:, 0]


def _cross(spin: Float[Array, " rot"], arm: Float[Array, " dim"]) -> Float[Array, " dim"]:
    return spin_cross(spin[None], arm[None])[0]
