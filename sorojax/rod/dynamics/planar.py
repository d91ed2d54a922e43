"""The planar rod: the section angle is linear in q, so no group exponential appears."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.rod.dynamics.fields import (
    Operators,
    RodState,
    integrated,
    is_curvature,
    local_axis,
    rest_along,
)
from sorojax.rod.dynamics.moving import (
    acceleration_on_arms,
    mass_arms,
    mass_jacobian,
    quarter_turned,
)
from sorojax.rod.dynamics.points import own
from sorojax.rod.model.rod import Rod


def motion(rod: Rod, constants: Operators, q: Array, v: Array) -> RodState:
    """Fields of the rod at the Gauss nodes."""
    per_coordinate = _at_nodes(rod, jnp.cumsum(constants.moments[0, 0], axis=0))
    angle = per_coordinate @ q
    if rod.rest_strain is not None:
        angle = angle + _at_nodes(rod, jnp.cumsum(constants.rest_moments[0, 0]))
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    axes = jnp.stack([cosine, sine], axis=1), jnp.stack([-sine, cosine], axis=1)
    tangent = _tangent(rod, constants, axes, q)
    linear_rate = quarter_turned(tangent)[:, :, None] * per_coordinate[:, None, :]
    curvature = jnp.zeros_like(per_coordinate)
    for name, rows in zip(rod.basis.active, constants.strain_rows, strict=True):
        if is_curvature(name):
            curvature = rows
        else:
            axis = axes[name == "sigma_y"]
            linear_rate = linear_rate + axis[:, :, None] * rows[:, None, :]
    return RodState(
        rod,
        constants,
        q,
        v,
        directors=jnp.stack(axes, axis=-1),
        tangent=tangent,
        angular_rate=curvature[:, None, :],
        linear_rate=linear_rate,
        angular_jacobian=per_coordinate[:, None, :],
        linear_jacobian=integrated(constants, linear_rate),
    )


def inertia(moment: RodState) -> tuple[Float[Array, "dof dof"], Float[Array, " dof"]]:
    """Mass matrix and Coriolis force by one product J' [S J | F]."""
    constants, v = moment.operators, moment.v
    dof = v.shape[0]
    angular = moment.angular_jacobian[:, 0]
    spin = (angular @ v)[:, None]
    inner = _bias_rate(moment, spin)
    linear = integrated(constants, inner)
    linear = acceleration_on_arms(linear, jnp.zeros_like(spin), spin, mass_arms(moment))
    force = constants.mass[:, None] * linear
    # Small terms first, as in the spatial rod: few sums round at full size.
    rows = jnp.concatenate([angular, mass_jacobian(moment).reshape(-1, dof)])
    scale = jnp.concatenate([constants.rotary[0], jnp.repeat(constants.mass, 2)])
    loads = jnp.concatenate([jnp.zeros_like(spin[:, 0]), force.reshape(-1)])
    product = rows.T @ jnp.concatenate([rows * scale[:, None], loads[:, None]], axis=1)
    return product[:, :dof], product[:, dof]


def bias_rates(moment: RodState) -> tuple[Float[Array, "quad 1"], Float[Array, "quad 2"]]:
    """d/ds of the accelerations at zero coordinate acceleration, angular and linear."""
    spin = moment.angular_jacobian @ moment.v
    return jnp.zeros_like(spin), _bias_rate(moment, spin)


def _bias_rate(moment: RodState, spin: Float[Array, "quad 1"]) -> Float[Array, "quad 2"]:
    rate = spin * quarter_turned(moment.tangent)
    for name, rows in zip(moment.rod.basis.active, moment.operators.strain_rows, strict=True):
        if not is_curvature(name):
            speed = rows @ own(moment, moment.v)
            rate = rate + 2 * moment.directors[:, :, local_axis(name)] * speed[:, None]
    return spin * quarter_turned(rate)


def _at_nodes(rod: Rod, cells: Float[Array, "cells *dof"]) -> Float[Array, "quad *dof"]:
    return cells[rod.quadrature.node_cells] if rod.quadrature.breaks else cells


def _tangent(rod: Rod, constants: Operators, axes, q: Array) -> Array:
    rest = rest_along(constants)
    tangent = rest[:, 1:2] * axes[0] + rest[:, 2:3] * axes[1]
    for name, rows in zip(rod.basis.active, constants.strain_rows, strict=True):
        if not is_curvature(name):
            tangent = tangent + axes[name == "sigma_y"] * (rows @ q)[:, None]
    return tangent
