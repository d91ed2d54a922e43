"""What environments of rods share: forces that a supply drives, markers, and a motion."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sorojax.math.compiled import chunked_lanes
from sorojax.math.ode.linearly_implicit import LinearlyImplicit
from sorojax.math.ode.steppers import AbstractStepper
from sorojax.rod import (
    AbstractForce,
    AbstractPressureMap,
    Assembly,
    Pressurised,
    Rod,
    forward_kinematics,
    num_dof,
    rest,
    rollout,
)


class RodBody(NamedTuple):
    """Coordinates of a rod or an assembly and their rates."""

    q: Float[Array, " coordinates"]
    v: Float[Array, " dof"]


class Inflated(AbstractForce):
    """A pressure map whose pressure is delivered during a step.

    Attributes:
        chambers: The map.
        pressure: Gauge pressure [Pa] by the time since the step began.
    """

    chambers: AbstractPressureMap
    pressure: Callable[[Array], Array]

    def __call__(self, t, motion):
        return Pressurised(self.chambers, self.pressure(t))(t, motion)


def rolled(
    model: Rod | Assembly,
    body: RodBody,
    forces: tuple[Any, ...],
    stepper: AbstractStepper,
    *,
    time_step: float,
    steps: int,
) -> RodBody:
    """The body after some steps of one length [s], from the time 0."""
    how = {"saves": 1, "every": steps, "stepper": stepper, "check": False}

    def run(model: Rod | Assembly, body: RodBody, forces: tuple[Any, ...]) -> RodBody:
        path = rollout(model, body.q, body.v, forces, step=time_step, **how)
        return RodBody(path.q[-1], path.v[-1])

    return chunked_lanes(run)(model, body, forces)


_SETTLING = (0.05, 40)  # [s], steps: what is left then is rounding


def settled(model: Rod | Assembly, forces: tuple[Any, ...]) -> RodBody:
    """The body when it has come to rest from its rest shape, by long steps of a damped method:
    a search for equilibrium may go to another one, or to none."""
    time_step, steps = _SETTLING
    start = RodBody(rest(model), jnp.zeros(num_dof(model), rest(model).dtype))
    return rolled(model, start, forces, LinearlyImplicit(), time_step=time_step, steps=steps)


def places(
    model: Rod | Assembly, q: Float[Array, " coordinates"], s: Float[np.ndarray, " markers"]
) -> Float[Array, "markers dim"]:
    """Points on the backbone of a rod, or of the only part of an assembly [m]."""
    poses = forward_kinematics(model, q, s)
    if isinstance(poses, dict):
        (poses,) = poses.values()
    return poses[:, :-1, -1]


def near_base(markers: Float[Array, "markers dim"], length: Array) -> Bool[Array, ""]:
    """Whether no marker is farther out than twice the length of the rod."""
    return jnp.all(jnp.sum(markers**2, axis=1) < 4 * length**2)
