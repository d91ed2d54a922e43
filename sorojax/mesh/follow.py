"""How points follow a shape: derivatives as explicit matrices over its few parameters.

Reverse mode through the field would compile its transpose, which for a large CSG tree
takes longer than all else. A drawing has tens of parameters, so the matrix of the field
by parameters is formed forwards, in one batch; what is transposed is one product.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.query import project, shape_tangent, value_and_gradient
from sorojax.sdf.scalar import quotient

_MANY = 100  # parameters: above, as for a polygon drawn by hand, plain reverse mode


def closest(field: AbstractSdf, p: Float[Array, "points dim"]) -> Float[Array, "points dim"]:
    """`sdf.project` with the same value and derivative."""
    return _closest(field, p) if _num_parameters(field) <= _MANY else project(field, p)


def field_tangent(
    field: AbstractSdf, dot: AbstractSdf, p: Float[Array, "points dim"]
) -> Float[Array, " points"]:
    """Change of the field at fixed points `p` when the parameters change by `dot`."""
    if _num_parameters(field) > _MANY:
        return shape_tangent(lambda s: s(p), field, dot)
    flat, flat_dot, build = _flat(field, dot)

    def along(e):
        return jax.jvp(lambda t: build(t)(p), (flat,), (e,))[1]

    return flat_dot @ jax.lax.map(along, jnp.eye(len(flat), dtype=p.dtype))


@eqx.filter_custom_jvp
def _closest(field, p):
    return project(field, p)


@_closest.def_jvp
def _closest_jvp(primals, tangents):
    """The rule of `sdf.project`: across the surface implicit, along it a Newton step."""
    (field, p), (field_dot, p_dot) = primals, tangents
    x, n = project(field, p), len(p)
    p_dot = jnp.zeros_like(p) if p_dot is None else p_dot
    flat, flat_dot, build = _flat(field, field_dot)
    (f, g), (f_by, g_by), (_, hessian) = _derivatives(build, flat, jnp.concatenate([x, p]))
    f_dot = flat_dot @ f_by
    g_dot = jnp.einsum("t,tpi->pi", flat_dot, g_by[:, n:])
    g_dot = g_dot + jnp.einsum("jpi,pj->pi", hessian[:, n:], p_dot)
    normal, square = g[:n], jnp.sum(g * g, axis=1)
    across = -quotient(f_dot[:n], square[:n])[:, None] * normal
    f, g, square_p = f[n:], g[n:], square[n:]
    f_dot = f_dot[n:] + jnp.sum(g * p_dot, axis=1)
    step = quotient(f, square_p)
    step_dot = quotient(f_dot - 2 * step * jnp.sum(g * g_dot, axis=1), square_p)
    along = p_dot - step_dot[:, None] * g - step[:, None] * g_dot
    slip = quotient(jnp.sum(along * normal, axis=1), square[:n])
    return x, across + along - slip[:, None] * normal


def _derivatives(build, flat, p):
    """Field and slope at `p`, and both by every parameter and by every coordinate."""
    count, dim = len(flat), p.shape[1]

    def along(e):
        def at(t, q):
            return value_and_gradient(build(t), q)

        shift = jnp.broadcast_to(e[None, count:], p.shape)
        return jax.jvp(at, (flat, p), (e[:count], shift))

    (f, g), (f_by, g_by) = jax.lax.map(along, jnp.eye(count + dim, dtype=p.dtype))
    return (f[0], g[0]), (f_by[:count], g_by[:count]), (f_by[count:], g_by[count:])


def _num_parameters(field: AbstractSdf) -> int:
    return sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(field, eqx.is_inexact_array)))


def _flat(field, dot):
    """Moving parameters in one vector, their tangents, and the way back to a shape."""
    moving = jax.tree.map(lambda d: d is not None, dot, is_leaf=lambda d: d is None)
    varied, held = eqx.partition(field, moving)
    flat, unravel = ravel_pytree(varied)
    flat_dot = ravel_pytree(dot)[0].astype(flat.dtype)
    return flat, flat_dot, lambda t: eqx.combine(unravel(t), held)
