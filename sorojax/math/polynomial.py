"""Polynomials of a few given coefficients."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float


def polynomial(
    coefficients: Sequence[float], x: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Sum of `coefficients[k] * x**k`, by Horner's rule."""
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value
