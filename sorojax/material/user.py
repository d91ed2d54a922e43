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
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.material.kinematics import (
    Entry,
    Tensor,
    isochoric_first_invariant,
    isochoric_second_invariant,
)
from sorojax.material.volumetric import AbstractVolumetricLaw, Quadratic

Parameters = tuple[Float[Array, "..."], ...]


def _reals(values) -> Parameters:
    return tuple(real(value) for value in values)


class UserEnergy(AbstractHyperelastic):
    """Psi = function(F, *parameters) + K U(J) of a function of the deformation gradient.

    `function` takes the nine entries of F as three rows of three, `F[i][j]`, works
    elementwise with `jnp`, and returns J/m^3; entries of a planar state may be the
    numbers 0.0 and 1.0. What it writes in terms of J alone is better left to
    `bulk_modulus` [Pa], because formulations for nearly incompressible solids treat that
    part apart; without one there is no second part. `parameters` are the numbers to
    differentiate by and may hold one number per cell; other numbers are constants of the
    function. Define the function once: every new lambda compiles anew.
    """

    function: Callable[..., Entry] = eqx.field(static=True)
    parameters: Parameters = eqx.field(converter=_reals, default=())
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


class InvariantEnergy(AbstractHyperelastic):
    """Psi = function(I1_bar, I2_bar, *parameters) + K U(J); see `UserEnergy`.

    Both invariants are 3 at rest; for a stable rest state the sum of the slopes of
    `function` there, half the shear modulus, must be positive.
    """

    function: Callable[..., Entry] = eqx.field(static=True)
    parameters: Parameters = eqx.field(converter=_reals, default=())
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
            "InvariantEnergy", self.parameters,
            lambda: self.function(three, three, *self.parameters),
        )  # fmt: skip

    def isochoric_energy(self, F: Tensor) -> Entry:
        first, second = isochoric_first_invariant(F), isochoric_second_invariant(F)
        return self.function(first, second, *self.parameters)

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.bulk_modulus * self.volumetric(J)


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
