"""Area, centroid and second moments of plane shapes, differentiable in their parameters."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.moments import Rule, frame, moments
from sorojax.sdf.solid_measure import middle_of_mass, solid_centroid

_CELLS = 512  # along the longest side; halved eight times at corners and narrow gaps


def area(shape: AbstractSdf) -> Float[Array, ""]:
    """Area [m^2] of a plane shape, differentiable in its parameters.

    Counted by cells that the boundary cuts; the derivative is that of the counted number.
    The shape must be concrete: use it outside `jit` (`jax.grad` and `jax.jvp` are fine).

    Raises:
        ValueError: If the shape is empty, unbounded or traced by `jit`.
    """
    m = moments(shape, _rule("area", shape, 0))
    return frame(shape, _CELLS)[1] ** 2 * m[0]


def centroid(shape: AbstractSdf) -> Float[Array, " dim"]:
    """Centroid [m] of a shape, differentiable as `area` and, in space, `volume` are."""
    if shape.dim == 3:
        return solid_centroid(shape)
    m = moments(shape, _rule("centroid", shape, 1))
    return middle_of_mass(m, *frame(shape, _CELLS))


def second_moments(shape: AbstractSdf) -> Float[Array, "2 2"]:
    """Integral of r r^T over a plane shape, r from its centroid [m^4], as `area` is.

    Entry (0, 0) is that of x^2, which resists bending in x; the trace is the polar moment.
    """
    m = moments(shape, _rule("second_moments", shape, 2))
    return _second(m, frame(shape, _CELLS)[1])


@jax.jit
def _second(m: Float[Array, "6"], size: Float[Array, ""]) -> Float[Array, "2 2"]:
    """About the centroid [m^4], from moments in cells of `size` [m]."""
    xx, yy, xy = m[3:] - jnp.stack([m[1] * m[1], m[2] * m[2], m[1] * m[2]]) / m[0]
    return size**4 * jnp.stack([xx, xy, xy, yy]).reshape(2, 2)


def _rule(where: str, shape: AbstractSdf, order: int) -> Rule:
    if shape.dim != 2:
        raise ValueError(
            f"{where}: the shape is {shape.dim}-D, need 2-D. Use sdf.volume, sdf.centroid and "
            "sdf.inertia_tensor for solids."
        )
    return Rule(where, _CELLS, order)
