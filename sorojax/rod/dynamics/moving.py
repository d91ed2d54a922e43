"""A rod on a moving base: its fields with the columns of the base, in any frame."""

from typing import Any

import equinox as eqx
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
    rot = moment.angular_rate.shape[1]
    eye, dtype = jnp.asarray(np.eye(dim), moment.q.dtype), moment.q.dtype
    spin, none = jnp.asarray(np.eye(rot), dtype), jnp.zeros((rot, dim), dtype)
    angular = jnp.concatenate([spin, none], axis=1)
    linear = jnp.concatenate([jnp.zeros((dim, rot), dtype), eye], axis=1)
    own = jnp.zeros((rot + dim, moment.q.shape[0]), dtype)
    still = jnp.zeros((quad, dim, dim), dtype)
    arms, slopes = levers(moment.position), levers(moment.tangent)
    base_linear = jnp.concatenate([arms, jnp.broadcast_to(eye, still.shape)], axis=2)
    base_angular = jnp.broadcast_to(angular, (quad, rot, rot + dim))
    return eqx.tree_at(
        lambda m: (
            m.q,
            m.v,
            m.angular_rate,
            m.linear_rate,
            m.angular_jacobian,
            m.linear_jacobian,
            m.base,
        ),
        moment,
        (
            jnp.concatenate([jnp.zeros_like(twist), moment.q]),
            jnp.concatenate([twist, moment.v]),
            _pad(moment.angular_rate, rot + dim),
            jnp.concatenate([slopes, still, moment.linear_rate], axis=2),
            jnp.concatenate([base_angular, moment.angular_jacobian], axis=2),
            jnp.concatenate([base_linear, moment.linear_jacobian], axis=2),
            Base(
                eye,
                jnp.zeros(dim, dtype),
                jnp.concatenate([angular, own[:rot]], axis=1),
                jnp.concatenate([linear, own[rot:]], axis=1),
            ),
        ),
        is_leaf=lambda leaf: leaf is None,
    )


def place(
    moment: RodState, rotation: Float[Array, "dim dim"], position: Float[Array, " dim"]
) -> RodState:
    """A released motion in a frame in which the base stands at (rotation, position)."""
    base = moment.base
    assert base is not None
    return eqx.tree_at(
        lambda m: (
            m.directors,
            m.tangent,
            m.angular_rate,
            m.linear_rate,
            m.angular_jacobian,
            m.linear_jacobian,
            m.base,
        ),
        moment,
        (
            turned(rotation, moment.directors),
            turned(rotation, moment.tangent[:, :, None])[:, :, 0],
            turned(rotation, moment.angular_rate),
            turned(rotation, moment.linear_rate),
            turned(rotation, moment.angular_jacobian),
            turned(rotation, moment.linear_jacobian),
            Base(
                rotation,
                position,
                turned(rotation, base.angular_jacobian[None])[0],
                turned(rotation, base.linear_jacobian[None])[0],
            ),
        ),
    )


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
        return jnp.stack([-arm[:, 1], arm[:, 0]], axis=1)[:, :, None]
    x, y, z = jnp.unstack(arm, axis=1)
    o = jnp.zeros_like(x)
    return jnp.stack([o, z, -y, -z, o, x, y, -x, o], axis=1).reshape(-1, 3, 3)


def swept_by(arm: Float[Array, " dim"], spins: Float[Array, "rot n"]) -> Float[Array, "dim n"]:
    """Velocities of the end of an arm, of many spins."""
    if arm.shape[0] == 2:
        return levers(arm[None])[0] @ spins
    return cross_columns(spins[None], arm[None, :, None])[0]


def cross(spin: Float[Array, " rot"], arms: Float[Array, "points dim"]) -> Array:
    """spin x each arm, in the plane too."""
    if arms.shape[1] == 2:
        return levers(arms) @ spin
    return cross_columns(spin[None], arms)


def _pad(fields: Array, count: int) -> Array:
    return jnp.pad(fields, ((0, 0), (0, 0), (count, 0)))


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
    return linear + levers(arms) @ moment.angular_jacobian


def acceleration_on_arms(
    linear: Float[Array, "quad dim"],
    angular: Float[Array, "quad rot"],
    spin: Float[Array, "quad rot"],
    arms: Float[Array, "quad dim"] | None,
) -> Float[Array, "quad dim"]:
    """Acceleration of the ends of arms: a + alpha x arm + spin x (spin x arm)."""
    if arms is None:
        return linear
    velocity = (levers(arms) @ spin[:, :, None])[:, :, 0]
    tangential = (levers(arms) @ angular[:, :, None])[:, :, 0]
    return linear + tangential + (levers(velocity) @ spin[:, :, None])[:, :, 0]
