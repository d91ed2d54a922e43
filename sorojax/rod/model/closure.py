"""Closures: joints that close a loop of an assembly, or hold a part of it to the ground."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.rod.model.joint import AbstractJoint, Fixed, Group

if TYPE_CHECKING:
    from sorojax.rod.model.assembly import Assembly


class Closure(eqx.Module):
    """A joint between a point of one part and a point of another, or of the ground, beside
    those of the tree.

    Springs and dampers of its joint do not act; a `PairForce` or `JointEffort` does.

    Attributes:
        part: The part that is held.
        joint: How its frame may move on the frame that holds it.
        on: The part that holds it; None for the ground.
        offset: Pose of the joint in the frame that carries it, homogeneous, position [m]:
            that of the link, or of the section at `s` of the rod, or the ground. The same if
            omitted.
        s: Where on a rod that carries it, in [0, 1].
        frame: Pose in the part of the frame that is held; that of the link, or of the section
            at `at` of the rod, if omitted.
        at: Where on a rod that is held, in [0, 1].
        motion: From time [s] to the pose of the joint beyond `offset`, homogeneous, or to its
            position alone [m]: an end that is driven. Twice differentiable for a run in time.
            `motion_from_velocity` makes one of a velocity.
            An `eqx.Module` passes through `jax.jit` with the model, and its numbers have
            derivatives; a plain function needs a closure over the model, or `eqx.filter_jit`.
    """

    part: str = eqx.field(static=True)
    joint: AbstractJoint = eqx.field(default_factory=Fixed)
    on: str | None = eqx.field(static=True, default=None)
    offset: Float[Array, "h h"] | None = eqx.field(converter=optional_real, default=None)
    s: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    frame: Float[Array, "h h"] | None = eqx.field(converter=optional_real, default=None)
    at: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    motion: Callable[[Float[Array, ""]], Float[Array, "h h"]] | None = None

    def __check_init__(self):
        _check.between("Closure", "s", self.s, 0, 1, "-", "0 is the base.", "[]")
        _check.between("Closure", "at", self.at, 0, 1, "-", "0 is the base.", "[]")


def is_closed(model: Any) -> "TypeGuard[Assembly]":
    """Whether a rod or assembly has closures."""
    return bool(getattr(model, "closures", ()))


def num_held(joint: AbstractJoint, group: Group) -> int:
    """Motions that a joint holds: equations of a closure with it."""
    pose = jnp.eye(group.space_dim), jnp.zeros(group.space_dim)
    return jax.eval_shape(lambda *pose: joint.violation(group, *pose), *pose).shape[0]


def equations(model: "Assembly") -> tuple[slice, ...]:
    """Where each closure has its equations and reactions."""
    found, start = [], 0
    for closure in model.closures:
        stop = start + num_held(closure.joint, model.group)
        found.append(slice(start, stop))
        start = stop
    return tuple(found)


def check_closure(model: "Assembly", name: str) -> None:
    """Refuse a closure of unknown parts, or one that cannot hold them."""
    where, closure = f"with_closures: closure `{name}`", model.closures[model.loops.index(name)]
    for part in (closure.part, closure.on):
        if part is not None and part not in model.names:
            raise ValueError(
                f"{where} names `{part}`, need one of {', '.join(model.names)}. Leave `on` "
                "out for the ground."
            )
    size = model.group.space_dim + 1
    do = "Give a homogeneous matrix, e.g. sorojax.math.lie.homogeneous(R, p)."
    for field in ("offset", "frame"):
        pose = getattr(closure, field)
        if pose is not None:
            _check.shape(where, field, pose, (size, size), do)
    num_held(closure.joint, model.group)
