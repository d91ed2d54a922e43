"""Equilibrium of closed loops: the reactions of closures as unknowns beside the coordinates.

Of a model with closures the unknowns x are (q, lambda), and the residual is

    [-f(q) - G(q, t)' lambda, g(q, t)],

the derivative of an energy less the work of the reactions. Without closures x is q, and
nothing is added.

Reference:
    Nocedal and Wright, Numerical Optimization, 2006, chapters 16 and 18.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.math.ode.held import pseudo_inverse
from sorojax.rod.dynamics.closures import (
    closure_force,
    closure_jacobian,
    closure_wrenches,
    violations,
)
from sorojax.rod.dynamics.tree import AssemblyState
from sorojax.rod.forces.loads import Load, total_force
from sorojax.rod.model.assembly import increments, num_coordinates, num_dof, rest, retract
from sorojax.rod.model.closure import equations
from sorojax.rod.model.model import Model, motion
from sorojax.rod.model.rod import Rod

_FLOOR = 1e-6  # of the mean compliance of the closures, where one finds none at rest


def num_equations(model: Model) -> int:
    """Equations of all closures; as many reactions."""
    places = () if isinstance(model, Rod) else equations(model)
    return places[-1].stop if places else 0


def without_reactions(model: Model, q: Float[Array, " coordinates"]) -> Array:
    """The unknowns at coordinates, without reactions."""
    count = num_equations(model)
    return jnp.pad(q, (0, count)) if count else q


def advanced(model: Model, x: Array, increment: Float[Array, " unknowns"]) -> Array:
    """The unknowns, or the coordinates alone, after an increment."""
    count = num_coordinates(model)
    if x.shape[0] == count:
        return retract(model, x, increment)
    dof = num_dof(model)
    q = retract(model, x[:count], increment[:dof])
    return jnp.concatenate([q, x[count:] + increment[dof:]])


def strained(model: Model, x: Array) -> Float[Array, " unknowns"]:
    """The unknowns in the places of their increments, as far as they store energy."""
    count = num_equations(model)
    if count == 0:
        return increments(model, x)
    return jnp.concatenate([increments(model, x[:-count]), x[-count:]])


def unbalanced(
    model: Model,
    constants: Any,
    forces: tuple[Load, ...],
    t: Array,
    x: Array,
    metric: Float[Array, "unknowns unknowns"],
) -> Float[Array, " unknowns"]:
    """Unbalanced forces, then the violations of closures.

    In the slope alone each closure has a trace of compliance, by which equations that follow
    from others leave it regular: of reactions that balance each other the least are found.
    """
    count = num_equations(model)
    moment = motion(model, x[: num_coordinates(model)], constants=constants)
    force = total_force(forces, t, moment)
    if count == 0:
        return -force
    assert isinstance(moment, AssemblyState)
    reactions = x[-count:]
    give = float(jnp.finfo(x.dtype).eps) ** 0.65 * jnp.diag(metric)[-count:]
    none = give * (reactions - jax.lax.stop_gradient(reactions))
    held = closure_force(moment, t, reactions)
    return jnp.concatenate([-force - held, violations(moment, t) + none])


def reactions_at(model: Model, constants: Any, t: Array, x: Array):
    """Coordinates, and wrenches of the closures by name; None without closures."""
    count = num_equations(model)
    if count == 0:
        return x, None
    moment: Any = motion(model, x[:-count], constants=constants)
    return x[:-count], closure_wrenches(moment, t, x[-count:])


def with_reactions(model: Model, metric: Float[Array, "dof dof"]) -> Array:
    """The metric of increments with that of reactions: the energy that they store by the
    compliance of the model at rest."""
    count = num_equations(model)
    if count == 0:
        return metric
    moment: Any = motion(model, rest(model))
    rows = closure_jacobian(moment, jnp.zeros((), metric.dtype))
    compliance = jnp.sum(rows * jnp.linalg.solve(metric, rows.T).T, axis=1)
    compliance = compliance + _FLOOR * jnp.mean(compliance)
    return jax.scipy.linalg.block_diag(metric, jnp.diag(compliance))


def within_closures(
    model: Model, slope: Float[Array, "unknowns unknowns"], metric: Array
) -> tuple[Float[Array, "dof dof"], Float[Array, "dof dof"]]:
    """Tangent and metric of the coordinates; with closures the tangent of motions that keep
    them, and a positive stiffness along all others."""
    count = num_equations(model)
    if count == 0:
        return slope, metric
    dof = num_dof(model)
    scale = jnp.sqrt(jnp.diag(metric)[:dof])
    inner = slope[:dof, :dof] / (scale[:, None] * scale[None])
    rows = slope[dof:, :dof] / scale[None]
    size = jnp.sqrt(jnp.sum(rows**2, axis=1, keepdims=True))
    rows = rows / jnp.where(size > 0, size, jnp.ones_like(size))
    across = rows.T @ pseudo_inverse(rows @ rows.T) @ rows
    along = jnp.eye(dof, dtype=slope.dtype) - across
    kept = along @ inner @ along + jnp.max(jnp.abs(inner)) * across
    return kept * (scale[:, None] * scale[None]), metric[:dof, :dof]


def closing(
    moment: AssemblyState, t: Array, length: Float[Array, ""]
) -> tuple[Float[Array, " equations"], Float[Array, "equations dof"]]:
    """What is left to close the loops [m], turns at the `length`, and what rates make up."""
    sizes = jnp.concatenate(_lengths(moment, length))
    return -sizes * violations(moment, t), sizes[:, None] * closure_jacobian(moment, t)


def _lengths(moment: AssemblyState, length: Array) -> list[Float[Array, " held"]]:
    """Of every closure, metres of each of its violations: the length for a turn, one for a
    shift."""
    group, dtype = moment.assembly.group, moment.q.dtype
    eye, still = jnp.eye(group.space_dim, dtype=dtype), jnp.zeros(group.space_dim, dtype)
    found = []
    for closure in moment.assembly.closures:
        joint = closure.joint
        shifts = jax.jacfwd(lambda p, joint=joint: joint.violation(group, eye, p))(still)
        share = jnp.sum(shifts**2, axis=1)
        found.append(jnp.where(share > 0.5, jnp.ones_like(share), length))
    return found
