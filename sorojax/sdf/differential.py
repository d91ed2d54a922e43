"""Local geometry of level sets: tangent frames, curvature, the closest point."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.sdf.base import AbstractSdf, cast
from sorojax.sdf.query import Points, normal, project, shape_tangent, value_and_gradient
from sorojax.sdf.scalar import quotient, root

_STEPS = 12


def frame(shape: AbstractSdf, p: Points) -> Float[Array, "*points dim dim"]:
    """Orthonormal frame at `p`: rows are the outward normal, then the tangents.

    In the plane the tangent keeps the inside on its left; in space the two tangents
    follow a branch that jumps only where the normal is along -z.
    """
    n = normal(shape, p)
    if shape.dim == 2:
        return jnp.stack([n, jnp.stack([-n[..., 1], n[..., 0]], axis=-1)], axis=-2)
    x, y, z = n[..., 0], n[..., 1], n[..., 2]
    # Duff et al., Building an orthonormal basis, revisited, JCGT 2017.
    sign = jnp.where(z < 0, -1, 1).astype(n.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = jnp.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    second = jnp.stack([b, sign + y * y * a, -y], axis=-1)
    return jnp.stack([n, first, second], axis=-2)


def hessian(shape: AbstractSdf, p: Points) -> Float[Array, "*points dim dim"]:
    """Second derivatives of the field at `p` [1/m]."""
    p = real(p)
    columns = []
    for i in range(shape.dim):
        direction = jnp.zeros_like(p).at[..., i].set(1)
        _, dot = jax.jvp(lambda p: value_and_gradient(shape, p)[1], (p,), (direction,))
        columns.append(dot)
    return jnp.stack(columns, axis=-1)


def curvature(shape: AbstractSdf, p: Points) -> Float[Array, "*points"]:
    """Signed curvature of a plane level set, or mean curvature in space [1/m].

    Positive where the shape is convex: 1/r for a circle and for a sphere.
    """
    return _divergence(shape, real(p)) / (shape.dim - 1)


def gaussian_curvature(shape: AbstractSdf, p: Points) -> Float[Array, "*points"]:
    """Product of the principal curvatures of a level set in space [1/m^2]."""
    if shape.dim != 3:
        raise ValueError(
            f"gaussian_curvature: the shape is {shape.dim}-D, need 3-D. Use `curvature` in "
            "the plane."
        )
    p = real(p)
    _, g = value_and_gradient(shape, p)
    h = hessian(shape, p)
    rows = [h[..., i, :] for i in range(3)]
    adjugate = jnp.stack(
        [jnp.cross(rows[1], rows[2]), jnp.cross(rows[2], rows[0]), jnp.cross(rows[0], rows[1])],
        axis=-2,
    )
    square = jnp.sum(g * g, axis=-1)
    return quotient(jnp.einsum("...i,...ij,...j->...", g, adjugate, g), square**2)


def _divergence(shape: AbstractSdf, p: Points) -> Float[Array, "*points"]:
    """Divergence of the unit normal: the sum of the principal curvatures."""
    _, g = value_and_gradient(shape, p)
    h = hessian(shape, p)
    square = jnp.sum(g * g, axis=-1)
    across = jnp.einsum("...i,...ij,...j->...", g, h, g)
    trace = jnp.trace(h, axis1=-2, axis2=-1)
    return quotient(square * trace - across, square * root(square))


def closest_point(shape: AbstractSdf, p: Points) -> Points:
    """The point of the surface whose normal runs through `p` [m], also for bounds.

    Newton's method on x - p + m grad f(x) = 0, f(x) = 0 from the point that `project`
    finds; derivatives in the shape and in `p` by the implicit-function rule. The
    surface must be smooth there: at an edge use `project`.

    Args:
        shape: Any shape; `p` should lie within the radius of curvature of its surface.
        p: Points [m].
    """
    p = real(p)
    shape = cast(shape, p.dtype)
    return _closest(shape, p.reshape(-1, p.shape[-1]))[0].reshape(p.shape)


@eqx.filter_custom_jvp
def _closest(shape: AbstractSdf, p: Points) -> tuple[Points, Float[Array, " points"]]:
    """The point x and the multiplier m, by Newton's method."""
    x = project(shape, p)
    g = value_and_gradient(shape, x)[1]
    m = quotient(jnp.sum((p - x) * g, axis=1), jnp.sum(g * g, axis=1))

    def step(_, state):
        x, m = state
        change = _solved(shape, x, m, _residual(shape, p, x, m))
        return x + change[0], m + change[1]

    return jax.lax.fori_loop(0, _STEPS + 1, step, (x, m))


@_closest.def_jvp
def _closest_jvp(primals, tangents):
    shape, p = primals
    shape_dot, p_dot = tangents
    x, m = _closest(shape, p)
    change = shape_tangent(lambda shape: _residual(shape, p, x, m), shape, shape_dot)
    if p_dot is not None:
        change = (change[0] - p_dot, change[1])
    return (x, m), _solved(shape, x, m, change)


def _residual(shape, p, x, m):
    """x - p + m grad f(x) and f(x)."""
    f, g = value_and_gradient(shape, x)
    return x - p + m[:, None] * g, f


def _solved(shape, x, m, residual):
    """The change of x and m that takes a change of the residual back."""
    dim = x.shape[1]
    g = value_and_gradient(shape, x)[1]
    block = jnp.eye(dim, dtype=x.dtype)[None] + m[:, None, None] * hessian(shape, x)
    top = jnp.concatenate([block, g[:, :, None]], axis=2)
    last = jnp.zeros_like(m)[:, None]
    matrix = jnp.concatenate([top, jnp.concatenate([g, last], axis=1)[:, None, :]], axis=1)
    rest = jnp.concatenate([residual[0], residual[1][:, None]], axis=1)
    change = jnp.linalg.solve(matrix, -rest[..., None])[..., 0]
    return change[:, :dim], change[:, dim]
