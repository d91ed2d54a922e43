"""Motions of a joint in time from samples of its velocity."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.math.lie import SE2, SE3, homogeneous, rotation_vector

_WHERE = "motion_from_velocity"


class DrivenMotion(eqx.Module):
    """Pose in time of a joint whose velocity is linear between samples: what
    `motion_from_velocity` makes.

    Attributes:
        times: Of the samples [s].
        twists: The samples [rad/s], [m/s].
        poses: The pose at each.
        moving: Whether twists are along the axes of the moving frame.
    """

    times: Float[Array, " samples"] = eqx.field(converter=real)
    twists: Float[Array, "samples twist"] = eqx.field(converter=real)
    poses: Float[Array, "samples h h"] = eqx.field(converter=real)
    moving: bool = eqx.field(static=True, default=False)

    def __call__(self, t: Float[Array, ""] | float) -> Float[Array, "h h"]:
        """The pose at a time."""
        t = jnp.asarray(t, self.times.dtype)
        none = jnp.zeros_like(self.twists[:1])
        slopes = jnp.diff(self.twists, axis=0) / jnp.diff(self.times)[:, None]
        slopes = jnp.concatenate([none, slopes, none])  # held before the first, after the last
        interval = jnp.searchsorted(self.times, t, side="right", method="compare_all")
        at = jnp.maximum(interval - 1, 0)
        change = self.twists[at], slopes[interval]
        return _after(self.poses[at], *change, t - self.times[at], self.moving)


def motion_from_velocity(
    times: Float[Array, " samples"],
    twists: Float[Array, "samples twist"],
    start: Float[Array, "h h"] | None = None,
    *,
    axes: Literal["fixed", "moving"] = "fixed",
) -> DrivenMotion:
    """The motion of a joint whose velocity is known in time: for `Closure(motion=...)`.

    A twist is the angular velocity of the joint, then the velocity of its origin, both along
    the axes of the frame that carries it, as rates of a `Free` joint, rows of `jacobian` and
    the input `base_velocity` of `systems.AssemblyBody`; or along its own, moving axes, a body
    twist. Between samples it is linear in time, before the first and after the last it keeps
    their value: end with zeros to stop. Acceleration jumps at the samples; steps that end
    there keep their order.

    With fixed axes R' = w x R and p' = v, with moving ones T' = T hat(w, v). Positions along
    fixed axes, and rotations about an axis that does not turn, are exact. Otherwise intervals
    are Magnus steps, whose error falls with the sixth power of their length; velocity and
    acceleration are the derivatives of the pose, and as near to what was given. Take samples
    between which the joint turns by less than about a radian.

    Args:
        times: Of the samples, increasing [s]; one sample is a constant velocity.
        twists: Angular velocities [rad/s], then velocities [m/s]: rows of three numbers in a
            plane, of six in space.
        start: Pose at the first sample, homogeneous, in the frame that carries the joint,
            position [m]; there itself if omitted.
        axes: Along which a twist is given.

    Returns:
        A function of time that passes through `jax.jit` with a model, with derivatives by
        samples, times and start.

    Raises:
        ValueError: If shapes differ, times do not increase, or numbers are not finite.

    Example:
        >>> times = jnp.array([0.0, 1.0, 2.0])  # lifts and turns, and comes to rest
        >>> twists = jnp.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.1], [0.0, 0.0, 0.0]])
        >>> lift = rod.motion_from_velocity(times, twists)
        >>> print(lift(3.0)[:2, 2])
        [0.  0.1]
        >>> driven = rod.Closure("finger", at=0.0, motion=lift)

    Reference:
        Blanes, Casas, Oteo, Ros, The Magnus expansion, Physics Reports 470, 2009.
    """
    times, twists, start = real(times), real(twists), optional_real(start)
    _check.shape(_WHERE, "times", times, (None,), "Give the time of each sample.")
    width = twists.shape[-1] if twists.ndim == 2 else None
    if width not in (3, 6) or twists.shape[0] != times.shape[0] or not times.size:
        raise ValueError(
            f"{_WHERE}: `twists` has shape {twists.shape} at {times.size} times, need a row of "
            "3 (plane) or 6 (space) numbers at each of one time or more. Put zeros for what "
            "does not move."
        )
    group = SE2() if width == 3 else SE3()
    h = group.space_dim + 1
    start = jnp.eye(h, dtype=twists.dtype) if start is None else start.astype(twists.dtype)
    _check.shape(_WHERE, "start", start, (h, h), "Give a pose of the space of the twists.")
    for name, value in (("times", times), ("twists", twists), ("start", start)):
        _check.finite(_WHERE, name, value, "Leave out samples that are missing.")
    if _check.is_concrete(times) and np.any(np.diff(np.asarray(times)) <= 0):
        raise ValueError(
            f"{_WHERE}: `times` do not increase, need each later than the one before. Sort "
            "them, and keep one of those that are equal."
        )
    times = times.astype(twists.dtype)
    moving = axes == "moving"
    return DrivenMotion(times, twists, _poses(times, twists, start, moving), moving)


def _poses(times: Array, twists: Array, start: Array, moving: bool) -> Array:
    """Poses at the samples."""

    def advance(pose, interval):
        twist, later, length = interval
        pose = _after(pose, twist, (later - twist) / length, length, moving)
        return pose, pose

    intervals = twists[:-1], twists[1:], jnp.diff(times)
    return jnp.concatenate([start[None], jax.lax.scan(advance, start, intervals)[1]])


def _after(
    pose: Float[Array, "h h"],
    twist: Float[Array, " twist"],
    slope: Float[Array, " twist"],
    time: Float[Array, ""],
    moving: bool,
) -> Float[Array, "h h"]:
    """A pose after a time with a twist that grows from `twist` by `slope` per second."""
    moved, bent = time * twist + time**2 / 2 * slope, time**2 * slope
    if moving:
        return pose @ _moved(moved, bent)
    dim = pose.shape[0] - 1
    # R' = w x R is the transpose of a rotation that goes by -w along moving axes
    still = jnp.zeros_like(moved).at[:-dim].set(1)
    back = _moved(-still * moved, -still * bent)[:dim, :dim]
    return homogeneous(back.T @ pose[:dim, :dim], pose[:dim, dim] + moved[-dim:])


def _moved(moved: Float[Array, " twist"], bent: Float[Array, " twist"]) -> Float[Array, "h h"]:
    """T with T' = T hat(twist), from the integral of a twist that is linear in time and its
    slope times the square of the time."""
    group = SE2() if moved.shape[0] == 3 else SE3()
    none = jnp.zeros_like(moved[0])

    def split(x):
        return ((none, none, x[0]), (x[1], x[2], none)) if x.shape[0] == 3 else (x[:3], x[3:])

    # brackets of twists are cross products of angular parts, and their first variations
    angular, linear = zip(*map(split, (moved, bent, jnp.zeros_like(moved))), strict=True)
    angular, linear = (tuple(tuple(v) for v in part) for part in (angular, linear))
    spin, shift = jax.jvp(rotation_vector, (angular,), (linear,))
    found = spin + shift if moved.shape[0] == 6 else (spin[2], *shift[:2])
    return group.exp(jnp.stack(found))
