"""Stored energies that the user writes as a function."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.trace_state import is_traced
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
    isochoric_first_invariant,
    isochoric_second_invariant,
    minus,
    plus,
    right_cauchy_green,
    square_norm,
)

Parameters = tuple[Float[Array, "..."], ...]


class UserEnergy(AbstractHyperelastic):
    """Psi = function(F, *parameters) + K U(J) of a function of the deformation gradient.

    `function` takes the nine entries of F as three rows of three, `F[i][j]`, works elementwise
    with `jnp`, and returns J/m^3; entries of a planar state may be the numbers 0.0 and 1.0.
    What it writes in terms of J alone is better left to `bulk_modulus` [Pa], because
    formulations for nearly incompressible solids treat that part apart; without one there is no
    second part. `volumetric` is U, `density` in kg/m^3. `parameters` are the numbers to
    differentiate by and may hold one number per cell; other numbers are constants of the
    function. Define the function once: every new lambda compiles anew.
    """

    function: Callable[..., Entry] = eqx.field(static=True)
    parameters: Parameters = eqx.field(converter=checks.reals, default=())
    bulk_modulus: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)
    density: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)
    volumetric: AbstractVolumetricLaw = Quadratic()

    def __check_init__(self):
        checks.leaves("UserEnergy", self)
        if self.bulk_modulus is not None:
            _check.positive(
                "UserEnergy", "bulk_modulus", self.bulk_modulus, "Pa", checks.MODULUS
            )
        checks.mass("UserEnergy", self.density)
        rest = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        _check_energy("UserEnergy", self.parameters, lambda: self.isochoric_energy(rest))

    def isochoric_energy(self, F: Tensor) -> Entry:
        return self.function(F, *self.parameters)

    def volumetric_energy(self, J: Entry) -> Entry:
        if self.bulk_modulus is None:
            return jnp.zeros_like(J)
        return self.bulk_modulus * self.volumetric(J)


class InvariantEnergy(AbstractRubber):
    """Psi = function(I1_bar, I2_bar, *parameters) + K U(J); see `UserEnergy`.

    Both invariants are 3 at rest; for a stable rest state the sum of the slopes of
    `function` there, half the shear modulus, must be positive. `parameters` are the numbers to
    differentiate by, `bulk_modulus` is K [Pa], `volumetric` is U, `density` is in kg/m^3.
    """

    function: Callable[..., Entry] = eqx.field(static=True)
    parameters: Parameters = eqx.field(converter=checks.reals, default=())
    bulk_modulus: Float[Array, "..."] = eqx.field(converter=real, kw_only=True)
    density: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)
    volumetric: AbstractVolumetricLaw = Quadratic()

    def __check_init__(self):
        checks.leaves("InvariantEnergy", self)
        _check.positive(
            "InvariantEnergy", "bulk_modulus", self.bulk_modulus, "Pa", checks.MODULUS
        )
        checks.mass("InvariantEnergy", self.density)
        three = jnp.asarray(3.0, self.bulk_modulus.dtype)
        _check_energy(
            "InvariantEnergy",
            self.parameters,
            lambda: self.function(three, three, *self.parameters),
        )

    def isochoric_energy(self, F: Tensor) -> Entry:
        first, second = isochoric_first_invariant(F), isochoric_second_invariant(F)
        return self.function(first, second, *self.parameters)


def _check_energy(where: str, parameters: Any, at_rest: Callable[[], Entry]) -> None:
    if is_traced(parameters):
        return
    energy = at_rest()
    cells = {np.shape(p) for p in jax.tree.leaves(parameters)} | {()}
    if np.shape(energy) not in cells:
        raise ValueError(
            f"{where}: `function` returns shape {np.shape(energy)} at rest, need one number "
            "per point. Write it elementwise on its arguments."
        )
    _check.finite(where, "function", energy, "Its value at rest must be a number.")


# Solids whose energy does not split into change of shape and change of volume


class StVenantKirchhoff(AbstractHyperelastic):
    """Psi = lambda/2 tr(E)^2 + mu E:E of the Green-Lagrange strain.

    Linear elasticity for large rotations. The trace of E is no function of J, so all of
    the energy is in the first hook and formulations that treat J apart do not relieve
    it: keep nu below 0.45. It loses stiffness in compression, to zero at a uniaxial
    stretch of 0.58; use it for small strains. `shear_modulus` is mu and `bulk_modulus`
    lambda + 2/3 mu, both in Pa; `density` is in kg/m^3.
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
    """Psi = mu/2 (I1 - 3 - 2 ln J) + lambda/2 (ln J)^2, `shear_modulus` mu in Pa.

    The form of many finite element codes; `bulk_modulus` [Pa] is K = lambda + 2/3 mu, `density`
    is in kg/m^3.

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

    Returns:
        The material.

    Raises:
        ValueError: If a number is out of range.
    """
    where = "st_venant_kirchhoff"
    _check.positive(where, "young_modulus", young_modulus, "Pa", checks.MODULUS)
    checks.poisson_ratio(where, poisson_ratio)
    shear = real(young_modulus) / (2 * (1 + poisson_ratio))
    return StVenantKirchhoff(shear, bulk_modulus(shear, poisson_ratio), density)
