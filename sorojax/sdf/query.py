"""What a shape can be asked at points: slope, normal, closest point."""

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


def value_and_gradient(
    shape: AbstractSdf, p: Points
) -> tuple[Float[Array, "*points"], Points]:
    """Field [m] and slope [-] at `p` by one forward pass per axis."""
    shape = cast(shape, p.dtype)
    x = tuple(p[..., i] for i in range(shape.dim))
    one, zero = jnp.ones_like(x[0]), jnp.zeros_like(x[0])
    passes = [
        jax.jvp(shape.distance, x, tuple(one if i == j else zero for j in range(len(x))))
        for i in range(len(x))
    ]
    return passes[0][0], jnp.stack([slope for _, slope in passes], axis=-1)


def normal(shape: AbstractSdf, p: Points) -> Points:
    """Outward unit normal of the level set through `p`; zero where the slope is zero."""
    g = gradient(shape, p)
    length = root(jnp.sum(g * g, axis=-1, keepdims=True))
    return quotient(g, length + jnp.zeros_like(g))


def project(shape: AbstractSdf, p: Points) -> Points:
    """Closest point of the surface of `shape` to `p` [m], by Newton's method.

    Differentiable in the shape and in `p` by the implicit-function rule, exactly
    where the surface is smooth; a point that starts on the surface moves by
    -(df/dtheta) grad f / |grad f|^2 with a parameter theta. At an edge the derivative
    is that of one of the two sides.

    Args:
        shape: Any shape; `p` should lie within the radius of curvature of its surface.
        p: Points [m].
    """
    p = real(p)
    flat = p.reshape(-1, p.shape[-1])
    return jax.vmap(_project_one, (None, 0))(cast(shape, p.dtype), flat).reshape(p.shape)


def _hessian(shape: AbstractSdf, p: Float[Array, " dim"]) -> Float[Array, "dim dim"]:
    return jax.jacfwd(lambda q: value_and_gradient(shape, q)[1])(p)


def _foot_system(shape, p, x):
    """Matrix and residual of x + lam grad f(x) = p, f(x) = 0, and its lam."""
    f, g = value_and_gradient(shape, x)
    lam = quotient(jnp.sum((p - x) * g), jnp.sum(g * g))
    eye = jnp.eye(x.size, dtype=x.dtype)
    upper = jnp.concatenate([eye + lam * _hessian(shape, x), g[:, None]], axis=1)
    lower = jnp.concatenate([g, jnp.zeros_like(g[:1])])[None]
    residual = jnp.concatenate([x + lam * g - p, f[None]])
    return jnp.concatenate([upper, lower]), residual, lam


@eqx.filter_custom_jvp
def _project_one(shape: AbstractSdf, p: Float[Array, " dim"]) -> Float[Array, " dim"]:
    tiny = 4 * jnp.finfo(p.dtype).eps

    def descend(state):
        x, _, count = state
        f, g = value_and_gradient(shape, x)
        dx = -quotient(f, jnp.sum(g * g)) * g
        size = jnp.max(jnp.abs(x)) + jnp.max(jnp.abs(p))
        return x + dx, jnp.max(jnp.abs(dx)) > tiny * size, count + 1

    x, _, _ = jax.lax.while_loop(
        lambda state: state[1] & (state[2] < 30), descend, (p, jnp.array(True), 0)
    )

    def straighten(_, x):
        matrix, before, _ = _foot_system(shape, p, x)
        new = x - jnp.linalg.solve(matrix, before)[: p.size]
        after = _foot_system(shape, p, new)[1]
        # Fields that are exact distances are there already; others gain a closest point.
        better = jnp.sum(after**2) < jnp.sum(before**2)
        return jnp.where(better, new, x)

    return jax.lax.fori_loop(0, 4, straighten, x)


@_project_one.def_jvp
def _project_one_jvp(primals, tangents):
    shape, p = primals
    shape_dot, p_dot = tangents
    x = _project_one(shape, p)
    matrix, _, lam = _foot_system(shape, p, x)

    def field(shape):
        return value_and_gradient(shape, x)

    f_dot, g_dot = _shape_tangent(field, shape, shape_dot)
    p_dot = jnp.zeros_like(p) if p_dot is None else p_dot
    rhs = jnp.concatenate([p_dot - lam * g_dot, -f_dot[None]])
    return x, jnp.linalg.solve(matrix, rhs)[: p.size]


def _shape_tangent(function, shape: AbstractSdf, shape_dot):
    """Directional derivative of `function(shape)` along `shape_dot` (None: fixed leaf)."""
    moving = jax.tree.map(lambda dot: dot is not None, shape_dot, is_leaf=lambda d: d is None)
    varied, held = eqx.partition(shape, moving)
    _, dots = jax.jvp(lambda s: function(eqx.combine(s, held)), (varied,), (shape_dot,))
    return dots
