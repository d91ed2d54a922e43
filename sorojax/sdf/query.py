"""The field of a shape and its geometry at points: gradient, normal, curvature, closest point.

Fields of many points are compiled once per power of two. A field made of scalars becomes one
loop per output, which reads the coordinates and writes the result; normals of rows, and a
field that searches or holds a table per point, go in chunks that stay in the cache.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._jax.jit import once
from sorojax._jax.programs import is_one_loop
from sorojax._types import platform, real
from sorojax.math.compiled import Alone, apart
from sorojax.sdf.base import AbstractSdf, Box, cast, quotient, root

Points = Float[Array, "*points dim"]


def bounding_box(shape: AbstractSdf) -> Box:
    """Lower and upper corner [m] of a box that holds the inside of `shape`.

    Args:
        shape: The shape.

    Returns:
        Lower and upper corner [m].
    """
    return shape.bounding_box()


def gradient(shape: AbstractSdf, p: Points) -> Points:
    """Gradient of the signed distance, by one forward-mode derivative per axis.

    It points out of the shape and has length one where the field is the exact distance. At an
    edge, where the field has no gradient, it is that of one of the sides.

    Args:
        shape: Any shape; may be traced.
        p: Points [m], any number of leading axes.

    Returns:
        The gradient [-] at each point.

    Example:
        >>> disc = sdf.Circle([0, 0], 10 * mm)
        >>> slope = sdf.gradient(disc, jnp.array([30 * mm, 40 * mm]))
        >>> print(f"{float(slope[0]):.3f} {float(slope[1]):.3f}")
        0.600 0.800
    """
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
    """Outward unit normal of the level set through `p`; zero where the slope is zero.

    Args:
        shape: The shape.
        p: Points [m].

    Returns:
        Unit vectors.
    """
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

    Returns:
        Points on the surface [m].
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


# Fields of many points at full speed: compiled once per power of two


LARGEST = 2**20  # points in one call of a compiled program
_CHUNK = 2**13  # points of a field that is more than one loop
_WIDE = 2**16  # rows whose columns and slopes are held at a time

Coordinates = tuple[Float[Array, " points"], ...]


def evaluate(shape: AbstractSdf, points: Float[Array, "points dim"]) -> Float[Array, " points"]:
    """Field [m] at many `points` [m]: as `shape(points)`, compiled once for any number.

    The number is padded to a power of two; above 2^20 points come in blocks.

    Args:
        shape: The shape.
        points: Points [m].

    Returns:
        Signed distances [m].
    """
    return _blocks(_value, shape, _checked(shape, points))


def value_and_normal(
    shape: AbstractSdf, points: Float[Array, "points dim"]
) -> tuple[Float[Array, " points"], Float[Array, "points dim"]]:
    """Field [m] and unit normal at many `points` [m], as `evaluate`.

    Args:
        shape: The shape.
        points: Points [m].

    Returns:
        Signed distances [m], and unit vectors.
    """
    return _blocks(_value_and_normal, shape, _checked(shape, points))


def value_and_normal_at(
    shape: AbstractSdf, x: Coordinates
) -> tuple[Float[Array, " points"], Coordinates]:
    """As `value_and_normal` on one array per coordinate, which saves to rearrange them."""
    x = tuple(real(c) for c in x)
    if len(x) != shape.dim or any(c.ndim != 1 or c.shape != x[0].shape for c in x):
        raise ValueError(
            f"value_and_normal_at: got arrays of shape {[c.shape for c in x]}, need "
            f"{shape.dim} of one length. Give one array per coordinate."
        )
    return _blocks(_normals, shape, x)


def _checked(shape: AbstractSdf, points) -> Float[Array, "points dim"]:
    points = real(points)
    if points.ndim != 2 or points.shape[1] != shape.dim:
        raise ValueError(
            f"evaluate: points have shape {points.shape}, need (points, {shape.dim}). "
            "Reshape them to one row per point."
        )
    return points


def _blocks(kernel, shape: AbstractSdf, points):
    """`kernel(shape, points)` on padded blocks of `points`, an array or one per axis."""
    count = len(jax.tree.leaves(points)[0])
    if count and count == min(_padded(count), LARGEST):
        return kernel(shape, points)
    found = []
    for start in range(0, max(count, 1), LARGEST):
        true = min(LARGEST, count - start)
        piece = jax.tree.map(lambda a, start=start: _fill(a[start : start + LARGEST]), points)
        found.append(jax.tree.map(lambda a, true=true: a[:true], kernel(shape, piece)))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *found)


def _padded(count: int) -> int:
    return 1 << max(0, count - 1).bit_length()


def _fill(piece: Array) -> Array:
    """`piece` up to a power of two, with copies of its last row (zeros where it has none)."""
    rest = [(0, _padded(len(piece)) - len(piece))] + [(0, 0)] * (piece.ndim - 1)
    return jnp.pad(piece, rest, mode="edge" if len(piece) else "constant")


def _is_one_loop(shape: AbstractSdf, x: Coordinates) -> bool:
    """Whether the field is made of scalars alone: no search, no table of a row per point."""
    return is_one_loop(shape.distance, *x)


def _in_chunks(function, points, width: int):
    """`function(points)` at most `width` points at a time."""
    count = len(jax.tree.leaves(points)[0])
    pieces = jax.tree.map(lambda a: a.reshape(-1, min(width, count), *a.shape[1:]), points)
    found = jax.lax.map(function, pieces)
    return jax.tree.map(lambda a: a.reshape(count, *a.shape[2:]), found)


def _in_small_chunks(function, x: Coordinates):
    """For fields of more than one loop; coordinates apart are contiguous, which is fast."""
    return _in_chunks(function, jax.lax.optimization_barrier(x), _CHUNK)


@once
def _value(shape: AbstractSdf, points):
    shape = cast(shape, points.dtype)
    x = tuple(points[:, i] for i in range(shape.dim))
    if _is_one_loop(shape, x):
        return shape.distance(*x)
    return _in_small_chunks(lambda x: shape.distance(*x), x)


def _value_and_normal(shape: AbstractSdf, points):
    return _rows(shape, points, np.True_)


@once
def _rows(shape: AbstractSdf, points, always):
    """Field and normals of rows, a chunk at a time: columns and slopes stay in the cache, and
    results alone are new memory, whose first touch costs as much as the arithmetic."""
    shape = cast(shape, points.dtype)
    alone: Alone = apart(always) if platform() == "cpu" else lambda work: work()
    one_loop = _is_one_loop(shape, tuple(points.T))

    def chunk(points):
        x = alone(lambda: tuple(points.T))
        if one_loop:
            f = alone(lambda: shape.distance(*x))
            slopes = tuple(
                alone(lambda i=i: slope_along(shape, x, i)[1]) for i in range(shape.dim)
            )
        else:
            f, slopes = value_and_gradient_at(shape, x)
        scale = alone(lambda: _unit_scale(slopes))
        return f, alone(lambda: jnp.stack([g * scale for g in slopes], axis=1))

    wide = _WIDE if platform() == "cpu" else len(points)
    return _in_chunks(chunk, points, wide if one_loop else _CHUNK)


def _normals(shape: AbstractSdf, x: Coordinates):
    # Programs of their own: in one, reordering joins their loops, which lose their vector form.
    f, slopes = _value_and_slopes(shape, x)
    return f, _scaled(slopes, _unit_scale(slopes))


@once
def _value_and_slopes(shape: AbstractSdf, x: Coordinates):
    shape = cast(shape, x[0].dtype)
    if not _is_one_loop(shape, x):
        return _in_small_chunks(lambda x: value_and_gradient_at(shape, x), x)
    f, slopes = shape.distance(*x), []
    for i in range(shape.dim):
        # Roots shared by the passes would be written to memory: each has its own.
        x = jax.lax.optimization_barrier(x)
        slopes.append(slope_along(shape, x, i)[1])
    return f, tuple(slopes)


@jax.jit
def _scaled(slopes: Coordinates, scale: Array) -> Coordinates:
    return tuple(g * scale for g in slopes)


@jax.jit
def _unit_scale(slopes: Coordinates) -> Array:
    """One over the length of the vector of `slopes`, zero where that is zero."""
    square = functools.reduce(jnp.add, (g * g for g in slopes))
    some = square > 0
    scale = jax.lax.rsqrt(jnp.where(some, square, jnp.ones_like(square)))
    return jnp.where(some, scale, jnp.zeros_like(square))


# Local geometry of level sets: tangent frames, curvature, the closest point


_STEPS = 12


def frame(shape: AbstractSdf, p: Points) -> Float[Array, "*points dim dim"]:
    """Orthonormal frame at `p`: rows are the outward normal, then the tangents.

    In the plane the tangent keeps the inside on its left; in space the two tangents
    follow a branch that jumps only where the normal is along -z.

    Args:
        shape: The shape.
        p: Points [m].

    Returns:
        One matrix per point.
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
    """Second derivatives of the field at `p` [1/m].

    Args:
        shape: The shape.
        p: Points [m].

    Returns:
        One matrix per point [1/m].
    """
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

    Args:
        shape: The shape.
        p: Points [m].

    Returns:
        Curvature [1/m].
    """
    p = real(p)
    _, g = value_and_gradient(shape, p)
    h = hessian(shape, p)
    square = jnp.sum(g * g, axis=-1)
    across = jnp.einsum("...i,...ij,...j->...", g, h, g)
    trace = jnp.trace(h, axis1=-2, axis2=-1)
    # The divergence of the unit normal is the sum of the principal curvatures.
    return quotient(square * trace - across, square * root(square)) / (shape.dim - 1)


def gaussian_curvature(shape: AbstractSdf, p: Points) -> Float[Array, "*points"]:
    """Product of the principal curvatures of a level set in space [1/m^2].

    Args:
        shape: A solid.
        p: Points [m].

    Returns:
        Curvature [1/m^2].
    """
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


def closest_point(shape: AbstractSdf, p: Points) -> Points:
    """The point of the surface whose normal runs through `p` [m], also for bounds.

    Newton's method on x - p + m grad f(x) = 0, f(x) = 0 from the point that `project`
    finds; derivatives in the shape and in `p` by the implicit-function rule. The
    surface must be smooth there: at an edge use `project`.

    Args:
        shape: Any shape; `p` should lie within the radius of curvature of its surface.
        p: Points [m].

    Returns:
        Points on the surface [m].
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
