"""What a shape can be asked at points: slope, normal, closest point."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.sdf.base import AbstractSdf, Box, cast
from sorojax.sdf.scalar import quotient, root

Points = Float[Array, "*points dim"]


def bounding_box(shape: AbstractSdf) -> Box:
    """Lower and upper corner [m] of a box that holds the inside of `shape`."""
    return shape.bounding_box()


def gradient(shape: AbstractSdf, p: Points) -> Points:
    """Slope of the field at `p` [-]; at an edge that of one of its sides."""
    return value_and_gradient(shape, real(p))[1]


def value_and_gradient(shape: AbstractSdf, p: Points) -> tuple[Float[Array, "*points"], Points]:
    """Field [m] and slope [-] at `p` by one forward pass per axis."""
    shape = cast(shape, p.dtype)
    f, slopes = value_and_gradient_at(shape, tuple(p[..., i] for i in range(shape.dim)))
    return f, jnp.stack(slopes, axis=-1)


def value_and_gradient_at(
    shape: AbstractSdf, x: tuple[Array, ...]
) -> tuple[Array, tuple[Array, ...]]:
    """Field and slope at separate coordinate arrays."""
    passes = [slope_along(shape, x, i) for i in range(len(x))]
    return passes[0][0], tuple(slope for _, slope in passes)


def slope_along(shape: AbstractSdf, x: tuple[Array, ...], axis: int) -> tuple[Array, Array]:
    """Field and its slope along one axis; the other coordinates take no part in the pass."""

    def along(c):
        return shape.distance(*x[:axis], c, *x[axis + 1 :])

    return jax.jvp(along, (x[axis],), (jnp.ones_like(x[axis]),))


def normal(shape: AbstractSdf, p: Points) -> Points:
    """Outward unit normal of the level set through `p`; zero where the slope is zero."""
    g = gradient(shape, p)
    length = root(jnp.sum(g * g, axis=-1, keepdims=True))
    return quotient(g, length + jnp.zeros_like(g))


def project(shape: AbstractSdf, p: Points) -> Points:
    """Closest point of the surface of `shape` to `p` [m], by Newton's method.

    Steps p <- p - f grad f / |grad f|^2 until the field vanishes; where the field is
    not an exact distance the result is the closest point to first order in the
    distance. Differentiable in the shape and in `p` by the implicit-function rule: a
    point that starts on the surface moves by -(df/dtheta) grad f / |grad f|^2 with a
    parameter theta. Away from the surface of an inexact field the derivative along
    the surface is approximate; at an edge it is that of one of the two sides.

    Args:
        shape: Any shape; `p` should lie within the radius of curvature of its surface.
        p: Points [m].
    """
    p = real(p)
    return _project(cast(shape, p.dtype), p.reshape(-1, p.shape[-1])).reshape(p.shape)


def _newton_point(shape, p):
    f, g = value_and_gradient(shape, p)
    return p - quotient(f, jnp.sum(g * g, axis=-1))[..., None] * g


@eqx.filter_custom_jvp
def _project(shape: AbstractSdf, p: Float[Array, "points dim"]) -> Float[Array, "points dim"]:
    tiny = 4 * jnp.finfo(p.dtype).eps

    def descend(state):
        x, _, count = state
        new = _newton_point(shape, x)
        far = jnp.max(jnp.abs(new - x)) > tiny * jnp.max(jnp.abs(x))
        return new, far, count + 1

    start = (p, jnp.array(p.size > 0), 0)
    return jax.lax.while_loop(lambda s: s[1] & (s[2] < 30), descend, start)[0]


@_project.def_jvp
def _project_jvp(primals, tangents):
    shape, p = primals
    shape_dot, p_dot = tangents
    x = _project(shape, p)
    # One derivative for both places: the field is compiled once.
    both = jnp.concatenate([x, p])
    if p_dot is None:
        p_dot = jnp.zeros_like(p)
    both_dot = jnp.concatenate([jnp.zeros_like(x), p_dot])
    f, g = value_and_gradient(shape, both)
    f_dot, g_dot = shape_tangent(
        lambda a: value_and_gradient(*a), (shape, both), (shape_dot, both_dot)
    )
    # Across the surface: it stays on the zero set.
    n = len(p)
    square = jnp.sum(g * g, axis=1)
    normal = g[:n]
    across = -quotient(f_dot[:n], square[:n])[:, None] * normal
    # Along the surface: as one Newton step does, which is all an exact distance needs.
    f, g, f_dot, g_dot, square_p = f[n:], g[n:], f_dot[n:], g_dot[n:], square[n:]
    step = quotient(f, square_p)
    step_dot = quotient(f_dot - 2 * step * jnp.sum(g * g_dot, axis=1), square_p)
    along = p_dot - step_dot[:, None] * g - step[:, None] * g_dot
    slip = quotient(jnp.sum(along * normal, axis=1), square[:n])
    return x, across + along - slip[:, None] * normal


def shape_tangent(function, shape: Any, shape_dot: Any):
    """Directional derivative of `function(shape)` along `shape_dot` (None: fixed leaf)."""
    if all(dot is None for dot in jax.tree.leaves(shape_dot, is_leaf=lambda d: d is None)):
        return jax.tree.map(jnp.zeros_like, function(shape))
    moving = jax.tree.map(lambda dot: dot is not None, shape_dot, is_leaf=lambda d: d is None)
    varied, held = eqx.partition(shape, moving)
    _, dots = jax.jvp(lambda s: function(eqx.combine(s, held)), (varied,), (shape_dot,))
    return dots
