"""Energy and momentum of a rod or assembly, and the matrix behind its Coriolis force."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import Numbers, real
from sorojax.math.door import door
from sorojax.rod.assembly import is_flat, slices
from sorojax.rod.dynamics import coordinate_rate
from sorojax.rod.link import LinkMotion
from sorojax.rod.mass_line import mass_jacobian, mass_position
from sorojax.rod.model import Model, inertia, motion
from sorojax.rod.motion import Motion
from sorojax.rod.part_columns import part_columns
from sorojax.rod.points import moment_of
from sorojax.rod.rod import Rod
from sorojax.rod.tree import AssemblyMotion, part_motion


@door
def kinetic_energy(
    model: Model, q: Float[Array, " coordinates"], v: Float[Array, " dof"]
) -> Float[Array, ""]:
    """v' M v / 2 [J]."""
    return v @ inertia(motion(model, q))[0] @ v / 2


@door
def potential_energy(
    model: Model, q: Float[Array, " coordinates"], gravity: Numbers | None = None
) -> Float[Array, ""]:
    """Linear elastic energy [J], and that of the weight in `gravity` [m/s^2] if given."""
    moment = motion(model, q)
    strains = _strain_coordinates(model, q)
    energy = strains @ moment.operators.stiffness @ strains / 2
    if gravity is None:
        return energy
    g = real(gravity)
    for part, _ in _parts(moment):
        energy = energy - jnp.sum(
            part.operators.mass[:, None] * g[None, :] * mass_position(part)
        )
    return energy


@door
def momentum(
    model: Model, q: Float[Array, " coordinates"], v: Float[Array, " dof"]
) -> Float[Array, " twist"]:
    """Angular momentum about the origin [kg m^2/s], then linear momentum [kg m/s]."""
    total = None
    for part, _ in _parts(motion(model, q, v)):
        mass, rotary, linear, local = _rows(part)
        velocity = linear @ part.v
        push = mass[:, None] * velocity
        spin = jnp.einsum("pij,pj->pi", rotary, local @ part.v)
        if spin.shape[1] == 3:
            spin = jnp.einsum("pij,pj->pi", part.directors, spin)
        angular = spin + moment_of(mass_position(part), push)
        term = jnp.concatenate([jnp.sum(angular, axis=0), jnp.sum(push, axis=0)])
        total = term if total is None else total + term
    assert total is not None
    return total


@door
def coriolis_matrix(
    model: Model, q: Float[Array, " coordinates"], v: Float[Array, " dof"]
) -> Float[Array, "dof dof"]:
    """C(q, v) with C v the Coriolis force, and dM/dt - 2 C skew-symmetric.

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

    now, rates = jax.jvp(rows, (q,), (coordinate_rate(model, q, v),))
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
    moment: Motion | AssemblyMotion,
) -> list[tuple[Motion | LinkMotion, Float[Array, "own dof"] | None]]:
    """The parts in the world frame, with their columns per rate of the model."""
    if isinstance(moment, Motion):
        return [(moment, None)]
    columns = part_columns(moment)
    return [(part_motion(moment, k), columns[k]) for k in range(len(columns))]


def _rows(part: Motion | LinkMotion) -> tuple[Array, Array, Array, Array]:
    """Mass and rotary inertia of each section; Jacobians, the angular one in its axes."""
    angular = part.angular_jacobian
    local = angular
    if angular.shape[1] == 3:
        local = jnp.einsum("pji,pjn->pin", part.directors, angular)
    if isinstance(part, LinkMotion):
        rotary = part.rotary[None]
    else:
        rotary = jax.vmap(jnp.diag)(part.operators.rotary.T)
    return part.operators.mass, rotary, mass_jacobian(part), local


def _strain_coordinates(model: Model, q: Array) -> Float[Array, " dof"]:
    """Coordinates in the order of the rates; quaternions, which store no energy, as zero."""
    if isinstance(model, Rod) or is_flat(model):
        return q
    pieces = []
    for part, at in zip(model.parts, slices(model), strict=True):
        count = part.joint.num_dof(model.group)
        flat = part.joint.num_coordinates(model.group) == count
        pieces.append(q[at.joint_q] if flat else jnp.zeros(count, q.dtype))
        pieces.append(q[at.rod_q])
    return jnp.concatenate(pieces)
