"""Targets of inverse kinematics (positions, poses, directions, surfaces) and obstacles."""

import abc
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.math.lie import SE2, SE3, logarithm_and_change
from sorojax.math.linalg.dense import product
from sorojax.rod.dynamics.moving import swept
from sorojax.sdf.base import AbstractSdf

Errors = tuple[Float[Array, " rows"], Float[Array, "rows dof"]]


class Frames(NamedTuple):
    """Sections of a rod, or a link, with Jacobians in all rates of the model."""

    directors: Float[Array, "points dim dim"]
    position: Float[Array, "points dim"]
    angular_jacobian: Float[Array, "points rot dof"]
    linear_jacobian: Float[Array, "points dim dof"]


class AbstractTarget(eqx.Module):
    """A task for the sections at `s` in [0, 1] of a rod, or of the named part."""

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        s: ClassVar[Float[Array, " points"]]
        part: ClassVar[str | None]

    @abc.abstractmethod
    def errors(self, group: SE2 | SE3, frames: Frames) -> Errors:
        """Error to the target [m], and its derivative by each rate, with the sign changed."""


class Position(AbstractTarget):
    """Centres of sections; many points ask for a whole shape.

    Attributes:
        position: Where they shall be [m].
        s: Which sections, in [0, 1]; the tip if omitted.
        part: The part of an assembly.
        weight: How much this counts against other targets [-].
    """

    position: Float[Array, "points dim"] = eqx.field(converter=lambda x: _rows(x, 1))
    s: Float[Array, " points"] = eqx.field(converter=lambda x: _rows(x, 0), default=1.0)
    part: str | None = eqx.field(static=True, default=None)
    weight: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    def __check_init__(self):
        _check_points("Position", "position", self.position, self.s)

    def errors(self, group, frames):
        missing = self.weight * (self.position - frames.position)
        return missing.reshape(-1), self.weight * _flat(frames.linear_jacobian)


class Pose(AbstractTarget):
    """Poses of sections; the error is the twist from the section to the target.

    Attributes:
        pose: Homogeneous matrices, positions [m].
        s: Which sections, in [0, 1]; the tip if omitted.
        part: The part of an assembly.
        length: A radian counts as much as this length [m].
        weight: How much this counts against other targets [-].
    """

    pose: Float[Array, "points h h"] = eqx.field(converter=lambda x: _rows(x, 2))
    s: Float[Array, " points"] = eqx.field(converter=lambda x: _rows(x, 0), default=1.0)
    part: str | None = eqx.field(static=True, default=None)
    length: Float[Array, ""] = eqx.field(converter=real, default=0.02)
    weight: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    def __check_init__(self):
        _check_points("Pose", "pose", self.pose, self.s)

    def errors(self, group, frames):
        dim, rot = group.space_dim, group.rotation_dim
        scale = jnp.concatenate(
            [jnp.broadcast_to(self.length, rot), jnp.ones_like(self.pose[0, 0, :dim])]
        )

        # Axes of the world at the section: the same sums of squares as in its own.
        def one(pose, directors, position, angular, linear):
            ahead = pose[:dim, dim] - position
            turn = pose[:dim, :dim] @ directors.T
            back = jnp.concatenate([turn, ahead[:, None]], axis=1)
            twist, change = logarithm_and_change(group, jnp.concatenate([back, pose[dim:]]))
            moving = jnp.concatenate([angular, linear])
            return scale * twist, scale[:, None] * product(change, moving)

        if self.pose.shape[0] == 1:  # no batches of one in the time-critical case
            missing, made = one(*(x[0] for x in (self.pose, *frames)))
            return self.weight * missing, self.weight * made
        missing, made = jax.vmap(one)(self.pose, *frames)
        return self.weight * missing.reshape(-1), self.weight * _flat(made)


class Direction(AbstractTarget):
    """Directions of the rod's axis; opposite ones are in balance too, if unstable.

    Attributes:
        direction: Along which the local x axes shall point, of any length.
        s: Which sections, in [0, 1]; the tip if omitted.
        part: The part of an assembly.
        length: A radian counts as much as this length [m].
    """

    direction: Float[Array, "points dim"] = eqx.field(converter=lambda x: _rows(x, 1))
    s: Float[Array, " points"] = eqx.field(converter=lambda x: _rows(x, 0), default=1.0)
    part: str | None = eqx.field(static=True, default=None)
    length: Float[Array, ""] = eqx.field(converter=real, default=0.02)

    def __check_init__(self):
        _check_points("Direction", "direction", self.direction, self.s)

    def errors(self, group, frames):
        size = jnp.sqrt(jnp.sum(self.direction**2, axis=1, keepdims=True))
        axis, spin = frames.directors[:, :, 0], frames.angular_jacobian
        missing = self.length * (self.direction / size - axis)
        return missing.reshape(-1), self.length * _flat(swept(spin, axis))


class OnSurface(AbstractTarget):
    """Sections on the surface of a shape, or at a distance from it.

    Attributes:
        shape: Its signed distance, in the world frame.
        s: Which sections, in [0, 1].
        distance: From the surface, outside [m].
        part: The part of an assembly.
        weight: How much this counts against other targets [-].
    """

    shape: AbstractSdf
    s: Float[Array, " points"] = eqx.field(converter=lambda x: _rows(x, 0))
    distance: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    part: str | None = eqx.field(static=True, default=None)
    weight: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    def errors(self, group, frames):
        gap, slope = jax.vmap(jax.value_and_grad(self.shape))(frames.position)
        made = jnp.sum(slope[:, :, None] * frames.linear_jacobian, axis=1)
        return self.weight * (self.distance - gap), self.weight * made


class ObstacleConstraint(eqx.Module):
    """Sections that stay outside an obstacle: a bound, not a wish.

    Attributes:
        obstacle: Its signed distance, in the world frame.
        s: Which sections, in [0, 1].
        distance: What to keep between centre line and surface [m], e.g. the radius.
        part: The part of an assembly.
    """

    obstacle: AbstractSdf
    s: Float[Array, " points"] = eqx.field(converter=lambda x: _rows(x, 0))
    distance: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    part: str | None = eqx.field(static=True, default=None)

    def gaps(self, frames: Frames) -> Errors:
        """Distance beyond the required one [m], and its derivative by each rate."""
        gap, slope = jax.vmap(jax.value_and_grad(self.obstacle))(frames.position)
        change = jnp.sum(slope[:, :, None] * frames.linear_jacobian, axis=1)
        return gap - self.distance, change


def _flat(jacobians: Float[Array, "points rows dof"]) -> Float[Array, "all dof"]:
    return jacobians.reshape(-1, jacobians.shape[-1])


def _rows(values, rank: int) -> Array:
    """A stack of things of `rank` axes; one thing is a stack of one."""
    values = real(values)
    return values[None] if values.ndim == rank else values


def _check_points(where: str, name: str, values: Array, s: Array) -> None:
    _check.finite(where, name, values, "It is where sections shall go.")
    if values.ndim == 0 or s.ndim == 0:
        raise ValueError(
            f"{where}: got a number for `{name}`, need coordinates [m]. Give one row per "
            "target."
        )
    if values.shape[0] != s.shape[0]:
        raise ValueError(
            f"{where}: got {values.shape[0]} of `{name}` and {s.shape[0]} of `s`, need as "
            "many. Give the place in [0, 1] of every target."
        )
