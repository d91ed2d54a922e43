"""Controllers that know the model: generalised efforts from coordinates and rates.

All are memoryless. As a controller: `law(t, (q, v), ()) -> (effort, ())`; in a network:
inputs `q` and `v`, output `effort`, for a body with `driven=True`.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.math.compiled import jit_public
from sorojax.math.linalg.dense import solve_symmetric
from sorojax.rod import (
    AbstractForce,
    Rod,
    inertia,
    jacobian,
    jacobian_rate_product,
    motion,
    tip_pose,
    total_force,
)
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.rollout import Trajectory
from sorojax.systems.blocks.block import AbstractReference, AbstractStateless, Input, Output
from sorojax.systems.control.controller import AbstractController

Effort = Float[Array, " dof"]


class AbstractLaw(AbstractStateless, AbstractController):
    """A static law from (t, q, v) to an effort in the coordinates of a `rod`, on which `forces`
    act."""

    rod: Rod
    forces: tuple[AbstractForce, ...]

    @abc.abstractmethod
    def effort(self, t: Float[Array, ""], q: Effort, v: Effort) -> Effort:
        """Generalised force that the law asks for."""

    @property
    def inputs(self):
        dof = (self.rod.basis.num_dof,)
        return {"q": Input(None, dof), "v": Input(None, dof)}

    @property
    def outputs(self):
        dof = (self.rod.basis.num_dof,)
        return {"effort": Output(None, dof, frozenset({"q", "v"}))}

    def output(self, name, t, state, inputs):
        return self.effort(t, inputs["q"], inputs["v"])

    def start(self, t, measurement):
        return ()

    def __call__(self, t, measurement, state):
        return self.effort(t, *measurement), state


class ComputedTorque(AbstractLaw):
    """M (a_d + K_d (v_d - v) + K_p (q_d - q)) + c - f: errors decay as e'' + K_d e' + K_p e.

    Attributes:
        rod, forces: What it knows; the forces f are cancelled, elasticity included.
        reference: Coordinates over time; its rates are derived.
        proportional: K_p [1/s^2].
        derivative: K_d [1/s].
    """

    reference: AbstractReference
    proportional: Float[Array, "..."] = eqx.field(converter=real)
    derivative: Float[Array, "..."] = eqx.field(converter=real)

    def effort(self, t, q, v):
        target, rate, acceleration = wanted(self.reference, t)
        moment = motion(self.rod, q, v)
        mass, coriolis = inertia(moment)
        pull = self.proportional * (target - q) + self.derivative * (rate - v)
        return mass @ (acceleration + pull) + coriolis - total_force(self.forces, t, moment)


class Compensation(AbstractLaw):
    """Cancels weight and elasticity, adds a spring and a damper towards the reference.

    Attributes:
        rod, forces: What is cancelled, at rest: `(Gravity(),)` cancels weight and elasticity.
        reference: Coordinates over time.
        proportional, derivative: Stiffness and damping in the coordinates.
    """

    reference: AbstractReference
    proportional: Float[Array, "..."] = eqx.field(converter=real)
    derivative: Float[Array, "..."] = eqx.field(converter=real)

    def effort(self, t, q, v):
        target, rate, _ = wanted(self.reference, t)
        held = -total_force(self.forces, t, motion(self.rod, q))
        return held + self.proportional * (target - q) + self.derivative * (rate - v)


class EnergyShaping(AbstractLaw):
    """Replaces the potential by another and adds damping: the energy left is T + wanted(q).

    effort = dU/dq - d(wanted)/dq - damping v. The motion comes to rest where `wanted` is
    smallest.

    Attributes:
        rod, forces: What makes the potential U, elasticity included.
        potential: The wanted potential, a module q -> energy [J].
        damping: In the coordinates; a number, or a vector.
    """

    potential: eqx.Module
    damping: Float[Array, "..."] = eqx.field(converter=real)

    def effort(self, t, q, v):
        own = -total_force(self.forces, t, motion(self.rod, q))
        return own - jax.grad(self.potential)(q) - self.damping * v  # type: ignore[arg-type]


class TipSpring(eqx.Module):
    """The energy of a spring from the tip to a point, plus one in the coordinates.

    Attributes:
        rod: The rod.
        point: Where the tip should be [m].
        stiffness: [N/m].
        posture: Stiffness in the coordinates, for those that the tip does not determine.
    """

    rod: Rod
    point: Float[Array, " dim"] = eqx.field(converter=real)
    stiffness: Float[Array, ""] = eqx.field(converter=real)
    posture: Float[Array, ""] = eqx.field(converter=real, default=0.0)

    def __call__(self, q: Effort) -> Float[Array, ""]:
        miss = tip_pose(self.rod, q)[:-1, -1] - self.point
        return (self.stiffness * miss @ miss + self.posture * q @ q) / 2


class CartesianImpedance(AbstractLaw):
    """Makes the tip a mass L(q) on a spring and a damper: L x'' = K (x_d - x) + D (x_d' - x').

    effort = J' (L J M^-1 f + n + K e + D e'), n = L (J M^-1 C v - J' v),
    L = (J M^-1 J')^-1, f the elastic and other forces to cancel in the space of the tip.

    Attributes:
        rod, forces: What it knows; damping among the forces is cancelled too.
        reference: Position of the tip over time [m].
        stiffness: K [N/m].
        damping: D [N s/m].
        posture: Damping in the coordinates of what does not move the tip.

    Reference:
        Della Santina et al., Int. J. Robot. Res. 39, 2020; Caasenbrood et al., Sorotoki,
        2024, eq. 32 and 33.
    """

    reference: AbstractReference
    stiffness: Float[Array, "..."] = eqx.field(converter=real)
    damping: Float[Array, "..."] = eqx.field(converter=real)
    posture: Float[Array, "..."] = eqx.field(converter=real, default=0.0)

    def effort(self, t, q, v):
        target, rate, _ = wanted(self.reference, t)
        moment = motion(self.rod, q, v)
        mass, coriolis = inertia(moment)
        slope, turn = self._tip(q, v)
        inverse = jax.vmap(lambda row: solve_symmetric(mass, row))(slope)  # J M^-1
        softness = inverse @ slope.T
        held = coriolis - total_force(self.forces, t, moment)
        miss = target - tip_pose(self.rod, q)[:-1, -1]
        pull = self.stiffness * miss + self.damping * (rate - slope @ v)
        push = solve_symmetric(softness, inverse @ held - turn)
        free = v - inverse.T @ solve_symmetric(softness, slope @ v)
        return slope.T @ (push + pull) - self.posture * (mass @ free)

    def _tip(self, q, v) -> tuple[Array, Array]:
        """Velocity of the tip per coordinate rate, and what velocity adds to it."""
        end, dim = jnp.ones(1, q.dtype), self.rod.group.space_dim
        twists = jacobian(self.rod, q, end)[0]
        turns: Any = jacobian_rate_product(self.rod, q, v, end)
        return twists[-dim:], turns[0][-dim:]


class FeedForward(AbstractLaw):
    """The effort that moves the model along the reference; looks at no measurement.

    Attributes:
        rod, forces: What it knows.
        reference: Coordinates over time.
    """

    reference: AbstractReference

    def effort(self, t, q, v):
        target, rate, acceleration = wanted(self.reference, t)
        moment: RodState = motion(self.rod, target, rate)
        mass, coriolis = inertia(moment)
        return mass @ acceleration + coriolis - total_force(self.forces, t, moment)


def wanted(reference: AbstractReference, t) -> tuple[Array, Array, Array]:
    """Value, rate and acceleration of a reference at `t`."""

    def rate(t):
        return jax.jvp(reference, (t,), (jnp.ones_like(t),))

    (value, slope), (_, bend) = jax.jvp(rate, (t,), (jnp.ones_like(t),))
    return value, slope, bend


# A controller that knows the model as a force on its rod: closed loops in `rod.rollout`


class ControlForce(AbstractForce):
    """The effort of a law that sees coordinates and rates at every instant.

    `rod.rollout(rod, q, v, (ControlForce(law), contact), ...)` moves the closed loop with a
    stepper made for contact; `Sampled` is the loop of a computer with ticks.

    Attributes:
        law: `ComputedTorque`, `CartesianImpedance`, ...
    """

    law: AbstractLaw

    def __call__(self, t, motion):
        return self.law.effort(t, motion.q, motion.v)


# What a law at the tip of a rod asked for along a motion, and what it got


class Tracking(NamedTuple):
    """A law and its rod at the moments of a motion.

    Attributes:
        goal: Where the tip should have been [m].
        tip: Where it was [m].
        effort: Generalised force that the law gave, over the rates of the rod.
    """

    goal: Float[Array, "moments dim"]
    tip: Float[Array, "moments dim"]
    effort: Float[Array, "moments dof"]


@jit_public
def tracking(law: CartesianImpedance, path: Trajectory) -> Tracking:
    """Set-points, tips and efforts of `law` along the motion `path` of its rod.

    Args:
        law: The controller.
        path: From `rod.rollout`.

    Returns:
        What was wanted and what was done, at every moment.
    """

    def at(t, q, v):
        return Tracking(law.reference(t), tip_pose(law.rod, q)[:-1, -1], law.effort(t, q, v))

    return jax.vmap(at)(path.time, path.q, path.v)
