"""How fast each part of an assembly moves per rate of its coordinates."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax.rod.assembly import parents, slices
from sorojax.rod.tree import AssemblyMotion


def part_columns(moment: AssemblyMotion) -> tuple[Float[Array, "own dof"], ...]:
    """Twist and coordinates of each part per rate of the assembly."""
    dof = moment.v.shape[0]
    still = jnp.zeros((moment.assembly.group.algebra_dim, dof), moment.v.dtype)
    columns = columns_of(moment, np.arange(dof))
    return tuple(still if own is None else own for own in columns)


def columns_of(
    moment: AssemblyMotion, rates: Int[np.ndarray, " some"]
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
