"""Sine and cosine by polynomials of what is left of an angle beside its quarter turns.

Reference: Cody, Waite, "Software Manual for the Elementary Functions", 1980, chapter 8.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Taylor coefficients: up to pi/4 the first term left out is 2e-17.
_SINE = [(-1.0) ** k / float(np.prod(np.arange(1.0, 2 * k + 2))) for k in range(9)]
_COSINE = [(-1.0) ** k / float(np.prod(np.arange(1.0, 2 * k + 1))) for k in range(9)]
# pi/2 in parts of 33 bits, so that multiples of up to a million are exact
_PARTS = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)


def sine(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """To 3e-16 up to 1e5 rad, beyond that of an angle with a relative error of 1e-16; a few
    operations on all entries, where a library is called for each otherwise."""
    return _of_quarter(*_reduced(angle))


def cosine(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """As `sine`, and by the same numbers."""
    turns, rest = _reduced(angle)
    return _of_quarter(turns + 1, rest)


def _reduced(angle: Array) -> tuple[Array, Array]:
    """Nearest number of quarter turns, and the angle left."""
    turns = jnp.round(angle * (2 / np.pi))
    rest = angle
    for part in _PARTS:
        rest = rest - turns * part
    return turns, jnp.clip(rest, -1.0, 1.0)


def _of_quarter(turns: Array, rest: Array) -> Array:
    """Sine of `turns` quarter turns and `rest`."""
    square = rest * rest
    quarter = turns - 4 * jnp.floor(turns / 4)
    odd = (quarter == 1) | (quarter == 3)
    size = jnp.where(odd, _polynomial(_COSINE, square), rest * _polynomial(_SINE, square))
    return jnp.where(quarter >= 2, -size, size)


def _polynomial(coefficients: Sequence[float], x: Array) -> Array:
    """Sum of `coefficients[k] * x**k`, by Horner's rule."""
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value
