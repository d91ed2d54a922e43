"""Equations of motion of a rod: M a + coriolis = sum of generalised forces.

These are doors: each compiles once per structure of the rod and its forces. Loops use
`motion`, `inertia` and `total_force` directly, with `operators` taken outside.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.math.dense import solve_symmetric
from sorojax.math.door import door
from sorojax.rod import forces as rod_forces
from sorojax.rod.forces import AbstractForce
from sorojax.rod.kinematics import inertia, motion
from sorojax.rod.motion import Operators, operators
from sorojax.rod.rod import Rod

Coordinates = Float[Array, " dof"]
Forces = tuple[AbstractForce, ...]


@door
def mass_matrix(rod: Rod, q: Coordinates) -> Float[Array, "dof dof"]:
    """Inertia of the rod in its coordinates."""
    return inertia(motion(rod, q))[0]


@door
def coriolis_force(rod: Rod, q: Coordinates, v: Coordinates) -> Coordinates:
    """C(q, v) v: what velocity alone adds to the left of the equations of motion."""
    return inertia(motion(rod, q, v))[1]


@door
def gravity_force(rod: Rod, q: Coordinates, gravity=None) -> Coordinates:
    """Gradient of the gravitational energy, on the left of the equations of motion.

    Args:
        rod: The rod.
        q: Coordinates.
        gravity: [m/s^2]; by default 9.81 against the last axis.
    """
    return -rod_forces.Gravity(gravity)(_zero(q), motion(rod, q))


@door
def bias_force(rod: Rod, q: Coordinates, v: Coordinates, gravity=None) -> Coordinates:
    """C(q, v) v + g(q), what a computed-torque controller cancels."""
    moment = motion(rod, q, v)
    return inertia(moment)[1] - rod_forces.Gravity(gravity)(_zero(q), moment)


@door
def stiffness_matrix(rod: Rod) -> Float[Array, "dof dof"]:
    """Stiffness of the rod's own linear elasticity."""
    return operators(rod).stiffness


@door
def elastic_force(rod: Rod, q: Coordinates) -> Coordinates:
    """K q, on the left of the equations of motion."""
    return operators(rod).stiffness @ q


@door
def damping_matrix(rod: Rod, forces: Forces) -> Float[Array, "dof dof"]:
    """Sum of the damping terms among `forces`."""
    return rod_forces.damping_matrix(forces, operators(rod).stiffness)


@door
def forward_dynamics(
    rod: Rod,
    q: Coordinates,
    v: Coordinates,
    forces: Forces = (),
    *,
    t=0.0,
    unroll: bool = False,
) -> Coordinates:
    """Acceleration of the coordinates.

    Args:
        rod: The rod.
        q: Coordinates.
        v: Their rates.
        forces: Generalised forces; the rod's elasticity acts unless one replaces it.
        t: Time [s].
        unroll: Write the rotation product out; for compiled forward loops.
    """
    return acceleration(rod, operators(rod), real(t), q, v, forces, unroll=unroll)


def acceleration(
    rod: Rod,
    constants: Operators,
    t: Float[Array, ""],
    q: Coordinates,
    v: Coordinates,
    forces: Forces,
    *,
    unroll: bool = False,
) -> Coordinates:
    """`forward_dynamics` without a door, for loops that hold `operators(rod)`."""
    moment = motion(rod, q, v, constants=constants, unroll=unroll)
    mass, coriolis = inertia(moment)
    return solve_symmetric(mass, rod_forces.total_force(forces, t, moment) - coriolis)


@door
def inverse_dynamics(
    rod: Rod, q: Coordinates, v: Coordinates, a: Coordinates, forces: Forces = (), *, t=0.0
) -> Coordinates:
    """Generalised force that an actuator must add to reach the acceleration `a`."""
    moment = motion(rod, q, v)
    mass, coriolis = inertia(moment)
    return mass @ a + coriolis - rod_forces.total_force(forces, real(t), moment)


@door
def kinetic_energy(rod: Rod, q: Coordinates, v: Coordinates) -> Float[Array, ""]:
    """v' M v / 2 [J]."""
    return v @ mass_matrix(rod, q) @ v / 2


@door
def potential_energy(rod: Rod, q: Coordinates, gravity=None) -> Float[Array, ""]:
    """Linear elastic energy [J], and that of the weight in `gravity` [m/s^2] if given."""
    moment = motion(rod, q)
    energy = q @ moment.operators.stiffness @ q / 2
    if gravity is None:
        return energy
    weight = moment.operators.mass[:, None] * real(gravity)[None, :]
    return energy - jnp.sum(weight * moment.position)


def _zero(q: Coordinates) -> Float[Array, ""]:
    return jnp.zeros((), q.dtype)
