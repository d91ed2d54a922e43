"""Cosine and sine of one angle together, by polynomials of the rest of a quarter turn."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Taylor coefficients: below pi/4 the first term left out is 2e-17.
_SINE = [(-1.0) ** k / float(np.prod(np.arange(1.0, 2 * k + 2))) for k in range(9)]
_COSINE = [(-1.0) ** k / float(np.prod(np.arange(1.0, 2 * k + 1))) for k in range(9)]
# pi/2 in parts of 33 bits, so that multiples of up to a million are exact
_PARTS = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)


@jax.custom_jvp
def cosine_and_sine(
    angle: Float[Array, "*shape"],
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Both to 3e-16 for angles [rad] of up to 1e5; a few operations on all of them, where a
    library is called for each otherwise.

    Reference:
        Cody and Waite, Software Manual for the Elementary Functions, 1980.
    """
    if angle.dtype != jnp.float64:
        return jnp.cos(angle), jnp.sin(angle)
    turns = jnp.round(angle * (2 / np.pi))
    rest = angle
    for part in _PARTS:
        rest = rest - turns * part
    square = rest * rest
    sine, cosine = rest * _polynomial(_SINE, square), _polynomial(_COSINE, square)
    quarter = turns - 4 * jnp.floor(turns / 4)
    odd = (quarter == 1) | (quarter == 3)
    first, second = jnp.where(odd, sine, cosine), jnp.where(odd, cosine, sine)
    return (
        jnp.where((quarter == 1) | (quarter == 2), -first, first),
        jnp.where(quarter >= 2, -second, second),
    )


def _polynomial(coefficients: list[float], x: Array) -> Array:
    value = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


@cosine_and_sine.defjvp
def _(primals, tangents):
    cosine, sine = cosine_and_sine(*primals)
    (rate,) = tangents
    return (cosine, sine), (-sine * rate, cosine * rate)
