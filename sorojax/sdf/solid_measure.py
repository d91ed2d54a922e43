"""Volume, centroid and inertia of solid shapes, differentiable in their parameters.

Smooth shapes: six-node triangles on the surface, of fourth order in the cell. Shapes with
edges: triangles of dual contouring at two cell sizes, extrapolated. The derivative is that
of the shape: d/dt of the integral of g is that of -g (df/dt)/|grad f| over the surface.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.blocks import active_blocks, grid_around
from sorojax.sdf.dual_contouring import dual_contouring
from sorojax.sdf.isosurface import Surface, isosurface
from sorojax.sdf.query import shape_tangent
from sorojax.sdf.sample import finite_box, values_and_gradients
from sorojax.sdf.six_node import integrate, monomials, nodes

_SHARP = 0.6  # rad between neighbours on a surface that has an edge


def volume(shape: AbstractSdf, resolution: int = 128) -> Float[Array, ""]:
    """Volume [m^3] of a solid shape, differentiable in its parameters.

    The shape must be concrete: use it outside `jit` (`jax.grad` and `jax.jvp` are fine).

    Args:
        shape: A bounded solid shape.
        resolution: Cells along the longest side of its bounding box.

    Raises:
        ValueError: If the shape is empty, unbounded or traced by `jit`.
    """
    return _moments(shape, _even("volume", resolution))[0]


def solid_centroid(shape: AbstractSdf, resolution: int = 128) -> Float[Array, "3"]:
    """Centroid [m] of a solid shape, differentiable as `volume` is."""
    moments = _moments(shape, _even("centroid", resolution))
    return moments[1:4] / moments[0]


def inertia_tensor(
    shape: AbstractSdf, density: Any = 1.0, resolution: int = 128
) -> Float[Array, "3 3"]:
    """Moments of inertia [kg m^2] about the centroid, differentiable as `volume` is.

    Args:
        shape: A bounded solid shape.
        density: Mass per volume [kg/m^3].
        resolution: Cells along the longest side of its bounding box.
    """
    m = _moments(shape, _even("inertia_tensor", resolution))
    c = m[1:4] / m[0]
    xx, yy, zz, xy, yz, zx = m[4:]
    second = jnp.stack([xx, xy, zx, xy, yy, yz, zx, yz, zz]).reshape(3, 3)
    second = second - m[0] * c[:, None] * c[None, :]
    identity = jnp.eye(3, dtype=m.dtype)
    return real(density) * (jnp.trace(second) * identity - second)


def _even(where: str, resolution: int) -> int:
    if resolution < 8:
        raise ValueError(f"{where}: `resolution` is {resolution} cells, need at least 8.")
    return int(resolution)


@eqx.filter_custom_jvp
def _moments(shape: AbstractSdf, resolution: int) -> Float[Array, "10"]:
    return jnp.asarray(_integrate(shape, resolution)[0], dtype=jnp.result_type(float))


@_moments.def_jvp
def _moments_jvp(primals, tangents):
    shape, resolution = primals
    moments, points, areas = _integrate(shape, resolution)
    slope = np.sqrt((values_and_gradients(shape, points)[1] ** 2).sum(axis=1))
    dtype = jnp.result_type(float)
    p = jnp.asarray(points, dtype=dtype)
    f_dot = shape_tangent(lambda s: s(p), shape, tangents[0])
    weight = monomials(points) * (areas / np.maximum(slope, 1e-12))
    return jnp.asarray(moments, dtype=dtype), -jnp.asarray(weight, dtype=dtype) @ f_dot


def _integrate(
    shape: AbstractSdf, resolution: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Moments about the origin, points of the surface and the area that each stands for."""
    lower, upper = finite_box("volume", shape, 3)
    size, middle = float((upper - lower).max()) / resolution, (lower + upper) / 2
    surface = isosurface(shape, size)
    if not _has_edges(shape, surface):
        return _about_origin(nodes(surface, shape), middle)
    coarse, fine = (
        _about_origin(nodes(_with_corners(shape, h)), middle) for h in (2 * size, size)
    )
    # The error is of second order in the cell: one extrapolation takes most of it away.
    return (
        (4 * fine[0] - coarse[0]) / 3,
        np.concatenate([fine[1], coarse[1]]),
        np.concatenate([4 / 3 * fine[2], -1 / 3 * coarse[2]]),
    )


def _with_corners(shape: AbstractSdf, size: float) -> Surface:
    """Dual contouring whose vertices may leave their cells by half: no edge is cut off."""
    grid = grid_around("volume", shape, size)
    blocks = active_blocks("volume", shape, grid)
    return Surface(*dual_contouring(shape, grid, blocks, margin=-0.5))


def _has_edges(shape: AbstractSdf, surface: Surface) -> bool:
    g = values_and_gradients(shape, surface.vertices)[1]
    normal = g / np.maximum(np.sqrt((g * g).sum(axis=1, keepdims=True)), 1e-12)
    t = surface.triangles
    return any(
        np.any((normal[t[:, i]] * normal[t[:, j]]).sum(axis=1) < np.cos(_SHARP))
        for i, j in ((0, 1), (1, 2), (2, 0))
    )


def _about_origin(six: list[np.ndarray], middle: np.ndarray):
    """Moments taken about `middle`, where they lose no digits, then moved to the origin."""
    m, points, areas = integrate([node - middle for node in six])
    x, y, z = middle
    volume, (a, b, c) = m[0], m[1:4]
    shift = [
        2 * x * a + x * x * volume, 2 * y * b + y * y * volume, 2 * z * c + z * z * volume,
        x * b + y * a + x * y * volume, y * c + z * b + y * z * volume,
        z * a + x * c + z * x * volume,
    ]  # fmt: skip
    moved = np.concatenate([[volume], m[1:4] + volume * middle, m[4:] + shift])
    return moved, points + middle, areas
