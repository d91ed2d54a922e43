"""Local geometry of level sets: tangent frames, curvature, the closest point."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.sdf.base import AbstractSdf, cast
from sorojax.sdf.query import Points, normal, project, value_and_gradient
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
    flat = p.reshape(-1, p.shape[-1])
    held_shape, held = jax.lax.stop_gradient((shape, flat))
    x = project(held_shape, held)
    g = value_and_gradient(held_shape, x)[1]
    m = quotient(jnp.sum((held - x) * g, axis=1), jnp.sum(g * g, axis=1))

    def step(_, state):
        return _newton(held_shape, held, *state)

    x, m = jax.lax.fori_loop(0, _STEPS, step, (x, m))
    x, m = jax.lax.stop_gradient((x, m))
    return _newton(shape, flat, x, m)[0].reshape(p.shape)


def _newton(shape, p, x, m):
    """One step for the closest point x and its multiplier m; the matrix is held fixed."""
    dim = x.shape[1]
    f, g = value_and_gradient(shape, x)
    held, slope = jax.lax.stop_gradient((shape, g))
    block = jnp.eye(dim, dtype=x.dtype)[None] + m[:, None, None] * hessian(held, x)
    top = jnp.concatenate([block, slope[:, :, None]], axis=2)
    bottom = jnp.concatenate([slope, jnp.zeros_like(f)[:, None]], axis=1)
    matrix = jnp.concatenate([top, bottom[:, None, :]], axis=1)
    rest = jnp.concatenate([x - p + m[:, None] * g, f[:, None]], axis=1)
    move = jnp.linalg.solve(jax.lax.stop_gradient(matrix), rest[..., None])[..., 0]
    return x - move[:, :dim], m - move[:, dim]
