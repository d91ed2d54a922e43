"""A rigid body in space, pushed by wrenches, weight and contact."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.contact import Penalty
from sorojax.contact.facet import contacts
from sorojax.math.lie import quaternion_rate, rotation_matrix
from sorojax.sdf.base import AbstractSdf
from sorojax.systems.blocks.block import AbstractBlock, Input, Output


class Touch(eqx.Module):
    """Contact of a body: points of its surface against an obstacle.

    Attributes:
        obstacle: A shape that does not move, in the frame of the world.
        points: Points of the surface of the body, in its frame [m].
        areas: What each stands for [m^2].
        law: The penalty.
        damping: Normal damping where it touches [Pa s/m]; acts while pressing only.
    """

    obstacle: AbstractSdf
    points: Float[Array, "points 3"] = eqx.field(converter=real)
    areas: Float[Array, " points"] = eqx.field(converter=real)
    law: Penalty
    damping: Float[Array, ""] = eqx.field(converter=real, default=0.0)


class RigidBody(AbstractBlock):
    """A body of six degrees of freedom; the state is {q, p}.

    q holds the position of the centre of mass and the quaternion (scalar first), p the
    angular momentum about that centre and the linear momentum, all in axes of the world.
    Without a wrench p does not change at all, so every method conserves momentum to
    round-off, whatever it does to the energy.

    Attributes:
        mass: [kg].
        inertia: Principal moments about the centre of mass, along the axes of the body
            [kg m^2].
        position: At the start [m].
        quaternion: At the start, scalar first; from body to world.
        angular_velocity, velocity: At the start, in axes of the world [rad/s], [m/s].
        gravity: [m/s^2].
        touch: Contacts.
    """

    mass: Float[Array, ""] = eqx.field(converter=real)
    inertia: Float[Array, "3"] = eqx.field(converter=real)
    position: Float[Array, "3"] = eqx.field(converter=real, default=(0.0, 0.0, 0.0))
    quaternion: Float[Array, "4"] = eqx.field(converter=real, default=(1.0, 0.0, 0.0, 0.0))
    angular_velocity: Float[Array, "3"] = eqx.field(converter=real, default=(0.0, 0.0, 0.0))
    velocity: Float[Array, "3"] = eqx.field(converter=real, default=(0.0, 0.0, 0.0))
    gravity: Float[Array, "3"] | None = eqx.field(converter=optional_real, default=None)
    touch: tuple[Touch, ...] = ()

    def __check_init__(self):
        do = "Moments are about the centre of mass; `sdf.inertia` gives those of a shape."
        _check.positive("RigidBody", "mass", self.mass, "kg", do)
        _check.positive("RigidBody", "inertia", self.inertia, "kg m^2", do)
        _check.shape("RigidBody", "inertia", self.inertia, (3,), do)

    @property
    def inputs(self):
        zero = Input("N", (3,), 0.0)
        return {"force": zero, "torque": Input("N m", (3,), 0.0)}

    @property
    def outputs(self):
        return {
            "position": Output("m", (3,)),
            "quaternion": Output(None, (4,)),
            "velocity": Output("m/s", (3,)),
            "angular_velocity": Output("rad/s", (3,)),
            "angular_momentum": Output("N m s", (3,)),
            "energy": Output("J"),
        }

    def initial_state(self):
        quaternion = _unit(self.quaternion)
        turn = rotation_matrix(quaternion)
        spin = turn @ (self.inertia * (turn.T @ self.angular_velocity))
        return {
            "q": jnp.concatenate([self.position, quaternion]),
            "p": jnp.concatenate([spin, self.mass * self.velocity]),
        }

    def output(self, name, t, state, inputs):
        q, p = state["q"], state["p"]
        if name == "position":
            return q[:3]
        if name == "quaternion":
            return _unit(q[3:])
        if name == "angular_momentum":
            return p[:3]
        omega, velocity = self._velocities(q, p)
        if name == "energy":
            return (omega @ p[:3] + velocity @ p[3:]) / 2
        return velocity if name == "velocity" else omega

    def vector_field(self, t, state, inputs):
        q, p = state["q"], state["p"]
        omega, velocity = self._velocities(q, p)
        force, torque = inputs["force"], inputs["torque"]
        if self.gravity is not None:
            force = force + self.mass * self.gravity
        for each in self.touch:
            push, moment = self._pushed(each, q, omega, velocity)
            force, torque = force + push, torque + moment
        turn = quaternion_rate(omega, q[3:])
        return {"q": jnp.concatenate([velocity, turn]), "p": jnp.concatenate([torque, force])}

    def _velocities(self, q, p):
        turn = rotation_matrix(_unit(q[3:]))
        return turn @ ((turn.T @ p[:3]) / self.inertia), p[3:] / self.mass

    def _pushed(self, touch: Touch, q, omega, velocity):
        """Force and torque about the centre of mass of one set of contacts."""
        arms = touch.points @ rotation_matrix(_unit(q[3:])).T
        found = contacts(touch.law, touch.obstacle, q[None, :3] + arms, touch.areas)
        speed = velocity[None] + jnp.cross(jnp.broadcast_to(omega, arms.shape), arms)
        closing = -jnp.sum(found.normal * speed, axis=1)
        brake = jnp.where(found.gap < 0, touch.damping * touch.areas * closing, 0.0)
        pull = jnp.sum(found.force * found.normal, axis=1)  # the sum never holds the body back
        brake = jnp.maximum(brake, -pull)
        forces = found.force + brake[:, None] * found.normal
        return jnp.sum(forces, axis=0), jnp.sum(jnp.cross(arms, forces), axis=0)


def _unit(quaternion: Array) -> Array:
    return quaternion / jnp.sqrt(jnp.sum(quaternion**2))
