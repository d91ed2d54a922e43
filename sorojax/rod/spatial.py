"""The spatial rod: rotations by Magnus cells, the rest by spectral integration.

Reference:
    Boyer, Lebastard, Candelier, Renda, Dynamics of continuum and soft robots: a strain
    parameterization based approach, IEEE T-RO 37, 2021, for the model.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.math.magnus import rotation_vector
from sorojax.math.quaternion import cross, exponential, prefix_product, rotation_columns
from sorojax.rod.mass_line import acceleration_on_arms, mass_arms, on_arms
from sorojax.rod.motion import (
    Motion,
    Operators,
    integrated,
    is_curvature,
    local_axis,
    rest_along,
)
from sorojax.rod.rod import Rod


def motion(rod: Rod, constants: Operators, q: Array, v: Array) -> Motion:
    """Fields of the rod at the Gauss nodes."""
    axes = _directors(rod, constants, q)
    angular_rate, shape_rate = _strain_rates(rod, constants, axes)
    tangent = _tangent(rod, constants, axes, q)
    angular = _integrate(constants, angular_rate)
    linear_rate = _cross(angular, tangent[:, :, None])
    if shape_rate is not None:
        linear_rate = linear_rate + shape_rate
    return Motion(
        rod,
        constants,
        q,
        v,
        directors=jnp.stack(axes, axis=-1),
        tangent=tangent,
        angular_rate=angular_rate,
        linear_rate=linear_rate,
        angular_jacobian=angular,
        linear_jacobian=_integrate(constants, linear_rate),
    )


def inertia(moment: Motion) -> tuple[Float[Array, "dof dof"], Float[Array, " dof"]]:
    """Mass matrix and Coriolis force by one product J' [S J | F]."""
    constants, dof = moment.operators, moment.v.shape[0]
    spin = _spin(moment)
    swing, inner = _bias_rates(moment, spin)
    linear, angular = integrated(constants, inner), integrated(constants, swing)
    arms = mass_arms(moment)
    linear = acceleration_on_arms(linear, angular, spin, arms)
    moving = on_arms(moment, moment.linear_jacobian, arms)
    local = _to_local(moment.directors, moment.angular_jacobian)
    local_spin = _to_local(moment.directors, spin[:, :, None])[:, :, 0]
    rotary = constants.rotary.T
    torque = rotary * _to_local(moment.directors, angular[:, :, None])[:, :, 0]
    torque = torque + _cross(local_spin, rotary * local_spin)
    force = constants.mass[:, None] * linear
    scale = jnp.concatenate([jnp.repeat(constants.mass, 3), rotary.reshape(-1)])
    rows = jnp.concatenate([moving.reshape(-1, dof), local.reshape(-1, dof)])
    loads = jnp.concatenate([force.reshape(-1), torque.reshape(-1)])
    product = rows.T @ jnp.concatenate([rows * scale[:, None], loads[:, None]], axis=1)
    return product[:, :dof], product[:, dof]


def bias_rates(moment: Motion) -> tuple[Float[Array, "quad 3"], Float[Array, "quad 3"]]:
    """d/ds of the accelerations at zero coordinate acceleration, angular and linear."""
    return _bias_rates(moment, _spin(moment))


def _directors(rod: Rod, constants: Operators, q: Array) -> list[Array]:
    """Local axes at the nodes, three arrays (quad, dim)."""
    order, rot, cells, dof = constants.moments.shape
    moments = (constants.moments.reshape(-1, dof) @ q).reshape(order, rot, cells)
    if rod.rest_strain is not None:
        moments = moments + constants.rest_moments
    by_order = tuple(jnp.unstack(m) for m in jnp.unstack(moments))
    turns = prefix_product(exponential(rotation_vector(by_order)))  # type: ignore[arg-type]
    if rod.quadrature.breaks:
        turns = tuple(c[rod.quadrature.node_cells] for c in turns)
    w, x, y, z = turns
    return [jnp.stack(column, axis=1) for column in rotation_columns((w, x, y, z))]


def _strain_rates(
    rod: Rod, constants: Operators, axes: list[Array]
) -> tuple[Array, Array | None]:
    """World-frame strain per coordinate, (quad, 3, dof): curvature, stretch and shear."""
    curvature, shape = None, None
    for name, rows in zip(rod.basis.active, constants.strain_rows, strict=True):
        term = axes[local_axis(name)][:, :, None] * rows[:, None, :]
        if is_curvature(name):
            curvature = term if curvature is None else curvature + term
        else:
            shape = term if shape is None else shape + term
    if curvature is None:
        curvature = jnp.zeros((rod.nodes, 3, rod.basis.num_dof), axes[0].dtype)
    return curvature, shape


def _tangent(rod: Rod, constants: Operators, axes: list[Array], q: Array) -> Array:
    if rod.rest_strain is None:
        tangent = axes[0]
    else:
        rest = rest_along(constants)
        tangent = rest[:, 3:4] * axes[0] + rest[:, 4:5] * axes[1] + rest[:, 5:6] * axes[2]
    for name, rows in zip(rod.basis.active, constants.strain_rows, strict=True):
        if not is_curvature(name):
            tangent = tangent + axes[local_axis(name)] * (rows @ q)[:, None]
    return tangent


def _spin(moment: Motion) -> Float[Array, "quad 3"]:
    quad, _, dof = moment.angular_jacobian.shape
    return (moment.angular_jacobian.reshape(-1, dof) @ moment.v).reshape(quad, 3)


def _bias_rates(moment: Motion, spin: Array) -> tuple[Array, Array]:
    constants, v = moment.operators, moment.v
    quad, _, dof = moment.angular_rate.shape
    curl = (moment.angular_rate.reshape(-1, dof) @ v).reshape(quad, 3)
    swing = _cross(spin, curl)
    angular = integrated(constants, swing)
    swept = _cross(spin, moment.tangent)
    if any(not is_curvature(name) for name in moment.rod.basis.active):
        turning = _cross(spin, moment.tangent)
        rate = (moment.linear_rate.reshape(-1, dof) @ v).reshape(quad, 3)
        swept = swept + 2 * (rate - turning)
    return swing, _cross(angular, moment.tangent) + _cross(spin, swept)


def _to_local(directors: Array, vectors: Float[Array, "quad dim n"]) -> Array:
    """R' times the columns; written out, as batches of tiny matrix products are slow."""
    terms = [directors[:, k, :, None] * vectors[:, k, None, :] for k in range(3)]
    return terms[0] + terms[1] + terms[2]


def _integrate(constants: Operators, rate: Array) -> Array:
    return (constants.integration @ rate.reshape(rate.shape[0], -1)).reshape(rate.shape)


def _cross(a: Array, b: Array) -> Array:
    """Cross product along axis 1."""
    left, right = (a[:, 0], a[:, 1], a[:, 2]), (b[:, 0], b[:, 1], b[:, 2])
    return jnp.stack(cross(left, right), axis=1)
