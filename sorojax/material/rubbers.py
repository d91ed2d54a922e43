"""Rubbers in the invariants of the isochoric deformation.

Every energy splits as Psi = W(I1_bar, I2_bar) + K U(J) with the physical bulk modulus K;
`volumetric` chooses U, (J - 1)^2 / 2 unless told otherwise.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.material import checks
from sorojax.material.hyperelastic import AbstractHyperelastic, bulk_modulus
from sorojax.material.kinematics import (
    Entry,
    Tensor,
    isochoric_first_invariant,
    isochoric_second_invariant,
)
from sorojax.material.volumetric import AbstractVolumetricLaw, Quadratic

GENT_LIMIT = 0.99  # share of the locking strain measure where the continuation begins


class NeoHookean(AbstractHyperelastic):
    """Psi = mu/2 (I1_bar - 3) + K U(J); moduli in Pa, density in kg/m^3."""

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

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.bulk_modulus * self.volumetric(J)


class MooneyRivlin(AbstractHyperelastic):
    """Psi = c10 (I1_bar - 3) + c01 (I2_bar - 3) + K U(J); coefficients in Pa.

    The small-strain shear modulus is 2 (c10 + c01). A negative c01 is unstable in
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

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.bulk_modulus * self.volumetric(J)


class Yeoh(AbstractHyperelastic):
    """Psi = sum_i c_i (I1_bar - 3)^i + K U(J); coefficients in Pa.

    The small-strain shear modulus is 2 c1.

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

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.bulk_modulus * self.volumetric(J)


class Gent(AbstractHyperelastic):
    """Psi = -mu Jm/2 ln(1 - (I1_bar - 3)/Jm) + K U(J): chains lock at I1_bar - 3 = Jm.

    Beyond 99 % of `locking` (Jm [-]) the logarithm continues as its second-order Taylor
    polynomial, so that the energy is finite and twice continuously differentiable
    everywhere and a solver can come back; results there are not Gent's.
    `locking_stretch` tells where the limit is.

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

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.bulk_modulus * self.volumetric(J)


def locking_stretch(gent: Gent) -> Float[Array, "..."]:
    """Uniaxial stretch at which the incompressible chains of `gent` are straight [-]."""
    ratio = 3 / (3 + gent.locking)
    return 2 * jnp.sqrt(1 / ratio) * jnp.cos(jnp.arccos(-(ratio**1.5)) / 3)


def neo_hookean(
    *, young_modulus: float, poisson_ratio: float, density: float | None = None
) -> NeoHookean:
    """A `NeoHookean` from engineering constants.

    Args:
        young_modulus: Small-strain modulus [Pa].
        poisson_ratio: Small-strain ratio, below 0.5.
        density: Mass per reference volume [kg/m^3].

    Raises:
        ValueError: If a number is out of range.
    """
    _check.positive("neo_hookean", "young_modulus", young_modulus, "Pa", checks.MODULUS)
    checks.poisson_ratio("neo_hookean", poisson_ratio)
    shear = real(young_modulus) / (2 * (1 + poisson_ratio))
    return NeoHookean(shear, bulk_modulus(shear, poisson_ratio), density)
