"""Sums of powers of the principal values of C, smooth where they coincide.

With b half the exponent of a stretch, sum_i x_i^b over the eigenvalues x_i of the
isochoric C is an analytic function of its invariants, although no single eigenvalue is.
It is Cauchy's integral of z^b p'(z)/p(z) with p the characteristic polynomial, taken by
the trapezoidal rule on an ellipse in the plane of log z. No eigenvalue is computed, all
derivatives are finite and right, and the error falls geometrically with the nodes:
rounding for stretches up to 10 in tension and 5 in equibiaxial tension.

Reference: Hale, Higham & Trefethen, SIAM J. Numer. Anal. 46, 2008.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from sorojax.material.kinematics import (
    Entry,
    Tensor,
    determinant,
    is_planar,
    isochoric_first_invariant,
    isochoric_second_invariant,
    minus,
    square_norm,
    times,
)

NODES = 40  # on half the contour, the other half is its mirror image


def stretch_power_sums(F: Tensor, halves: tuple[Entry, ...]) -> list[Entry]:
    """sum_i x_i^b over the eigenvalues of the isochoric C, for every b in `halves`."""
    return _planar(F, halves) if is_planar(F) else _spatial(F, halves)


def _planar(F: Tensor, halves) -> list[Entry]:
    """The third direction is principal, the polynomial that of the other two."""
    (a, b, _), (c, d, _), (_, _, across) = F
    log_J = jnp.log(determinant(F))
    shrink = jnp.exp(-2 / 3 * log_J)
    trace = shrink * square_norm(((a, b, 0.0), (c, d, 0.0), (0.0, 0.0, 0.0)))
    area = (shrink * minus(times(a, d), times(b, c))) ** 2
    log_third = 2 * jnp.log(jnp.asarray(across, log_J.dtype)) - 2 / 3 * log_J

    def ratio(z):
        T, D = _complex(trace), _complex(area)
        return (2 * z - T) / ((z - T) * z + D)

    pair = _contour_sums(area / trace, trace, ratio, halves)
    return [jnp.exp(b * log_third) + two for b, two in zip(halves, pair, strict=True)]


def _spatial(F: Tensor, halves) -> list[Entry]:
    first, second = isochoric_first_invariant(F), isochoric_second_invariant(F)

    def ratio(z):
        I1, I2 = _complex(first), _complex(second)
        return ((3 * z - 2 * I1) * z + I2) / (((z - I1) * z + I2) * z - 1)

    return _contour_sums(1 / second, first, ratio, halves)


def _complex(x: Entry) -> Entry:
    return jax.lax.complex(x, jnp.zeros_like(x))


def _contour_sums(
    lowest: Entry, highest: Entry, ratio: Callable[[Entry], Entry], halves
) -> list[Entry]:
    """sum_i x_i^b of the poles of `ratio`, all of them between `lowest` and `highest`."""
    # the value does not depend on the contour, so no derivative passes through it
    low, high = jax.lax.stop_gradient((jnp.log(lowest), jnp.log(highest)))
    centre, reach = (low + high) / 2, (high - low) / 2
    # half way, in confocal ellipses, from the poles to their copies at 2 pi i
    height = jnp.arcsinh(2 * math.pi / reach) / 2
    wide, tall = reach * jnp.cosh(height), reach * jnp.sinh(height)

    def at(cosine, sine):
        log = jax.lax.complex(centre + wide * cosine, tall * sine)
        z = jnp.exp(log)
        turn = z * jax.lax.complex(-wide * sine, tall * cosine) * ratio(z)
        powers = [jnp.exp(jax.lax.complex(b * log.real, b * log.imag)) for b in halves]
        return [jnp.imag(power * turn) for power in powers]

    angles = (np.arange(NODES) + 0.5) * (math.pi / NODES)
    dtype = jnp.result_type(centre)
    nodes = jnp.asarray(np.cos(angles), dtype), jnp.asarray(np.sin(angles), dtype)
    return [jnp.sum(values, axis=0) / NODES for values in jax.vmap(at)(*nodes)]
