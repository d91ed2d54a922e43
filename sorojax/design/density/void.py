"""Void that may fold: cells of low density store the energy of small strains.

Soft cells of a fixed mesh collapse and invert long before the body around them is loaded,
and Newton's method ends there. They carry nothing, so their energy may be exchanged for
one that never does.

Reference: Wang, Lazarov, Sigmund, Jensen, "Interpolation scheme for fictitious domain
techniques and topology optimization of finite strain elastic problems", CMAME 276, 2014.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.design.density.filters import heaviside_projection
from sorojax.material import checks
from sorojax.material.hyperelastic import (
    AbstractHyperelastic,
    finite_share,
    strain_energy_density,
)
from sorojax.material.kinematics import Entry, Tensor, minus, plus, times
from sorojax.material.user import StVenantKirchhoff

_KEPT = 0.3  # share of the stiffness of the solid from which a cell is one


class InterpolatedEnergy(AbstractHyperelastic):
    """factor (Psi(I + s Grad u) + (1 - s^2) psi(Grad u)) with s the `share` of a cell.

    Psi is the energy of `base` and psi its quadratic form at rest, blind to rotation. Where
    s is 1 the cell is of the base material, where it is 0 it is linear and may invert; its
    stiffness at rest is that of the base times `factor` for every s. The volumetric energy
    is that of 1 + s (J - 1). The base has to be isotropic and free of stress at rest.

    Solvers keep cells from inverting as far as their `share` goes. Made by
    `interpolated_energy`; `factor` and `share` are numbers or one per cell.
    """

    base: AbstractHyperelastic
    factor: Float[Array, "..."] = eqx.field(converter=real)
    share: Float[Array, "..."] = eqx.field(converter=real)

    def __check_init__(self):
        checks.leaves("InterpolatedEnergy", self)
        _check.positive(
            "InterpolatedEnergy",
            "factor",
            self.factor,
            "",
            "Give the void 1e-6 of the stiffness, for example.",
        )

    @property
    def density(self):  # the mass is that of the base
        return self.base.density

    def isochoric_energy(self, F: Tensor) -> Entry:
        slope = tuple(
            tuple(minus(F[i][j], 1.0) if i == j else F[i][j] for j in range(3))
            for i in range(3)
        )
        part: Any = tuple(
            tuple(
                plus(times(slope[i][j], self.share), 1.0)
                if i == j
                else times(slope[i][j], self.share)
                for j in range(3)
            )
            for i in range(3)
        )
        small = _small_strain_energy(*_moduli(self.base), slope)  # type: ignore[arg-type]
        finite = self.base.isochoric_energy(part)
        return self.factor * (finite + (1 - self.share**2) * small)

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.factor * self.base.volumetric_energy(1 + self.share * (J - 1))


@finite_share.register
def _(material: InterpolatedEnergy):
    if not isinstance(material.base, StVenantKirchhoff):
        return material.share
    # its energy is finite however far a cell is squeezed: only what is to stay is guarded
    return jnp.where(material.factor < _KEPT, jnp.zeros_like(material.share), material.share)


def interpolated_energy(
    base: AbstractHyperelastic,
    factor: Float[Array, " cells"],
    *,
    threshold: float = 0.01,
    sharpness: float = 500.0,
) -> InterpolatedEnergy:
    """`base` with `factor` times its stiffness, linear in cells whose factor is far below
    `threshold`; differentiable in `factor`.

    Args:
        base: The solid.
        factor: Of a design, `Simp()(density)` for example: 1 is solid.
        threshold: Factor at which a cell is half linear.
        sharpness: Of the change from one to the other, as in `heaviside_projection`.

    Returns:
        The material, one number per cell.
    """
    factor = real(factor)
    share = heaviside_projection(factor, sharpness, threshold)
    return InterpolatedEnergy(base=base, factor=factor, share=share)


def _moduli(base: AbstractHyperelastic) -> tuple[Entry, Entry]:
    """Shear and bulk modulus at rest [Pa], of the shape of the leaves of `base`."""

    def second(energy):
        zero = jnp.zeros((), jnp.result_type(float))
        one = jnp.ones_like(zero)

        def slope(t):
            return jax.jvp(energy, (t,), (one,))[1]

        return jax.jvp(slope, (zero,), (one,))[1]

    def sheared(t):
        return strain_energy_density(
            base, ((1.0 + 0 * t, t, 0.0), (0.0, 1.0 + 0 * t, 0.0), (0.0, 0.0, 1.0 + 0 * t))
        )

    def swollen(t):
        return strain_energy_density(
            base, ((1 + t, 0.0, 0.0), (0.0, 1 + t, 0.0), (0.0, 0.0, 1 + t))
        )

    return second(sheared), second(swollen) / 9


def _small_strain_energy(shear: Entry, bulk: Entry, slope: Tensor) -> Entry:
    """K/2 tr(e)^2 + G (e:e - tr(e)^2 / 3) of the symmetric part e [J/m^3]."""
    trace: Entry = 0.0
    squares: Entry = 0.0
    for i in range(3):
        trace = plus(trace, slope[i][i])
        squares = plus(squares, times(slope[i][i], slope[i][i]))
        for j in range(i):
            both = plus(slope[i][j], slope[j][i])
            squares = plus(squares, times(times(both, both), 0.5))
    return (bulk / 2 - shear / 3) * trace**2 + shear * squares
