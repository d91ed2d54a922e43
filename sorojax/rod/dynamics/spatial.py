"""The spatial rod: rotations by Magnus cells, the rest by spectral integration.

Reference:
    Boyer, Lebastard, Candelier, Renda, Dynamics of continuum and soft robots: a strain
    parameterization based approach, IEEE T-RO 37, 2021, for the model.
"""

import functools

import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.math.lie import (
    cross,
    cross_columns,
    exponential,
    prefix_product,
    rotation_columns,
    rotation_vector,
)
from sorojax.rod.dynamics.fields import (
    Operators,
    RodState,
    integrated,
    is_curvature,
    local_axis,
    rest_along,
)
from sorojax.rod.dynamics.moving import acceleration_on_arms, mass_arms, on_arms
from sorojax.rod.dynamics.points import own
from sorojax.rod.model.rod import Rod


def motion(rod: Rod, constants: Operators, q: Array, v: Array) -> RodState:
    """Fields of the rod at the Gauss nodes."""
    axes = _directors(rod, constants, q)
    angular_rate, shape_rate = _strain_rates(rod, constants, axes)
    tangent = _tangent(rod, constants, axes, q)
    angular = _integrate(constants, angular_rate)
    linear_rate = cross_columns(angular, tangent[:, :, None])
    if shape_rate is not None:
        linear_rate = linear_rate + shape_rate
    return RodState(
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


def inertia(moment: RodState) -> tuple[Float[Array, "dof dof"], Float[Array, " dof"]]:
    """Mass matrix and Coriolis force by one product [S J | F]' J."""
    constants, dof = moment.operators, moment.v.shape[0]
    spin, _, angular, inner = _bias_rates(moment)
    linear = integrated(constants, inner)
    arms = mass_arms(moment)
    linear = acceleration_on_arms(linear, angular, spin, arms)
    moving = on_arms(moment, moment.linear_jacobian, arms)
    local = _to_local(moment.directors, moment.angular_jacobian)
    turning = _to_local(moment.directors, jnp.stack([spin, angular], axis=2))
    local_spin, local_angular = turning[:, :, 0], turning[:, :, 1]
    rotary = constants.rotary.T
    torque = rotary * local_angular + cross_columns(local_spin, rotary * local_spin)
    force = constants.mass[:, None] * linear
    # Small terms first, rotary inertia, then mass up to the tip: few sums round at full size.
    scale = jnp.concatenate([rotary.reshape(-1), jnp.repeat(constants.mass, 3)])
    rows = jnp.concatenate([local.reshape(-1, dof), moving.reshape(-1, dof)])
    loads = jnp.concatenate([torque.reshape(-1), force.reshape(-1)])
    # A library multiplies rows by columns twice as fast as columns by columns.
    product = jnp.concatenate([rows.T * scale[None], loads[None]]) @ rows
    return product[:dof], product[dof]


def bias_rates(moment: RodState) -> tuple[Float[Array, "quad 3"], Float[Array, "quad 3"]]:
    """d/ds of the accelerations at zero coordinate acceleration, angular and linear."""
    _, swing, _, inner = _bias_rates(moment)
    return swing, inner


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
    names = rod.basis.active
    every = zip(names, constants.strain_rows, strict=True)
    terms = [axes[local_axis(name)][:, :, None] * rows[:, None, :] for name, rows in every]
    curvature, shape = _by_kind(names, terms)
    if curvature is None:
        curvature = jnp.zeros((rod.nodes, 3, rod.basis.num_dof), axes[0].dtype)
    return curvature, shape


def _by_kind(names: tuple[str, ...], terms: list[Array]) -> tuple[Array | None, Array | None]:
    """Sums of the terms of curvatures, and of those of stretch and shear."""
    turning = [term for name, term in zip(names, terms, strict=True) if is_curvature(name)]
    others = [term for name, term in zip(names, terms, strict=True) if not is_curvature(name)]
    curvature, shape = (functools.reduce(jnp.add, x) if x else None for x in (turning, others))
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


def _bias_rates(moment: RodState) -> tuple[Array, Array, Array, Array]:
    """Spin; `bias_rates` of the angles, the integral of these, `bias_rates` of positions."""
    constants, rod = moment.operators, moment.rod
    axes = jnp.unstack(moment.directors, axis=2)
    speeds = jnp.unstack(constants.strain_rows @ own(moment, moment.v))
    every = zip(rod.basis.active, speeds, strict=True)
    terms = [axes[local_axis(name)] * speed[:, None] for name, speed in every]
    curl, shape = _by_kind(rod.basis.active, terms)
    curl = jnp.zeros_like(moment.tangent) if curl is None else curl
    spin = moment.angular_jacobian.reshape(-1, moment.v.shape[0]) @ moment.v
    spin = spin.reshape(curl.shape)
    swing = cross_columns(spin, curl)
    angular = integrated(constants, swing)
    turn, tangent = jnp.unstack(spin, axis=1), jnp.unstack(moment.tangent, axis=1)
    swept = cross(turn, tangent)  # type: ignore[arg-type]
    if shape is not None:
        parts = zip(swept, jnp.unstack(shape, axis=1), strict=True)
        swept = tuple(along + 2 * rate for along, rate in parts)
    turning = cross(jnp.unstack(angular, axis=1), tangent)  # type: ignore[arg-type]
    inner = zip(turning, cross(turn, swept), strict=True)  # type: ignore[arg-type]
    return spin, swing, angular, jnp.stack([a + b for a, b in inner], axis=1)


def _to_local(directors: Array, vectors: Float[Array, "quad dim n"]) -> Array:
    """R' times the columns; written out, as batches of tiny matrix products are slow."""
    rows, parts = jnp.unstack(directors, axis=1), jnp.unstack(vectors, axis=1)
    x, y, z = (a[:, :, None] * b[:, None, :] for a, b in zip(rows, parts, strict=True))
    return x + y + z


def _integrate(constants: Operators, rate: Array) -> Array:
    return (constants.integration @ rate.reshape(rate.shape[0], -1)).reshape(rate.shape)
