"""Ogden's rubber in powers of the principal stretches."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.material import checks
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.material.kinematics import Entry, Tensor
from sorojax.material.spectral import stretch_power_sums
from sorojax.material.volumetric import AbstractVolumetricLaw, Quadratic

Numbers = tuple[Float[Array, "..."], ...]


def _reals(values) -> Numbers:
    return tuple(real(value) for value in values)


class Ogden(AbstractHyperelastic):
    """Psi = sum_p mu_p/alpha_p (l1^alpha_p + l2^alpha_p + l3^alpha_p - 3) + K U(J).

    The stretches are isochoric, `moduli` mu_p in Pa, `exponents` alpha_p without unit,
    both tuples with one entry per term. The small-strain shear modulus is
    sum_p mu_p alpha_p / 2; terms with mu_p alpha_p > 0 are stable at every stretch. Exact to
    third derivatives where stretches coincide.

    Reference: Ogden, Proc. R. Soc. Lond. A 326, 1972.
    """

    moduli: Numbers = eqx.field(converter=_reals)
    exponents: Numbers = eqx.field(converter=_reals)
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

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.bulk_modulus * self.volumetric(J)


def ogden_shear_modulus(material: Ogden) -> Float[Array, "..."]:
    """Small-strain shear modulus, half of sum_p mu_p alpha_p [Pa]."""
    terms = zip(material.moduli, material.exponents, strict=True)
    first, *others = [mu * alpha / 2 for mu, alpha in terms]
    return sum(others, start=first)
