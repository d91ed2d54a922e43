"""Isotropic rubbers in the invariants of the isochoric deformation.

Every energy splits as Psi = W(I1_bar, I2_bar) + K U(J) with the physical bulk modulus K;
`volumetric` chooses U, (J - 1)^2 / 2 by default. `Ogden` needs sums of powers of the principal
stretches: with b half the exponent, sum_i x_i^b over the eigenvalues x_i of the isochoric C is
an analytic function of its invariants, although no single eigenvalue is. It is Cauchy's
integral of z^b p'(z)/p(z) with p the characteristic polynomial, taken by the trapezoidal rule
on an ellipse in the plane of log z. All derivatives are finite and right, also where
eigenvalues coincide, and the error falls geometrically with the nodes: rounding for stretches
up to 10 in tension and 5 in equibiaxial tension.

Reference: Hale, Higham & Trefethen, SIAM J. Numer. Anal. 46, 2008.
"""

import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.material import checks
from sorojax.material.hyperelastic import (
    AbstractHyperelastic,
    AbstractRubber,
    AbstractVolumetricLaw,
    Quadratic,
    bulk_modulus,
)
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

GENT_LIMIT = 0.99  # share of the locking strain measure where the continuation begins


class NeoHookean(AbstractRubber):
    """Psi = mu/2 (I1_bar - 3) + K U(J); `shear_modulus` mu and `bulk_modulus` K in Pa,
    `density` in kg/m^3."""

    shear_modulus: Float[Array, "..."] = eqx.field(converter=real)
    bulk_modulus: Float[Array, "..."] = eqx.field(converter=real)
    density: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)
    volumetric: AbstractVolumetricLaw = Quadratic()

    def __check_init__(self):
        checks.moduli("NeoHookean", self, self.shear_modulus, self.bulk_modulus, self.density)

    def first_invariant_energy(self, x: Entry) -> Entry:
        return self.shear_modulus / 2 * x

    def isochoric_energy(self, F: Tensor) -> Entry:
        return self.first_invariant_energy(isochoric_first_invariant(F) - 3)


class MooneyRivlin(AbstractRubber):
    """Psi = c10 (I1_bar - 3) + c01 (I2_bar - 3) + K U(J).

    `c10`, `c01` and `bulk_modulus` K are in Pa, `density` in kg/m^3. The small-strain shear
    modulus is 2 (c10 + c01). A negative c01 is unstable in
    equibiaxial tension: see `drucker_stability`.

    Reference: Rivlin & Saunders, Phil. Trans. R. Soc. A 243, 1951.
    """

    c10: Float[Array, "..."] = eqx.field(converter=real)
    c01: Float[Array, "..."] = eqx.field(converter=real)
    bulk_modulus: Float[Array, "..."] = eqx.field(converter=real)
    density: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)
    volumetric: AbstractVolumetricLaw = Quadratic()

    def __check_init__(self):
        checks.leaves("MooneyRivlin", self)
        checks.finite("MooneyRivlin", c10=self.c10, c01=self.c01)
        shear = 2 * (self.c10 + self.c01)
        checks.moduli("MooneyRivlin", self, shear, self.bulk_modulus, self.density)

    def isochoric_energy(self, F: Tensor) -> Entry:
        first = self.c10 * (isochoric_first_invariant(F) - 3)
        return first + self.c01 * (isochoric_second_invariant(F) - 3)


class Yeoh(AbstractRubber):
    """Psi = sum_i c_i (I1_bar - 3)^i + K U(J).

    `c1`, `c2`, `c3` and `bulk_modulus` K are in Pa, `density` in kg/m^3. The small-strain shear
    modulus is 2 c1.

    Reference: Yeoh, Rubber Chem. Technol. 66, 1993.
    """

    c1: Float[Array, "..."] = eqx.field(converter=real)
    c2: Float[Array, "..."] = eqx.field(converter=real)
    c3: Float[Array, "..."] = eqx.field(converter=real)
    bulk_modulus: Float[Array, "..."] = eqx.field(converter=real)
    density: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)
    volumetric: AbstractVolumetricLaw = Quadratic()

    def __check_init__(self):
        checks.moduli("Yeoh", self, self.c1, self.bulk_modulus, self.density)
        checks.finite("Yeoh", c2=self.c2, c3=self.c3)

    def first_invariant_energy(self, x: Entry) -> Entry:
        return x * (self.c1 + x * (self.c2 + x * self.c3))

    def isochoric_energy(self, F: Tensor) -> Entry:
        return self.first_invariant_energy(isochoric_first_invariant(F) - 3)


class Gent(AbstractRubber):
    """Psi = -mu Jm/2 ln(1 - (I1_bar - 3)/Jm) + K U(J): chains lock at I1_bar - 3 = Jm.

    Beyond 99 % of `locking` (Jm [-]) the logarithm continues as its second-order Taylor
    polynomial, so that the energy is finite and twice continuously differentiable everywhere
    and a solver can come back; results there are not Gent's. `locking_stretch` gives the limit.
    `shear_modulus` mu and `bulk_modulus` K are in Pa, `density` is in kg/m^3.

    Reference: Gent, Rubber Chem. Technol. 69, 1996.
    """

    shear_modulus: Float[Array, "..."] = eqx.field(converter=real)
    locking: Float[Array, "..."] = eqx.field(converter=real)
    bulk_modulus: Float[Array, "..."] = eqx.field(converter=real)
    density: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)
    volumetric: AbstractVolumetricLaw = Quadratic()

    def __check_init__(self):
        checks.moduli("Gent", self, self.shear_modulus, self.bulk_modulus, self.density)
        _check.positive("Gent", "locking", self.locking, "", "Rubbers have 10 to 100.")

    def first_invariant_energy(self, x: Entry) -> Entry:
        share = x / self.locking
        inside = jnp.log1p(-jnp.minimum(share, GENT_LIMIT))
        over = jnp.maximum(share - GENT_LIMIT, 0) / (1 - GENT_LIMIT)
        return -self.shear_modulus * self.locking / 2 * (inside - over - over**2 / 2)

    def isochoric_energy(self, F: Tensor) -> Entry:
        return self.first_invariant_energy(isochoric_first_invariant(F) - 3)


def locking_stretch(gent: Gent) -> Float[Array, "..."]:
    """Uniaxial stretch at which the incompressible chains of `gent` are straight [-].

    Args:
        gent: The material.

    Returns:
        The stretch [-].
    """
    ratio = 3 / (3 + gent.locking)
    return 2 * jnp.sqrt(1 / ratio) * jnp.cos(jnp.arccos(-(ratio**1.5)) / 3)


def neo_hookean(
    *, young_modulus: float, poisson_ratio: float, density: float | None = None
) -> NeoHookean:
    """A neo-Hookean rubber from the two constants of small strains.

    W = mu/2 (I1_bar - 3) + K (J - 1)^2 / 2 with mu = E / (2 (1 + nu)) and
    K = E / (3 (1 - 2 nu)), the isochoric invariant I1_bar = J^(-2/3) tr F'F.

    Args:
        young_modulus: Young's modulus E of small strains [Pa], positive.
        poisson_ratio: Poisson's ratio nu of small strains [-], in (-1, 0.5).
        density: Mass per reference volume [kg/m^3]; None where no weight or inertia is needed.

    Returns:
        The material.

    Raises:
        ValueError: If a number is out of range.

    Example:
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45)
        >>> print(f"{float(rubber.shear_modulus) / kPa:.1f} kPa")
        344.8 kPa

    Reference:
        Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2008.
    """
    _check.positive("neo_hookean", "young_modulus", young_modulus, "Pa", checks.MODULUS)
    checks.poisson_ratio("neo_hookean", poisson_ratio)
    shear = real(young_modulus) / (2 * (1 + poisson_ratio))
    return NeoHookean(shear, bulk_modulus(shear, poisson_ratio), density)


# Sums of powers of the principal values of C, smooth where they coincide


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


# Ogden's rubber in powers of the principal stretches


Numbers = tuple[Float[Array, "..."], ...]


class Ogden(AbstractRubber):
    """Psi = sum_p mu_p/alpha_p (l1^alpha_p + l2^alpha_p + l3^alpha_p - 3) + K U(J).

    The stretches are isochoric, `moduli` mu_p in Pa, `exponents` alpha_p without unit, both
    tuples with one entry per term. The small-strain shear modulus is sum_p mu_p alpha_p / 2,
    `bulk_modulus` K is in Pa, `density` in kg/m^3. Terms with mu_p alpha_p > 0 are stable at
    every stretch. Exact to third derivatives where stretches coincide.

    Reference: Ogden, Proc. R. Soc. Lond. A 326, 1972.
    """

    moduli: Numbers = eqx.field(converter=checks.reals)
    exponents: Numbers = eqx.field(converter=checks.reals)
    bulk_modulus: Float[Array, "..."] = eqx.field(converter=real)
    density: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)
    volumetric: AbstractVolumetricLaw = Quadratic()

    def __check_init__(self):
        if len(self.moduli) != len(self.exponents) or not self.moduli:
            raise ValueError(
                f"Ogden: got {len(self.moduli)} moduli and {len(self.exponents)} exponents, "
                "need as many of each, at least one. Give two tuples of equal length."
            )
        checks.leaves("Ogden", self)
        for mu, alpha in zip(self.moduli, self.exponents, strict=True):
            checks.finite("Ogden", moduli=mu)
            _check.finite("Ogden", "exponents", alpha, "Typical are 2, 4 and -2.")
            if _check.is_concrete(alpha) and np.any(np.asarray(alpha) == 0):
                raise ValueError(
                    "Ogden: an exponent is 0, need a number other than 0: the term would "
                    "vanish. Remove the term."
                )
        shear = ogden_shear_modulus(self)
        checks.moduli("Ogden", self, shear, self.bulk_modulus, self.density)

    def isochoric_energy(self, F: Tensor) -> Entry:
        sums = stretch_power_sums(F, tuple(alpha / 2 for alpha in self.exponents))
        terms = zip(self.moduli, self.exponents, sums, strict=True)
        return sum(mu / alpha * (total - 3) for mu, alpha, total in terms)


def ogden_shear_modulus(material: Ogden) -> Float[Array, "..."]:
    """Small-strain shear modulus, half of sum_p mu_p alpha_p [Pa].

    Args:
        material: The material.

    Returns:
        The modulus [Pa].
    """
    terms = zip(material.moduli, material.exponents, strict=True)
    first, *others = [mu * alpha / 2 for mu, alpha in terms]
    return sum(others, start=first)


# Coefficients by model, as fits and presets have them


def shear_modulus(model: type[AbstractHyperelastic], coefficients: Sequence[float]) -> float:
    """Small-strain shear modulus [Pa] of the coefficients of a `model` in the order of its
    fields, of `Ogden` the moduli, then the exponents."""
    c, half = coefficients, len(coefficients) // 2
    if model is Ogden:
        return sum(mu * alpha for mu, alpha in zip(c[:half], c[half:], strict=True)) / 2
    if model is MooneyRivlin:
        return 2 * (c[0] + c[1])
    return 2 * c[0] if model is Yeoh else c[0]


def made_of(
    model: type[AbstractHyperelastic],
    coefficients: Sequence[float],
    bulk_modulus: Float[Array, ""] | float,
    density: float | None,
) -> AbstractHyperelastic:
    """The rubber of such coefficients."""
    half = len(coefficients) // 2
    if model is Ogden:
        return Ogden(coefficients[:half], coefficients[half:], bulk_modulus, density)
    return model(*coefficients, bulk_modulus, density)
