"""A rod on a moving base: its fields with the columns of the base, in any frame."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.math.lie import cross_columns
from sorojax.rod.dynamics.fields import Base, RodState


def release(moment: RodState, twist: Float[Array, " base"]) -> RodState:
    """The clamped rod of `moment` on a base that moves with `twist`, in axes of the base.

    The columns of the twist come first. Its equations of motion hold for a base without
    acceleration; that of the base adds `mass_matrix[:, base] @ acceleration`.
    """
    quad, dim = moment.tangent.shape
    rot, dtype = moment.angular_rate.shape[1], moment.q.dtype
    eye, still = jnp.asarray(np.eye(dim), dtype), jnp.zeros((quad, dim, dim), dtype)
    spin = jnp.asarray(np.eye(rot, rot + dim), dtype)
    spins = jnp.broadcast_to(spin, (quad, *spin.shape))
    shifts = jnp.broadcast_to(eye, still.shape)
    arms, slopes = levers(moment.position), levers(moment.tangent)
    columns = np.eye(rot + dim, rot + dim + moment.q.shape[0])
    angular, linear = (jnp.asarray(x, dtype) for x in (columns[:rot], columns[rot:]))
    return dataclasses.replace(
        moment,
        q=jnp.concatenate([jnp.zeros_like(twist), moment.q]),
        v=jnp.concatenate([twist, moment.v]),
        angular_rate=jnp.pad(moment.angular_rate, ((0, 0), (0, 0), (rot + dim, 0))),
        linear_rate=jnp.concatenate([slopes, still, moment.linear_rate], axis=2),
        angular_jacobian=jnp.concatenate([spins, moment.angular_jacobian], axis=2),
        linear_jacobian=jnp.concatenate([arms, shifts, moment.linear_jacobian], axis=2),
        base=Base(eye, jnp.zeros(dim, dtype), angular, linear),
    )


def place(
    moment: RodState, rotation: Float[Array, "dim dim"], position: Float[Array, " dim"]
) -> RodState:
    """A released motion in a frame in which the base stands at (rotation, position)."""
    assert moment.base is not None
    fields = ("directors", "angular_rate", "linear_rate", "angular_jacobian", "linear_jacobian")
    return dataclasses.replace(
        moment,
        tangent=turned(rotation, moment.tangent[:, :, None])[:, :, 0],
        base=placed(moment.base, rotation, position),
        **{name: turned(rotation, getattr(moment, name)) for name in fields},
    )


def placed(base: Base, rotation: Array, position: Array) -> Base:
    """A base in own axes in a frame in which it stands at (rotation, position)."""
    angular = turned(rotation, base.angular_jacobian[None])[0]
    return Base(rotation, position, angular, turned(rotation, base.linear_jacobian[None])[0])


def turned(
    rotation: Float[Array, "dim dim"], fields: Float[Array, "points rows n"]
) -> Float[Array, "points rows n"]:
    """`rotation` times each field; the spin of a plane does not turn."""
    if fields.shape[1] == 1:
        return fields
    # written out: tiny batched products are slow
    columns, rows = jnp.unstack(rotation[None, :, None], axis=3), jnp.unstack(fields, axis=1)
    terms = [column * row[:, None] for column, row in zip(columns, rows, strict=True)]
    return sum(terms[1:], start=terms[0])


def turned_pose(rotation: Array, turn: Array, shift: Array) -> tuple[Array, Array]:
    """`rotation` times both, by one product."""
    both = rotation @ jnp.concatenate([turn, shift[:, None]], axis=1)
    return both[:, :-1], both[:, -1]


def turned_twists(rotation: Array, twists: Float[Array, "twist n"], rot: int) -> Array:
    """Twists along turned axes; the spin of a plane does not turn."""
    count = twists.shape[1]
    if count == 0:
        return twists
    if rot == 1:
        return jnp.concatenate([twists[:rot], rotation @ twists[rot:]])
    return turned(rotation, twists.reshape(2, rot, count)).reshape(-1, count)


def levers(arm: Float[Array, "points dim"]) -> Float[Array, "points dim rot"]:
    """Matrices of spin -> spin x arm."""
    if arm.shape[1] == 2:
        return quarter_turned(arm)[:, :, None]
    x, y, z = jnp.unstack(arm, axis=1)
    o = jnp.zeros_like(x)
    return jnp.stack([o, z, -y, -z, o, x, y, -x, o], axis=1).reshape(-1, 3, 3)


def quarter_turned(vectors: Float[Array, "points 2"]) -> Float[Array, "points 2"]:
    """z x each vector."""
    return jnp.stack([-vectors[:, 1], vectors[:, 0]], axis=1)


def swept(
    spins: Float[Array, "#points rot n"], arms: Float[Array, "points dim"]
) -> Float[Array, "points dim n"]:
    """spin x arm for every column of spins, in the plane too."""
    if arms.shape[1] == 2:
        return quarter_turned(arms)[:, :, None] * spins
    return cross_columns(spins, arms[:, :, None])


def spin_cross(
    spin: Float[Array, "#points rot"], arm: Float[Array, "points dim"]
) -> Float[Array, "points dim"]:
    """spin x arm, in the plane too."""
    return swept(spin[:, :, None], arm)[:, :, 0]


# Where the mass of the sections is, beside the axis of the rod


def mass_arms(moment: Any) -> Float[Array, "quad dim"] | None:
    """From the centre line to the centres of mass [m]; None where they lie on it."""
    offset = moment.operators.mass_offset
    if offset is None:
        return None
    across = moment.directors[:, :, 1:]
    return jnp.sum(across * offset.T[:, None, :], axis=2)


def mass_jacobian(moment: Any) -> Float[Array, "quad dim dof"]:
    """Velocity of the centres of mass per rate."""
    return on_arms(moment, moment.linear_jacobian, mass_arms(moment))


def mass_position(moment: Any) -> Float[Array, "quad dim"]:
    """Centres of mass [m]."""
    arms = mass_arms(moment)
    return moment.position if arms is None else moment.position + arms


def on_arms(
    moment: Any, linear: Float[Array, "quad dim dof"], arms: Float[Array, "quad dim"] | None
) -> Float[Array, "quad dim dof"]:
    """Jacobians of the ends of arms."""
    if arms is None:
        return linear
    return linear + swept(moment.angular_jacobian, arms)


def acceleration_on_arms(
    linear: Float[Array, "quad dim"],
    angular: Float[Array, "quad rot"],
    spin: Float[Array, "quad rot"],
    arms: Float[Array, "quad dim"] | None,
) -> Float[Array, "quad dim"]:
    """Acceleration of the ends of arms: a + alpha x arm + spin x (spin x arm)."""
    if arms is None:
        return linear
    velocity = spin_cross(spin, arms)
    return linear + spin_cross(angular, arms) + spin_cross(spin, velocity)
