"""Common part of searches over coordinates: increments, tangents, a metric and its units.

Coordinates may outnumber rates, as a quaternion does: searches step in the rates'
dimension, and a root is found in as many equations as there are coordinates.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sorojax.rod.dynamics.fields import is_curvature
from sorojax.rod.model.assembly import dtype_of, is_flat, num_dof, rest, retract, slices
from sorojax.rod.model.model import Model, inertia, motion
from sorojax.rod.model.rod import Rod

_INERTIA_SHARE = 1e-6  # of the mean square frequency, for joints without a spring


def moved(model: Model, q: Array, increment: Float[Array, " dof"]) -> Array:
    """Coordinates after an increment."""
    return q + increment if isinstance(model, Rod) else retract(model, q, increment)


def squared(model: Model, q: Array, residual: Float[Array, " dof"]) -> Array:
    """As many equations as coordinates: the residual along the coordinates that it can
    move, and the norm of a quaternion along the one it cannot."""
    if isinstance(model, Rod) or is_flat(model):
        return residual
    still = jnp.zeros_like(residual)
    normal, along = jax.jvp(lambda d: retract(model, q, d), (still,), (residual,))
    return along + q - normal


def increments(model: Model, q: Array) -> Float[Array, " dof"]:
    """The coordinates in the places of their rates; zero where those are others."""
    if isinstance(model, Rod) or is_flat(model):
        return q
    own = jnp.zeros(num_dof(model), q.dtype)
    for at in slices(model):
        own = own.at[at.rod_v].set(q[at.rod_q])
        if at.joint_q.stop - at.joint_q.start == at.joint_v.stop - at.joint_v.start:
            own = own.at[at.joint_v].set(q[at.joint_q])
    return own


def linearised(
    residual: Callable[[Array], Array], model: Model, q: Array
) -> tuple[Float[Array, " dof"], Float[Array, "dof dof"]]:
    """A residual and its exact tangent, one forward pass for all columns."""

    def along(increment):
        value = residual(moved(model, q, increment))
        return value, value

    still = jnp.zeros(num_dof(model), q.dtype)
    slope, value = jax.jacfwd(along, has_aux=True)(still)
    return value, slope


def negative_eigenvalues(
    slope: Float[Array, "dof dof"], metric: Float[Array, "dof dof"]
) -> Int[Array, ""]:
    """Of the symmetric part, beyond rounding."""
    slope = _scaled(slope, metric)
    values = jnp.linalg.eigvalsh((slope + slope.T) / 2)
    rounding = 32 * jnp.finfo(slope.dtype).eps * jnp.max(jnp.abs(values))
    return jnp.sum(values < -rounding, dtype=jnp.int32)


def is_unstable(
    slope: Float[Array, "dof dof"], metric: Float[Array, "dof dof"], negative: Int[Array, ""]
) -> Bool[Array, ""]:
    """Whether a state of this tangent is surely left.

    Under loads that have a potential by a negative eigenvalue. Loads that follow the body make
    the tangent unsymmetric; then one real negative eigenvalue, as a negative determinant tells:
    the symmetric part may have one where the state is stable.

    Reference: Bolotin, "Nonconservative Problems of the Theory of Elastic Stability", 1963.
    """
    slope = _scaled(slope, metric)
    share = float(jnp.finfo(slope.dtype).eps) ** 0.5
    apart = jnp.max(jnp.abs(slope - slope.T)) > share * jnp.max(jnp.abs(slope))
    sign, _ = jnp.linalg.slogdet(slope)
    return (negative > 0) & (~apart | (sign < 0))


def _scaled(slope: Array, metric: Array) -> Array:
    """Without units: strains and bends differ by many orders."""
    scale = jnp.sqrt(jnp.diag(metric))
    return slope / (scale[:, None] * scale[None])


def metric(model: Model, constants) -> Float[Array, "dof dof"]:
    """Positive matrix that measures increments in energy.

    The elastic stiffness; in an assembly with a share of the inertia at rest, as a joint
    without a spring has none.
    """
    stiffness = constants.stiffness
    if isinstance(model, Rod):
        return stiffness
    mass, _ = inertia(motion(model, rest(model), constants=constants))
    square = jnp.trace(jnp.linalg.solve(mass, stiffness)) / stiffness.shape[0]
    share = jnp.where(square > 0, _INERTIA_SHARE * square, jnp.ones_like(square))
    return stiffness + share * mass


def unit_energy(model: Model, metric: Float[Array, "dof dof"]) -> Float[Array, ""]:
    """Size of `metric` at a bend of one radian and a strain of one."""
    return jnp.diag(metric) @ _units(model) ** 2


def _units(model: Model) -> Float[Array, " dof"]:
    if isinstance(model, Rod):
        one = jnp.ones((), model.length.dtype)
        return jnp.concatenate(
            [
                jnp.full(
                    model.basis.modes[name].count,
                    one / model.length if is_curvature(name) else one,
                )
                for name in model.basis.active
            ]
        )
    units = jnp.ones(num_dof(model), dtype_of(model))
    for part, at in zip(model.parts, slices(model), strict=True):
        if isinstance(part.body, Rod):
            units = units.at[at.rod_v].set(_units(part.body))
    return units
