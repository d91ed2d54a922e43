"""Joints between the parts of an assembly: how a frame moves on another."""

import abc
import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.math.lie import (
    SE2,
    SE3,
    exponential,
    multiply,
    plane_rotation,
    quaternion_rate,
    rotation_matrix,
)

Group = SE2 | SE3


class AbstractJoint(eqx.Module):
    """Motion of a frame on its joint frame; the columns of the motion do not turn.

    Coordinates and rates may differ in number: a free joint in space holds a quaternion.
    """

    def num_coordinates(self, group: Group) -> int:
        """Number of coordinates q."""
        return type(self).num_dof(self, group)

    @abc.abstractmethod
    def num_dof(self, group: Group) -> int:
        """Number of rates v."""

    @abc.abstractmethod
    def axes(self, group: Group, dtype) -> Float[Array, "twist dof"]:
        """Twist per rate, in the joint frame, at the origin of the moving frame."""

    @abc.abstractmethod
    def pose(self, group: Group, q: Array) -> tuple[Array, Array]:
        """Rotation and position [m] of the moving frame in the joint frame."""

    def rest(self, group: Group, dtype) -> Float[Array, " coordinates"]:
        """Coordinates at which the frames coincide."""
        return jnp.zeros(self.num_coordinates(group), dtype)

    def retract(self, group: Group, q: Array, increment: Array) -> Array:
        """Coordinates after an increment of the rates' dimension."""
        return q + increment

    def rate(self, group: Group, q: Array, v: Array) -> Array:
        """dq/dt."""
        return v

    def matrices(self, group: Group, dtype) -> tuple[Array, Array]:
        """Stiffness about the rest pose, and damping."""
        none = jnp.zeros((self.num_dof(group),) * 2, dtype)
        return none, none

    def effort(self, q: Array, v: Array) -> Float[Array, " dof"] | None:
        """Force of the joint's own spring and damper."""
        return None

    def rotor_inertia(self) -> Float[Array, " dof"] | None:
        """What a rotor behind a gear adds to the diagonal of the mass matrix, per rate."""
        return None


class Fixed(AbstractJoint):
    """No motion."""

    def num_dof(self, group):
        return 0

    def axes(self, group, dtype):
        return jnp.zeros((group.algebra_dim, 0), dtype)

    def pose(self, group, q):
        return jnp.eye(group.space_dim, dtype=q.dtype), jnp.zeros(group.space_dim, q.dtype)


class AbstractAxial(AbstractJoint):
    """One coordinate, along or about an axis, with a spring towards rest and a damper."""

    axis: Float[Array, " dim"] | None = eqx.field(converter=optional_real, default=None)
    stiffness: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    damping: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    armature: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        axis = self.axis
        if axis is not None and _check.is_concrete(axis) and not float(jnp.sum(axis**2)) > 0:
            raise ValueError(
                f"{type(self).__name__}: `axis` is {axis}, need a direction. Give e.g. "
                "[0, 0, 1]."
            )

    def num_dof(self, group):
        return 1

    def matrices(self, group, dtype):
        return _scalar(self.stiffness, dtype), _scalar(self.damping, dtype)

    def effort(self, q, v):
        pairs = (self.stiffness, q), (self.damping, v)
        terms = [-k * x for k, x in pairs if k is not None]
        return functools.reduce(jnp.add, terms) if terms else None

    def rotor_inertia(self):
        return None if self.armature is None else self.armature[None]


class Revolute(AbstractAxial):
    """Rotation about an axis [rad].

    Attributes:
        axis: Direction in the joint frame, of any length; z if omitted. None in a plane.
        stiffness: Spring towards rest [N m/rad].
        damping: [N m s/rad].
        armature: Inertia of the rotor times the gear ratio squared [kg m^2]; it turns against
            the carrier, and its own momentum is left out.
    """

    def axes(self, group, dtype):
        still = jnp.zeros(group.space_dim, dtype)
        return jnp.concatenate([self._spin(group, dtype), still])[:, None]

    def pose(self, group, q):
        still = jnp.zeros(group.space_dim, q.dtype)
        if group.space_dim == 2:
            return plane_rotation(q[0]), still
        cosine, sine = jnp.cos(q[0] / 2), jnp.sin(q[0] / 2)
        x, y, z = sine * self._spin(group, q.dtype)
        return rotation_matrix((cosine, x, y, z)), still

    def _spin(self, group: Group, dtype) -> Array:
        if group.space_dim == 2:
            return jnp.ones(1, dtype)
        return _unit(jnp.array([0.0, 0.0, 1.0]) if self.axis is None else self.axis, 3, dtype)


class Prismatic(AbstractAxial):
    """Translation along an axis [m].

    Attributes:
        axis: Direction in the joint frame, of any length; x if omitted.
        stiffness: Spring towards rest [N/m].
        damping: [N s/m].
        armature: The same of a drive: rotor inertia by the square of rotation per travel [kg].
    """

    def axes(self, group, dtype):
        still = jnp.zeros(group.rotation_dim, dtype)
        return jnp.concatenate([still, self._along(group, dtype)])[:, None]

    def pose(self, group, q):
        return jnp.eye(group.space_dim, dtype=q.dtype), q[0] * self._along(group, q.dtype)

    def _along(self, group: Group, dtype) -> Array:
        dim = group.space_dim
        axis = jnp.zeros(dim).at[0].set(1.0) if self.axis is None else self.axis
        return _unit(axis, dim, dtype)


class Free(AbstractJoint):
    """Any motion; a floating base.

    Coordinates: a unit quaternion (scalar first), then the position [m]; in a plane the
    angle [rad], then the position. Rates: angular velocity [rad/s], then the velocity of
    the origin [m/s], both along the axes of the joint frame.
    """

    def num_coordinates(self, group):
        return 7 if group.space_dim == 3 else 3

    def num_dof(self, group):
        return group.algebra_dim

    def axes(self, group, dtype):
        return jnp.eye(group.algebra_dim, dtype=dtype)

    def pose(self, group, q):
        if group.space_dim == 2:
            return plane_rotation(q[0]), q[1:]
        return rotation_matrix(_unit_quaternion(q)), q[4:]

    def rest(self, group, dtype):
        rest = jnp.zeros(self.num_coordinates(group), dtype)
        return rest if group.space_dim == 2 else rest.at[0].set(1)

    def retract(self, group, q, increment):
        if group.space_dim == 2:
            return q + increment
        x, y, z = increment[:3]
        turned = multiply(exponential((x, y, z)), _unit_quaternion(q))
        return jnp.concatenate([jnp.stack(turned), q[4:] + increment[3:]])

    def rate(self, group, q, v):
        if group.space_dim == 2:
            return v
        return jnp.concatenate([quaternion_rate(v, q), v[3:]])


def _unit_quaternion(q: Array):
    # Between retractions the norm is 1 up to the error of an integrator.
    scale = 1 / jnp.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    return scale * q[0], scale * q[1], scale * q[2], scale * q[3]


def _unit(axis: Array, dim: int, dtype) -> Float[Array, " dim"]:
    _check.shape("joint", "axis", axis, (dim,), f"The assembly has {dim} dimensions.")
    axis = axis.astype(dtype)
    return axis / jnp.sqrt(jnp.sum(axis**2))


def _scalar(value: Array | None, dtype) -> Float[Array, "1 1"]:
    value = real(0.0) if value is None else value
    return value.astype(dtype).reshape(1, 1)


# The screw: one coordinate turns and advances


class Screw(AbstractJoint):
    """About z of the joint frame by `turn` and along it by `advance`, per coordinate; in space.

    A bolt has `turn=1` and as `advance` its pitch over 2 pi. Slide (`turn=0`) and hinge
    (`advance=0`) are screws too, so that one compiled program moves all three.

    Attributes:
        turn: [rad].
        advance: [m].
        damping: Effort per rate of the coordinate, for `turn=1` [N m s/rad].
    """

    turn: Float[Array, ""] = eqx.field(converter=real)
    advance: Float[Array, ""] = eqx.field(converter=real)
    damping: Float[Array, ""] = eqx.field(converter=real, default=0.0)

    def __check_init__(self):
        known = _check.is_concrete(self.turn) and _check.is_concrete(self.advance)
        if known and float(self.turn) == 0 and float(self.advance) == 0:
            raise ValueError(
                "Screw: `turn` and `advance` are 0, need one that moves. A part that does not "
                "move has the joint Fixed()."
            )

    def num_dof(self, group):
        return 1

    def axes(self, group, dtype):
        return jnp.zeros((6, 1), dtype).at[2].set(self.turn).at[5].set(self.advance)

    def pose(self, group, q):
        turned = jnp.eye(3, dtype=q.dtype).at[:2, :2].set(plane_rotation(self.turn * q[0]))
        return turned, jnp.zeros(3, q.dtype).at[2].set(self.advance * q[0])

    def matrices(self, group, dtype):
        return jnp.zeros((1, 1), dtype), self.damping.astype(dtype)[None, None]

    def effort(self, q, v):
        return -self.damping * v
