"""What the joints of an assembly carry: forces and moments between its parts in motion."""

from typing import overload

from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.math.compiled import jit_public
from sorojax.rod.dynamics.closures import closure_loads, divided
from sorojax.rod.dynamics.dynamics import Coordinates, Forces, Rates
from sorojax.rod.dynamics.moving import turned_twists
from sorojax.rod.dynamics.tree import (
    AssemblyState,
    assembly_inertia,
    part_columns,
    part_inertias,
)
from sorojax.rod.forces.forces import Gravity
from sorojax.rod.forces.loads import PartForce, part_loads, plain, total_force
from sorojax.rod.model.assembly import Assembly, Part, parents
from sorojax.rod.model.closure import is_closed
from sorojax.rod.model.model import Model, motion
from sorojax.rod.model.rod import Rod

Wrench = Float[Array, " twist"]


@overload
def joint_wrenches(
    model: Rod, q: Array, v: Array, a: Array, forces: Forces = ..., *, t=...
) -> Wrench: ...
@overload
def joint_wrenches(
    model: Assembly, q: Array, v: Array, a: Array, forces: Forces = ..., *, t=...
) -> dict[str, Wrench]: ...
@jit_public
def joint_wrenches(
    model: Model, q: Coordinates, v: Rates, a: Rates, forces: Forces = (), *, t=0.0
) -> Wrench | dict[str, Wrench]:
    """The force and moment that each joint carries onto its part.

    By the equations of Newton and Euler of each part, taken from the tips inwards: what a part
    and all that it carries need to accelerate, less the loads on them, passes through its
    joint. A wrench holds all that the joint transmits: what it constrains, and the effort of
    its spring, damper and actuator. Closures act on the parts that they join; their reactions
    are those that balance `a` best. With a = `forward_dynamics(model, q, v, forces)` it is that
    of the motion; with other accelerations, of a motion that actuators force on the joints.

    Args:
        model: The rod or assembly.
        q: Coordinates; curvature modes in [1/m].
        v: Their rates, per second.
        a: Accelerations of the coordinates, per second squared.
        forces: Generalised forces on the parts, weight and contact; none by default.
            Efforts of joints among them change nothing but `a`.
        t: Time [s].

    Returns:
        Moment [N m] about the origin of the part's frame, then force [N], along the axes of the
        ground (in a plane the moment about z): of every part by name, of a single rod that of
        its clamp.

    Raises:
        ValueError: If the shapes do not fit the model, or a force names no part of it.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> rest = rod.equilibrium(finger, (rod.Gravity(),))
        >>> still = jnp.zeros(3)
        >>> wrench = rod.joint_wrenches(finger, rest.q, still, still, (rod.Gravity(),))
        >>> print(f"the clamp bears {float(wrench[2]):.4f} N")  # the weight of 7.85 g
        the clamp bears 0.0770 N

    Reference:
        Featherstone, Rigid Body Dynamics Algorithms, 2008, section 5.3, for the pass inwards.
    """
    if isinstance(model, Rod):
        listed = plain(forces, model.group)
        named = tuple(f if isinstance(f, Gravity) else PartForce("rod", f) for f in listed)
        alone = Assembly(model.group, ("rod",), (Part(model),))
        return _wrenches(motion(alone, q, v), a, named, real(t))[0]
    found = _wrenches(motion(model, q, v), a, forces, real(t))
    return dict(zip(model.names, found, strict=True))


def _wrenches(moment: AssemblyState, a: Array, forces: Forces, t: Array) -> list[Wrench]:
    """The wrench of each joint on its part, along the axes of the ground."""
    rot, size = moment.assembly.group.rotation_dim, moment.assembly.group.algebra_dim
    masses, biases = part_inertias(moment)
    columns, loads = part_columns(moment), part_loads(forces, t, moment)
    total = [
        mass[:size] @ (column @ a) + bias[:size]
        for mass, column, bias in zip(masses, columns, biases, strict=True)
    ]
    total = [
        needed if load is None else needed - load[:size]
        for needed, load in zip(total, loads, strict=True)
    ]
    if is_closed(moment.assembly):
        borne = closure_loads(moment, t, _reactions(moment, a, forces, t))
        total = [
            needed if load is None else needed - load[:size]
            for needed, load in zip(total, borne, strict=True)
        ]
    for index, on in reversed(list(enumerate(parents(moment.assembly)))):
        if on is not None:
            carried = moment.mounts[index].carried[:, :size]
            total[on] = total[on] + total[index] @ carried
    return [
        turned_twists(frame.rotation, wrench[:, None], rot)[:, 0]
        for frame, wrench in zip(moment.frames, total, strict=True)
    ]


def _reactions(
    moment: AssemblyState, a: Array, forces: Forces, t: Array
) -> Float[Array, " equations"]:
    """Reactions of closures that leave the least to be done by actuators."""
    mass, coriolis = assembly_inertia(moment)
    needed = mass @ a + coriolis - total_force(forces, t, moment)
    return divided(moment, t, mass, needed)[1]
