"""Equations of motion of a rod or assembly: M a + coriolis = sum of generalised forces.

These are doors: each compiles once per structure of the model and its forces. Loops use
`motion`, `inertia` and `total_force` directly, with `operators` taken outside.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import Numbers, real
from sorojax.math.batch import batched
from sorojax.math.dense import solve_symmetric
from sorojax.math.door import door, full_products
from sorojax.rod import loads
from sorojax.rod.assembly import Assembly, is_flat, rate
from sorojax.rod.forces import Gravity
from sorojax.rod.model import Model, inertia, motion, operators

Coordinates = Float[Array, " coordinates"]
Rates = Float[Array, " dof"]
Forces = tuple[loads.Load, ...]


@door
def mass_matrix(model: Model, q: Coordinates) -> Float[Array, "dof dof"]:
    """Inertia of the model in its coordinates."""
    return inertia(motion(model, q))[0]


@door
def coriolis_force(model: Model, q: Coordinates, v: Rates) -> Rates:
    """C(q, v) v: what velocity alone adds to the left of the equations of motion."""
    return inertia(motion(model, q, v))[1]


@door
def gravity_force(model: Model, q: Coordinates, gravity: Numbers | None = None) -> Rates:
    """Gradient of the gravitational energy, on the left of the equations of motion.

    Args:
        model: The rod or assembly.
        q: Coordinates.
        gravity: [m/s^2]; by default 9.81 against the last axis.
    """
    return -loads.weight(Gravity(gravity), _zero(q), motion(model, q))


@door
def bias_force(model: Model, q: Coordinates, v: Rates, gravity: Numbers | None = None) -> Rates:
    """C(q, v) v + g(q), what a computed-torque controller cancels."""
    moment = motion(model, q, v)
    return inertia(moment)[1] - loads.weight(Gravity(gravity), _zero(q), moment)


@door
def stiffness_matrix(model: Model) -> Float[Array, "dof dof"]:
    """Stiffness of the linear elasticity of rods and joints."""
    return operators(model).stiffness


@door
def elastic_force(model: Model, q: Coordinates) -> Rates:
    """K q, on the left of the equations of motion."""
    moment = motion(model, q)
    return -loads.total_force((), _zero(q), moment)


@door
def damping_matrix(model: Model, forces: Forces) -> Float[Array, "dof dof"]:
    """Sum of the damping terms among `forces` and of the dampers of joints."""
    return loads.damping_matrix(forces, model, operators(model))


@door
def forward_dynamics(
    model: Model,
    q: Float[Array, "*states coordinates"],
    v: Float[Array, "*states dof"],
    forces: Forces = (),
    *,
    t=0.0,
) -> Float[Array, "*states dof"]:
    """Acceleration of the coordinates, of one state or many.

    States along a first axis of `q` and `v` are taken in chunks that stay in the cache of a
    CPU, those of `jax.vmap` at once. For many models, or a loop around this verb, use
    `sorojax.math.batch.batched`.

    Args:
        model: The rod or assembly.
        q: Coordinates, or those of many states.
        v: Their rates, of the same states.
        forces: Generalised forces; elasticity acts unless one replaces it.
        t: Time [s].

    Raises:
        ValueError: If the shapes do not fit the model or each other.
    """
    constants, t = operators(model), real(t)

    def one(q, v):
        return acceleration(model, constants, t, q, v, forces)

    if np.ndim(q) == 1 and np.ndim(v) == 1:
        return one(q, v)
    return batched(one)(q, v)


@full_products
def acceleration(
    model: Model,
    constants: Any,
    t: Float[Array, ""],
    q: Coordinates,
    v: Rates,
    forces: Forces,
) -> Rates:
    """`forward_dynamics` without a door, for loops that hold `operators(model)`."""
    moment = motion(model, q, v, constants=constants)
    mass, coriolis = inertia(moment)
    return solve_symmetric(mass, loads.total_force(forces, t, moment) - coriolis)


@door
def inverse_dynamics(
    model: Model, q: Coordinates, v: Rates, a: Rates, forces: Forces = (), *, t=0.0
) -> Rates:
    """Generalised force that an actuator must add to reach the acceleration `a`."""
    moment = motion(model, q, v)
    mass, coriolis = inertia(moment)
    return mass @ a + coriolis - loads.total_force(forces, real(t), moment)


class VectorField(eqx.Module):
    """(t, (q, v), args) -> (dq/dt, dv/dt): the right-hand side that diffrax integrates.

    The field is a pytree: `diffrax.ODETerm(vector_field(rod, forces))` is differentiable
    in the rod and its forces.
    """

    model: Model
    constants: Any
    forces: Forces

    def __call__(self, t: Any, state: tuple[Array, Array], args: Any = None):
        q, v = state
        t = jnp.asarray(t, q.dtype)
        a = acceleration(self.model, self.constants, t, q, v, self.forces)
        return coordinate_rate(self.model, q, v), a


def vector_field(model: Model, forces: Forces = ()) -> VectorField:
    """The equations of first order of a model, for any solver of diffrax."""
    return VectorField(model, operators(model), forces)


def coordinate_rate(model: Model, q: Coordinates, v: Rates) -> Coordinates:
    """dq/dt; v itself but for quaternions."""
    if isinstance(model, Assembly) and not is_flat(model):
        return rate(model, q, v)
    return v


def _zero(q: Coordinates) -> Float[Array, ""]:
    return jnp.zeros((), q.dtype)
