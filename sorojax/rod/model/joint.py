"""Joints between the parts of an assembly: how a frame moves on another."""

import abc
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
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

    def violation(
        self, group: Group, rotation: Float[Array, "dim dim"], position: Float[Array, " dim"]
    ) -> Float[Array, " held"]:
        """How far the moving frame is from where the joint can put it [rad], [m]: one number
        for each motion that the joint holds. What a `Closure` keeps at zero."""
        raise ValueError(
            f"Closure: {type(self).__name__} cannot close a loop, need Fixed, Revolute, "
            "Prismatic, Spherical or Roller. Put it between two parts of the tree instead."
        )

    def slopes(
        self, group: Group, rotation: Float[Array, "dim dim"], position: Float[Array, " dim"]
    ) -> Float[Array, "held twist"]:
        """Change of the violation per small twist of the moving frame: rotation and
        displacement of its origin, along the axes of the joint frame."""
        rot = group.rotation_dim

        def after(twist):
            turn = group.exp(twist)[:-1, :-1]
            return self.violation(group, turn @ rotation, position + twist[rot:])

        return jax.jacfwd(after)(jnp.zeros(group.algebra_dim, position.dtype))

    def rotor_inertia(self) -> Float[Array, " rotors"] | None:
        """What a rotor behind a gear adds to the diagonal of the mass matrix, per rate; one
        number for all of them, or one for each."""
        return None


class Fixed(AbstractJoint):
    """No motion."""

    def num_dof(self, group):
        return 0

    def axes(self, group, dtype):
        return jnp.zeros((group.algebra_dim, 0), dtype)

    def pose(self, group, q):
        return jnp.eye(group.space_dim, dtype=q.dtype), jnp.zeros(group.space_dim, q.dtype)

    def violation(self, group, rotation, position):
        return jnp.concatenate([_turn(rotation), position])

    def slopes(self, group, rotation, position):
        return _blocks(_turn_slopes(rotation), jnp.eye(group.space_dim, dtype=position.dtype))


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

    def violation(self, group, rotation, position):
        if group.space_dim == 2:
            return position
        axis = self._spin(group, position.dtype)
        turned = rotation @ axis
        # twice the sine of half the angle between both axes, which vanishes at zero alone
        half = jnp.sqrt(jnp.maximum(1 + axis @ turned, _HALF_TURN) / 2)
        return jnp.concatenate([_across(axis) @ turned / half, position])

    def slopes(self, group, rotation, position):
        shift = jnp.eye(group.space_dim, dtype=position.dtype)
        if group.space_dim == 2:
            return _shifted(shift, 1)
        axis = self._spin(group, position.dtype)
        across, turned = _across(axis), rotation @ axis
        half = jnp.sqrt(jnp.maximum(1 + axis @ turned, _HALF_TURN) / 2)
        tilted = jnp.cross(turned[None], jnp.concatenate([across, axis[None]]))
        less = tilted[2] / (4 * half**2)
        tilt = (tilted[:2] - (across @ turned)[:, None] * less[None]) / half
        return _blocks(tilt, shift)

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

    def violation(self, group, rotation, position):
        across = _across(self._along(group, position.dtype))
        return jnp.concatenate([_turn(rotation), across @ position])

    def slopes(self, group, rotation, position):
        return _blocks(_turn_slopes(rotation), _across(self._along(group, position.dtype)))

    def _along(self, group: Group, dtype) -> Array:
        return _along(self.axis, group, dtype)


class Spherical(AbstractJoint):
    """Any rotation about a point: a ball joint, in the plane a pin.

    Coordinates: a unit quaternion (scalar first), in a plane the angle [rad]. Rates: angular
    velocity along the axes of the joint frame [rad/s].

    Attributes:
        damping: The same about every axis [N m s/rad].
        armature: Inertia of a rotor about every axis, as that of `Revolute` [kg m^2].
    """

    damping: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)
    armature: Float[Array, ""] | None = eqx.field(converter=optional_real, default=None)

    def num_coordinates(self, group):
        return 4 if group.space_dim == 3 else 1

    def num_dof(self, group):
        return group.rotation_dim

    def axes(self, group, dtype):
        return jnp.eye(group.algebra_dim, group.rotation_dim, dtype=dtype)

    def pose(self, group, q):
        still = jnp.zeros(group.space_dim, q.dtype)
        if group.space_dim == 2:
            return plane_rotation(q[0]), still
        return rotation_matrix(_unit_quaternion(q)), still

    def rest(self, group, dtype):
        rest = jnp.zeros(self.num_coordinates(group), dtype)
        return rest if group.space_dim == 2 else rest.at[0].set(1)

    def retract(self, group, q, increment):
        return q + increment if group.space_dim == 2 else _turned(q, increment)

    def rate(self, group, q, v):
        return v if group.space_dim == 2 else quaternion_rate(v, q)

    def matrices(self, group, dtype):
        eye = jnp.eye(group.rotation_dim, dtype=dtype)
        return 0 * eye, _scalar(self.damping, dtype) * eye

    def effort(self, q, v):
        return None if self.damping is None else -self.damping * v

    def violation(self, group, rotation, position):
        return position

    def slopes(self, group, rotation, position):
        eye = jnp.eye(group.space_dim, dtype=position.dtype)
        return _shifted(eye, group.rotation_dim)

    def rotor_inertia(self):
        return None if self.armature is None else self.armature[None]


class Roller(AbstractJoint):
    """A pin that slides along an axis, in space a ball joint that does: a roller support.

    Coordinates and rates are those of `Spherical`, then the place on the axis [m], [m/s].

    Attributes:
        axis: Direction in the joint frame, of any length; x if omitted.
    """

    axis: Float[Array, " dim"] | None = eqx.field(converter=optional_real, default=None)

    def num_coordinates(self, group):
        return 1 + Spherical().num_coordinates(group)

    def num_dof(self, group):
        return 1 + group.rotation_dim

    def axes(self, group, dtype):
        still = jnp.zeros(group.rotation_dim, dtype)
        slide = jnp.concatenate([still, self._along(group, dtype)])
        return jnp.concatenate([Spherical().axes(group, dtype), slide[:, None]], axis=1)

    def pose(self, group, q):
        rotation, _ = Spherical().pose(group, q[:-1])
        return rotation, q[-1] * self._along(group, q.dtype)

    def rest(self, group, dtype):
        return jnp.append(Spherical().rest(group, dtype), jnp.zeros((), dtype))

    def retract(self, group, q, increment):
        turned = Spherical().retract(group, q[:-1], increment[:-1])
        return jnp.append(turned, q[-1] + increment[-1])

    def rate(self, group, q, v):
        return jnp.append(Spherical().rate(group, q[:-1], v[:-1]), v[-1])

    def violation(self, group, rotation, position):
        return _across(self._along(group, position.dtype)) @ position

    def slopes(self, group, rotation, position):
        across = _across(self._along(group, position.dtype))
        return _shifted(across, group.rotation_dim)

    def _along(self, group: Group, dtype) -> Array:
        return _along(self.axis, group, dtype)


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
        return jnp.concatenate([_turned(q[:4], increment[:3]), q[4:] + increment[3:]])

    def rate(self, group, q, v):
        if group.space_dim == 2:
            return v
        return jnp.concatenate([quaternion_rate(v, q), v[3:]])


def _unit_quaternion(q: Array):
    # Between retractions the norm is 1 up to the error of an integrator.
    scale = 1 / jnp.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    return scale * q[0], scale * q[1], scale * q[2], scale * q[3]


def _turned(q: Float[Array, "4"], angle: Float[Array, "3"]) -> Float[Array, "4"]:
    """A quaternion after a rotation vector along the axes of the joint frame."""
    x, y, z = angle
    return jnp.stack(multiply(exponential((x, y, z)), _unit_quaternion(q)))


_HALF_TURN = 1e-12  # cosine beyond -1 from where the measures of a turn are held


def _turn(rotation: Float[Array, "dim dim"]) -> Float[Array, " rot"]:
    """A rotation as a vector of length 2 sin(angle / 2), which is zero at no other than none;
    in a plane the angle."""
    if rotation.shape[0] == 2:
        return jnp.arctan2(rotation[1, 0], rotation[0, 0])[None]
    twice = rotation - rotation.T
    sine = jnp.stack([twice[2, 1], twice[0, 2], twice[1, 0]])
    return sine / jnp.sqrt(jnp.maximum(1 + jnp.trace(rotation), _HALF_TURN))


def _turn_slopes(rotation: Float[Array, "dim dim"]) -> Float[Array, "rot rot"]:
    """Change of `_turn` per small rotation after it."""
    if rotation.shape[0] == 2:
        return jnp.ones((1, 1), rotation.dtype)
    twice, trace = rotation - rotation.T, jnp.trace(rotation)
    sine = jnp.stack([twice[2, 1], twice[0, 2], twice[1, 0]])
    square = jnp.maximum(1 + trace, _HALF_TURN)
    eye = jnp.asarray(np.eye(3), rotation.dtype)
    bent = sine[:, None] * sine[None] / (2 * square)
    return (trace * eye - rotation + bent) / jnp.sqrt(square)


def _blocks(turn: Float[Array, "turns rot"], shift: Float[Array, "shifts dim"]) -> Array:
    """Slopes of measures of turns, then of measures of shifts."""
    beside = jnp.pad(turn, ((0, 0), (0, shift.shape[1])))
    return jnp.concatenate([beside, _shifted(shift, turn.shape[1])])


def _shifted(shift: Float[Array, "shifts dim"], rot: int) -> Float[Array, "shifts twist"]:
    """Slopes of measures of shifts alone."""
    return jnp.pad(shift, ((0, 0), (rot, 0)))


def _across(axis: Float[Array, " dim"]) -> Float[Array, "others dim"]:
    """Unit vectors across a unit vector, as rows.

    Reference:
        Duff et al., "Building an orthonormal basis, revisited", J. Computer Graphics
        Techniques 6, 2017.
    """
    if axis.shape[0] == 2:
        return jnp.stack([-axis[1], axis[0]])[None]
    x, y, z = axis
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(axis.dtype)
    share = -1 / (sign + z)
    mixed = x * y * share
    first = jnp.stack([1 + sign * x**2 * share, sign * mixed, -sign * x])
    return jnp.stack([first, jnp.stack([mixed, sign + y**2 * share, -y])])


def _along(axis: Array | None, group: Group, dtype) -> Float[Array, " dim"]:
    """A direction of unit length; x if omitted."""
    axis = jnp.zeros(group.space_dim).at[0].set(1.0) if axis is None else axis
    return _unit(axis, group.space_dim, dtype)


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
