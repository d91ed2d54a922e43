"""Equations of motion of a rod or assembly: M a + coriolis = sum of generalised forces.

Each function compiles once per structure of the model and its forces. Loops use `motion`,
`inertia` and `total_force` directly, with `operators` taken outside.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import Numbers, real
from sorojax.math.compiled import batched, chunked_lanes, full_products, jit_public
from sorojax.math.linalg.dense import solve_symmetric
from sorojax.math.ode.held import accelerate
from sorojax.rod.dynamics.closures import divided, held
from sorojax.rod.dynamics.fields import RodState
from sorojax.rod.dynamics.moving import mass_jacobian, mass_position
from sorojax.rod.dynamics.points import moment_of
from sorojax.rod.dynamics.tree import AssemblyState, part_columns, part_motion
from sorojax.rod.forces import loads
from sorojax.rod.forces.forces import Gravity
from sorojax.rod.model.assembly import Assembly, increments, rate
from sorojax.rod.model.closure import is_closed
from sorojax.rod.model.link import LinkState
from sorojax.rod.model.model import Model, inertia, motion, operators

Coordinates = Float[Array, " coordinates"]
Rates = Float[Array, " dof"]
Forces = tuple[loads.Load, ...]
PULL = 50.0  # 1/s, at which closures that a step has opened go back where nothing projects


@jit_public
def mass_matrix(model: Model, q: Coordinates) -> Float[Array, "dof dof"]:
    """Inertia of the model in its coordinates.

    Args:
        model: The rod or assembly.
        q: Coordinates.

    Returns:
        The matrix M(q), symmetric and positive definite.
    """
    return inertia(motion(model, q))[0]


@jit_public
def coriolis_force(model: Model, q: Coordinates, v: Rates) -> Rates:
    """C(q, v) v: what velocity alone adds to the left of the equations of motion.

    Args:
        model: The rod or assembly.
        q: Coordinates.
        v: Their rates, per second.

    Returns:
        Generalised force, on the left of the equations of motion.
    """
    return inertia(motion(model, q, v))[1]


@jit_public
def gravity_force(model: Model, q: Coordinates, gravity: Numbers | None = None) -> Rates:
    """Gradient of the gravitational energy, on the left of the equations of motion.

    Args:
        model: The rod or assembly.
        q: Coordinates.
        gravity: [m/s^2]; by default 9.81 against the last axis.

    Returns:
        Generalised force, on the left of the equations of motion.
    """
    return -loads.weight(Gravity(gravity), _zero(q), motion(model, q))


@jit_public
def bias_force(model: Model, q: Coordinates, v: Rates, gravity: Numbers | None = None) -> Rates:
    """C(q, v) v + g(q), what a computed-torque controller cancels.

    Args:
        model: The rod or assembly.
        q: Coordinates.
        v: Their rates, per second.
        gravity: Acceleration [m/s^2]; by default 9.81 against the last axis.

    Returns:
        Generalised force, on the left of the equations of motion.
    """
    moment = motion(model, q, v)
    return inertia(moment)[1] - loads.weight(Gravity(gravity), _zero(q), moment)


@jit_public
def stiffness_matrix(model: Model) -> Float[Array, "dof dof"]:
    """Stiffness of the linear elasticity of rods and joints.

    Args:
        model: The rod or assembly.

    Returns:
        The matrix K; its force is K q on the left of the equations of motion.
    """
    return operators(model).stiffness


@jit_public
def elastic_force(model: Model, q: Coordinates) -> Rates:
    """K q, on the left of the equations of motion.

    Args:
        model: The rod or assembly.
        q: Coordinates.

    Returns:
        Generalised force, on the left of the equations of motion.
    """
    moment = motion(model, q)
    return -loads.total_force((), _zero(q), moment)


@jit_public
def damping_matrix(model: Model, forces: Forces) -> Float[Array, "dof dof"]:
    """Sum of the damping terms among `forces` and of the dampers of joints.

    Args:
        model: The rod or assembly.
        forces: Generalised forces beside elasticity.

    Returns:
        The matrix D; its force is -D v.
    """
    return loads.damping_matrix(forces, model, operators(model))


@jit_public
def forward_dynamics(
    model: Model,
    q: Float[Array, "*states coordinates"],
    v: Float[Array, "*states dof"],
    forces: Forces = (),
    *,
    t=0.0,
) -> Float[Array, "*states dof"]:
    """Acceleration of the coordinates, q'' = M(q)^-1 (forces - c(q, q')), of one state or many.

    States along a first axis of `q` and `v`, and models and states by `jax.vmap`, are taken in
    chunks that stay in the cache of a CPU, also within a loop; lanes of a derivative are taken
    at once. `sorojax.math.compiled.batched` takes whole loops and derivatives in chunks.

    Args:
        model: The rod or assembly.
        q: Coordinates, or those of many states; curvature modes in [1/m].
        v: Their rates, per second, of the same states.
        forces: Generalised forces; elasticity acts unless one replaces it. None by default.
        t: Time [s].

    Returns:
        Second derivatives of the coordinates, units of q per s^2; with closures those that
        keep the loops closed, where (q, q') do.

    Raises:
        ValueError: If the shapes do not fit the model or each other.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> a = rod.forward_dynamics(finger, jnp.zeros(3), jnp.zeros(3), (rod.Gravity(),))
        >>> a.shape, bool(a[0] < 0)
        ((3,), True)

    Reference:
        Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 6.
    """
    constants, t = operators(model), real(t)

    def one(q, v):
        return acceleration(model, constants, t, q, v, forces)

    if np.ndim(q) == 1 and np.ndim(v) == 1:
        return one(q, v)
    return batched(one)(q, v)


@chunked_lanes
@full_products
def acceleration(
    model: Model,
    constants: Any,
    t: Float[Array, ""],
    q: Coordinates,
    v: Rates,
    forces: Forces,
    pull: float = 0.0,
) -> Rates:
    """`forward_dynamics` uncompiled, for loops that hold `operators(model)`; with a `pull`
    [1/s] back on closures that have opened.

    Args:
        model: The rod or assembly.
        constants: `operators(model)`.
        t: Time [s].
        q: Coordinates.
        v: Their rates, per second.
        forces: Generalised forces beside elasticity.
        pull: Rate at which closures that have opened are pulled back [1/s].

    Returns:
        Accelerations, the rates of `v`.
    """
    moment = motion(model, q, v, constants=constants)
    mass, coriolis = inertia(moment)
    force = loads.total_force(forces, t, moment) - coriolis
    if isinstance(moment, AssemblyState) and is_closed(model):
        return accelerate(mass, force, held(moment, t, pull)).x
    return solve_symmetric(mass, force)


@jit_public
def inverse_dynamics(
    model: Model, q: Coordinates, v: Rates, a: Rates, forces: Forces = (), *, t=0.0
) -> Rates:
    """Generalised force that an actuator must add to reach the acceleration `a`.

    Where closures bear a part of it, the smallest one, in the metric of the inverse mass.

    Args:
        model: The rod or assembly.
        q: Coordinates.
        v: Their rates, per second.
        a: Accelerations wanted.
        forces: Generalised forces beside elasticity.
        t: Time at which the forces act [s].

    Returns:
        The generalised force of the actuator.
    """
    moment = motion(model, q, v)
    mass, coriolis = inertia(moment)
    force = mass @ a + coriolis - loads.total_force(forces, real(t), moment)
    if isinstance(moment, AssemblyState) and is_closed(model):
        return divided(moment, real(t), mass, force)[0]
    return force


class VectorField(eqx.Module):
    """(t, (q, v), args) -> (dq/dt, dv/dt): the right-hand side that diffrax integrates.

    `model` is the rod or assembly, `constants` are its operators, and `forces` act on it.
    Closures that open by the error of a step are pulled shut at the rate `pull` [1/s];
    `rollout` projects instead, to round-off.

    The field is a pytree: `diffrax.ODETerm(vector_field(rod, forces))` is differentiable
    in the rod and its forces.
    """

    model: Model
    constants: Any
    forces: Forces
    pull: float = eqx.field(static=True, default=PULL)

    def __call__(self, t: Any, state: tuple[Array, Array], args: Any = None):
        q, v = state
        t = jnp.asarray(t, q.dtype)
        a = acceleration(self.model, self.constants, t, q, v, self.forces, self.pull)
        return rate(self.model, q, v), a


def vector_field(model: Model, forces: Forces = ()) -> VectorField:
    """The equations of first order of a model, for any solver of diffrax.

    Args:
        model: The rod or assembly.
        forces: Generalised forces beside elasticity.

    Returns:
        A function of (t, (q, v), args), which returns the rates of q and v.
    """
    return VectorField(model, operators(model), forces)


def _zero(q: Coordinates) -> Float[Array, ""]:
    return jnp.zeros((), q.dtype)


# Energy and momentum of a rod or assembly, and the matrix behind its Coriolis force


@jit_public
def kinetic_energy(
    model: Model, q: Float[Array, " coordinates"], v: Float[Array, " dof"]
) -> Float[Array, ""]:
    """v' M v / 2 [J].

    Args:
        model: The rod or assembly.
        q: Coordinates.
        v: Their rates, per second.

    Returns:
        Energy [J].
    """
    return v @ inertia(motion(model, q))[0] @ v / 2


@jit_public
def potential_energy(
    model: Model, q: Float[Array, " coordinates"], gravity: Numbers | None = None
) -> Float[Array, ""]:
    """Linear elastic energy [J], and that of the weight in `gravity` [m/s^2] if given.

    Args:
        model: The rod or assembly.
        q: Coordinates.
        gravity: Acceleration [m/s^2]; without it weight is left out.

    Returns:
        Energy [J].
    """
    moment = motion(model, q)
    strains = increments(model, q)
    energy = strains @ moment.operators.stiffness @ strains / 2
    if gravity is None:
        return energy
    g = real(gravity)
    for part, _ in _parts(moment):
        energy = energy - jnp.sum(
            part.operators.mass[:, None] * g[None, :] * mass_position(part)
        )
    return energy


@jit_public
def momentum(
    model: Model, q: Float[Array, " coordinates"], v: Float[Array, " dof"]
) -> Float[Array, " twist"]:
    """Angular momentum about the origin [kg m^2/s], then linear momentum [kg m/s].

    Args:
        model: The rod or assembly.
        q: Coordinates.
        v: Their rates, per second.

    Returns:
        Angular, then linear momentum, in the axes of the ground.
    """
    return functools.reduce(
        jnp.add, [_momentum(part) for part, _ in _parts(motion(model, q, v))]
    )


@jit_public
def part_momenta(
    model: Assembly, q: Float[Array, " coordinates"], v: Float[Array, " dof"]
) -> dict[str, Float[Array, " twist"]]:
    """`momentum` of every part by name, all about the origin of the ground.

    Args:
        model: The assembly.
        q: Coordinates.
        v: Their rates, per second.

    Returns:
        Angular [kg m^2/s], then linear momentum [kg m/s] of each part.
    """
    parts = [_momentum(part) for part, _ in _parts(motion(model, q, v))]
    return dict(zip(model.names, parts, strict=True))


def _momentum(part: RodState | LinkState) -> Float[Array, " twist"]:
    mass, rotary, linear, local = _rows(part)
    push = mass[:, None] * (linear @ part.v)
    spin = jnp.einsum("pij,pj->pi", rotary, local @ part.v)
    if spin.shape[1] == 3:
        spin = jnp.einsum("pij,pj->pi", part.directors, spin)
    angular = spin + moment_of(mass_position(part), push)
    return jnp.concatenate([jnp.sum(angular, axis=0), jnp.sum(push, axis=0)])


@jit_public
def coriolis_matrix(
    model: Model, q: Float[Array, " coordinates"], v: Float[Array, " dof"]
) -> Float[Array, "dof dof"]:
    """C(q, v) with C v the Coriolis force, and dM/dt - 2 C skew-symmetric.

    Args:
        model: The rod or assembly.
        q: Coordinates.
        v: Their rates, per second.

    Returns:
        The matrix C.

    Reference:
        Murray, Li, Sastry, A Mathematical Introduction to Robotic Manipulation, 1994,
        section 4.3, for the property; here section by section, in axes of the section.
    """

    def rows(q):
        moment = motion(model, q)
        found = []
        for part, columns in _parts(moment):
            mass, rotary, linear, local = _rows(part)
            if columns is not None:
                linear, local = linear @ columns, local @ columns
            found.append((mass, rotary, linear, local))
        return found

    now, rates = jax.jvp(rows, (q,), (rate(model, q, v),))
    total = jnp.zeros((v.shape[0],) * 2, q.dtype)
    for (mass, rotary, linear, local), (_, _, moving, turning) in zip(now, rates, strict=True):
        total = total + jnp.einsum("p,pin,pim->nm", mass, linear, moving)
        torque = jnp.einsum("pij,pjm->pim", rotary, turning)
        if local.shape[1] == 3:
            spun = jnp.einsum("pij,pj->pi", rotary, local @ v)
            torque = torque - jnp.cross(spun[:, :, None], local, axis=1)
        total = total + jnp.einsum("pin,pim->nm", local, torque)
    return total


def _parts(
    moment: RodState | AssemblyState,
) -> list[tuple[RodState | LinkState, Float[Array, "own dof"] | None]]:
    """The parts in the world frame, with their columns per rate of the model."""
    if isinstance(moment, RodState):
        return [(moment, None)]
    columns = part_columns(moment)
    return [(part_motion(moment, k), columns[k]) for k in range(len(columns))]


def _rows(part: RodState | LinkState) -> tuple[Array, Array, Array, Array]:
    """Mass and rotary inertia of each section; Jacobians, the angular one in its axes."""
    angular = part.angular_jacobian
    local = angular
    if angular.shape[1] == 3:
        local = jnp.einsum("pji,pjn->pin", part.directors, angular)
    if isinstance(part, LinkState):
        rotary = part.rotary[None]
    else:
        rotary = jax.vmap(jnp.diag)(part.operators.rotary.T)
    return part.operators.mass, rotary, mass_jacobian(part), local
