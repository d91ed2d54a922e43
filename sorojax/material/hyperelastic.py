"""Stored energies of rubber; stress and tangent follow by differentiation.

All energies split the isochoric from the volumetric response with the physical
bulk modulus: Psi = W(J^(-2/3) I1) + K/2 (J - 1)^2.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.material.kinematics import (
    Entry,
    Tensor,
    determinant,
    from_matrix,
    isochoric_first_invariant,
)

_MODULUS = "Moduli are in Pa: write 0.2 * MPa."


class AbstractHyperelastic(eqx.Module):
    """A stored energy per reference volume, isochoric plus volumetric.

    The hooks are elementwise code on the entries of F, so one call serves any number
    of points. A leaf may also hold one number per cell of a mesh.
    """

    density: eqx.AbstractVar[Float[Array, "..."] | None]

    @abc.abstractmethod
    def isochoric_energy(self, F: Tensor) -> Entry:
        """Energy of the change of shape per reference volume [J/m^3]."""

    @abc.abstractmethod
    def volumetric_energy(self, J: Entry) -> Entry:
        """Energy of the volume ratio J per reference volume [J/m^3]."""


class NeoHookean(AbstractHyperelastic):
    """Psi = mu/2 (I1_bar - 3) + K/2 (J - 1)^2; moduli in Pa, density in kg/m^3."""

    shear_modulus: Float[Array, "..."] = eqx.field(converter=real)
    bulk_modulus: Float[Array, "..."] = eqx.field(converter=real)
    density: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        _check_moduli("NeoHookean", self.shear_modulus, self.bulk_modulus, self.density)

    def isochoric_energy(self, F: Tensor) -> Entry:
        return self.shear_modulus / 2 * (isochoric_first_invariant(F) - 3)

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.bulk_modulus / 2 * (J - 1) ** 2


class Yeoh(AbstractHyperelastic):
    """Psi = sum_i c_i (I1_bar - 3)^i + K/2 (J - 1)^2; coefficients in Pa.

    The small-strain shear modulus is 2 c1.

    Reference: Yeoh, Rubber Chem. Technol. 66, 1993.
    """

    c1: Float[Array, "..."] = eqx.field(converter=real)
    c2: Float[Array, "..."] = eqx.field(converter=real)
    c3: Float[Array, "..."] = eqx.field(converter=real)
    bulk_modulus: Float[Array, "..."] = eqx.field(converter=real)
    density: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        _check_moduli("Yeoh", self.c1, self.bulk_modulus, self.density)
        _check.finite("Yeoh", "c2, c3", jnp.stack([self.c2, self.c3]), _MODULUS)

    def isochoric_energy(self, F: Tensor) -> Entry:
        x = isochoric_first_invariant(F) - 3
        return x * (self.c1 + x * (self.c2 + x * self.c3))

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.bulk_modulus / 2 * (J - 1) ** 2


class Scaled(AbstractHyperelastic):
    """`factor` times the energy of `base`: a stiffer layer, or element densities.

    `factor` is a number or one number per cell.
    """

    base: AbstractHyperelastic
    factor: Float[Array, "..."] = eqx.field(converter=real)

    def __check_init__(self):
        _check.positive("Scaled", "factor", self.factor, "", "Remove cells instead.")

    @property
    def density(self):  # the mass is that of the base
        return self.base.density

    def isochoric_energy(self, F: Tensor) -> Entry:
        return self.factor * self.base.isochoric_energy(F)

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.factor * self.base.volumetric_energy(J)


def _check_moduli(where, shear, bulk, density):
    _check.positive(where, "shear modulus", shear, "Pa", _MODULUS)
    _check.positive(where, "bulk_modulus", bulk, "Pa", _MODULUS)
    if density is not None:
        _check.positive(where, "density", density, "kg/m^3", "Rubber is about 1070.")


def bulk_modulus(shear_modulus: Float[Array, ""], poisson_ratio: float):
    """K of a solid with small-strain `shear_modulus` [Pa] and `poisson_ratio` [Pa].

    Raises:
        ValueError: If `poisson_ratio` is outside (-1, 0.5).
    """
    _check.between(
        "bulk_modulus", "poisson_ratio", poisson_ratio, -1.0, 0.5, "",
        "For a nearly incompressible rubber use 0.49: at 0.5 the bulk modulus is infinite.",
    )  # fmt: skip
    nu = poisson_ratio
    return 2 * shear_modulus * (1 + nu) / (3 * (1 - 2 * nu))


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
    _check.positive("neo_hookean", "young_modulus", young_modulus, "Pa", _MODULUS)
    shear = real(young_modulus) / (2 * (1 + poisson_ratio))
    return NeoHookean(shear, bulk_modulus(shear, poisson_ratio), density)


def small_strain_moduli(
    material: AbstractHyperelastic,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Shear and bulk modulus of `material` at rest [Pa]."""
    A = elasticity_tensor(material, jnp.eye(3, dtype=jnp.result_type(float)))
    shear = A[0, 1, 0, 1]
    return shear, A[0, 0, 1, 1] + 2 / 3 * shear


def strain_energy_density(material: AbstractHyperelastic, F: Tensor) -> Entry:
    """Psi per reference volume [J/m^3], elementwise on the entries of F."""
    return material.isochoric_energy(F) + material.volumetric_energy(determinant(F))


def first_piola_kirchhoff_stress(
    material: AbstractHyperelastic, F: Float[Array, "3 3"]
) -> Float[Array, "3 3"]:
    """P = dPsi/dF [Pa]."""
    return jax.grad(lambda F: strain_energy_density(material, from_matrix(F)))(F)


def elasticity_tensor(
    material: AbstractHyperelastic, F: Float[Array, "3 3"]
) -> Float[Array, "3 3 3 3"]:
    """A = dP/dF [Pa]."""
    return jax.jacfwd(lambda F: first_piola_kirchhoff_stress(material, F))(F)
