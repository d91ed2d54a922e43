"""Composite inertia and loads of an assembly from those of its parts, and the Jacobian of each
part in the coordinates of the assembly.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax.rod.dynamics.moving import cross, release, turned_twists
from sorojax.rod.dynamics.tree import AssemblyState, Mount, batches, bias_rates, rod_inertia
from sorojax.rod.model.assembly import parents, slices
from sorojax.rod.model.link import Link, LinkOperators, link_inertia, link_motion


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
    return mass, gather(moment, biases)


def gather(
    moment: AssemblyState, loads: Sequence[Float[Array, " own"] | None]
) -> Float[Array, " dof"]:
    """Generalised force of loads on the parts, each in the columns of its part: the pass
    inwards. None is no load."""
    carriers, size = parents(moment.assembly), moment.assembly.group.algebra_dim
    total: list = list(loads)
    pieces = []
    for index in reversed(range(len(carriers))):
        on, mount, load = carriers[index], moment.mounts[index], total[index]
        if load is None:
            at = slices(moment.assembly)[index]
            pieces.append(jnp.zeros(at.rod_v.stop - at.joint_v.start, moment.v.dtype))
            continue
        pieces.append(jnp.concatenate([load[:size] @ mount.axes, load[size:]]))
        if on is not None:
            passed = load[:size] @ mount.carried
            total[on] = passed if total[on] is None else total[on] + passed
    return jnp.concatenate(pieces[::-1])


def part_inertias(moment: AssemblyState) -> tuple[list[Array], list[Array]]:
    """Mass matrix and Coriolis force of each part in its own columns and frame."""
    assembly, size = moment.assembly, moment.assembly.group.algebra_dim
    masses: list = [None] * len(assembly.parts)
    biases: list = [None] * len(assembly.parts)
    for members, stack in zip(batches(assembly), moment.batches, strict=True):
        twists = jnp.stack([moment.frames[k].twist for k in members])
        every = eqx.filter_vmap(lambda m, twist: rod_inertia(release(m, twist)))
        mass, bias = every(stack, twists)
        for place, k in enumerate(members):
            masses[k], biases[k] = mass[place], bias[place]
    for k, part in enumerate(assembly.parts):
        constants = moment.operators.parts[k]
        if isinstance(constants, LinkOperators):
            assert isinstance(part.body, Link)
            one = link_motion(part.body, constants, moment.frames[k].twist)
            masses[k], biases[k] = link_inertia(one)
    for k, frame in enumerate(bias_accelerations(moment)):
        if frame is not None:
            biases[k] = biases[k] + masses[k][:, :size] @ frame
    return masses, biases


def bias_accelerations(moment: AssemblyState) -> tuple[Float[Array, " twist"] | None, ...]:
    """Acceleration of each frame at zero coordinate acceleration, along its own axes; None
    on the ground, where there is none."""
    assembly, found = moment.assembly, []
    rates = _rates_of_carriers(moment)
    for index, on in enumerate(parents(assembly)):
        mount = moment.mounts[index]
        if on is None:
            found.append(None)
            continue
        size, before = assembly.group.algebra_dim, found[on]
        own = _section_bias(moment, index, on, rates.get(on))
        if before is not None:
            own = own + mount.carried[:, :size] @ before
        found.append(own)
    return tuple(found)


def _rates_of_carriers(moment: AssemblyState) -> dict[int, tuple[Array, Array]]:
    """`bias_rates` of the rods that carry parts, equal rods together."""
    carriers, found = set(parents(moment.assembly)), {}
    for members, stack in zip(batches(moment.assembly), moment.batches, strict=True):
        if carriers.isdisjoint(members):
            continue
        # Of all, not of the carriers: inertia needs the same, and XLA makes it once.
        twists = jnp.stack([moment.frames[k].twist for k in members])
        every = eqx.filter_vmap(lambda m, twist: bias_rates(release(m, twist)))
        angular, linear = every(stack, twists)
        found |= {k: (angular[place], linear[place]) for place, k in enumerate(members)}
    return found


def _section_bias(
    moment: AssemblyState, index: int, on: int, rates: tuple[Array, Array] | None
) -> Float[Array, " twist"]:
    """Acceleration of a part on a carrier whose frame and coordinates do not accelerate."""
    mount, at = moment.mounts[index], slices(moment.assembly)
    rot = moment.assembly.group.rotation_dim
    own = jnp.concatenate([moment.frames[on].twist, moment.v[at[on].rod_v]])
    spin = mount.spin @ own
    rows, section = moment.operators.rows[index], None
    if rows is not None and rates is not None:
        section = rows[0] @ rates[0], rows[0] @ rates[1]
    return _on_arm(mount, moment.v[at[index].joint_v], spin, section, rot)


def _on_arm(
    mount: Mount, v: Array, spin: Array, section: tuple[Array, Array] | None, rot: int
) -> Float[Array, " twist"]:
    """Acceleration at the end of the arm, from that of the section that carries it; what is
    absent costs nothing."""
    arm, angular = mount.arm, jnp.zeros_like(spin)
    linear = jnp.zeros(mount.turn.shape[0], spin.dtype)
    swept = None if arm is None else _cross(spin, arm)
    if section is not None:
        angular, linear = section
        linear = linear if arm is None else linear + _cross(angular, arm)
    if v.shape[0] > 0:
        joint = mount.joint_axes @ v
        swept = 2 * joint[rot:] if swept is None else swept + 2 * joint[rot:]
        angular = angular + _cross(spin, joint[:rot]) if rot == 3 else angular
    linear = linear if swept is None else linear + _cross(spin, swept)
    both = jnp.concatenate([angular, linear])[:, None]
    return turned_twists(mount.turn.T, both, rot)[:, 0]


def _cross(spin: Float[Array, " rot"], arm: Float[Array, " dim"]) -> Float[Array, " dim"]:
    return cross(spin, arm[None])[0]
