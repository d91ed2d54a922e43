"""Scalar building blocks whose first and second derivatives are finite everywhere.

`where` picks one branch at a tie, so a gradient there is one-sided instead of an
average of two, and it is several times faster than `maximum` on a CPU.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, "..."]


def minimum(a: Scalar, b: Scalar) -> Scalar:
    return jnp.where(a <= b, a, b)


def maximum(a: Scalar, b: Scalar) -> Scalar:
    return jnp.where(a >= b, a, b)


def absolute(a: Scalar) -> Scalar:
    return jnp.where(a < 0, -a, a)


def positive_part(a: Scalar) -> Scalar:
    return jnp.where(a > 0, a, jnp.zeros_like(a))


def root(square: Scalar) -> Scalar:
    """sqrt(square), with zero slope instead of infinity at zero."""
    # The branch not taken is differentiated too, so it must stay finite at zero.
    above = square > 0
    safe = jnp.where(above, square, jnp.ones_like(square))
    return jnp.where(above, jnp.sqrt(safe), jnp.zeros_like(square))


def norm(*components: Scalar) -> Scalar:
    """Euclidean length of the vector of `components`; its slope at zero is zero."""
    return root(sum((c * c for c in components[1:]), start=components[0] ** 2))


def quotient(a: Scalar, b: Scalar) -> Scalar:
    """a / b, and zero where b is zero."""
    safe = jnp.where(b == 0, jnp.ones_like(b), b)
    return jnp.where(b == 0, jnp.zeros_like(a), a / safe)
