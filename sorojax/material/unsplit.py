"""Solids whose energy does not split into change of shape and change of volume."""

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
    minus,
    plus,
    right_cauchy_green,
    square_norm,
)


class StVenantKirchhoff(AbstractHyperelastic):
    """Psi = lambda/2 tr(E)^2 + mu E:E of the Green-Lagrange strain; moduli in Pa.

    Linear elasticity for large rotations. The trace of E is no function of J, so all of
    the energy is in the first hook and formulations that treat J apart do not relieve
    it: keep nu below 0.45. It loses stiffness in compression, to zero at a uniaxial
    stretch of 0.58; use it for small strains.
    """

    shear_modulus: Float[Array, "..."] = eqx.field(converter=real)
    bulk_modulus: Float[Array, "..."] = eqx.field(converter=real)
    density: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        checks.moduli(
            "StVenantKirchhoff", self, self.shear_modulus, self.bulk_modulus, self.density
        )

    def isochoric_energy(self, F: Tensor) -> Entry:
        C = right_cauchy_green(F)
        strain = tuple(
            tuple((minus(C[i][j], 1.0) if i == j else C[i][j]) for j in range(3))
            for i in range(3)
        )  # twice the Green-Lagrange strain
        trace = plus(plus(strain[0][0], strain[1][1]), strain[2][2])
        lame = self.bulk_modulus - 2 / 3 * self.shear_modulus
        squares = square_norm(strain)  # type: ignore[arg-type]
        return lame / 8 * trace**2 + self.shear_modulus / 4 * squares

    def volumetric_energy(self, J: Entry) -> Entry:
        return jnp.zeros_like(J)


class CompressibleNeoHookean(AbstractHyperelastic):
    """Psi = mu/2 (I1 - 3 - 2 ln J) + lambda/2 (ln J)^2; moduli in Pa.

    The form of many finite element codes; `bulk_modulus` is K = lambda + 2/3 mu.

    Reference: Bonet & Wood, Nonlinear Continuum Mechanics for Finite Element Analysis,
    2008, section 6.4.3.
    """

    shear_modulus: Float[Array, "..."] = eqx.field(converter=real)
    bulk_modulus: Float[Array, "..."] = eqx.field(converter=real)
    density: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        checks.moduli(
            "CompressibleNeoHookean", self, self.shear_modulus, self.bulk_modulus, self.density
        )

    def isochoric_energy(self, F: Tensor) -> Entry:
        return self.shear_modulus / 2 * (square_norm(F) - 3)

    def volumetric_energy(self, J: Entry) -> Entry:
        lame = self.bulk_modulus - 2 / 3 * self.shear_modulus
        log = jnp.log(J)
        return (lame / 2 * log - self.shear_modulus) * log


def st_venant_kirchhoff(
    *, young_modulus: float, poisson_ratio: float, density: float | None = None
) -> StVenantKirchhoff:
    """A `StVenantKirchhoff` from engineering constants.

    Args:
        young_modulus: Small-strain modulus [Pa].
        poisson_ratio: Small-strain ratio, below 0.5.
        density: Mass per reference volume [kg/m^3].

    Raises:
        ValueError: If a number is out of range.
    """
    where = "st_venant_kirchhoff"
    _check.positive(where, "young_modulus", young_modulus, "Pa", checks.MODULUS)
    checks.poisson_ratio(where, poisson_ratio)
    shear = real(young_modulus) / (2 * (1 + poisson_ratio))
    return StVenantKirchhoff(shear, bulk_modulus(shear, poisson_ratio), density)
