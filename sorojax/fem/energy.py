"""Stress and tangent at points, elementwise on the entries of F.

The tangent may take its geometric parts from a pressure and an isochoric second
Piola-Kirchhoff stress that are extrapolated linearly from the previous iterate (mixed
integration point method): the residual is untouched, and Newton's method for nearly
incompressible solids needs a fraction of the iterations. The rotation of a cell within
an iterate is second order in the update but enters J multiplied by the bulk modulus.

Reference: Magisano, Leonetti, Garcea, "How to improve efficiency and robustness of the
Newton method in geometrically non-linear structural problem discretized via
displacement-based finite elements", CMAME 313, 2017.
"""

import jax
import jax.numpy as jnp

from sorojax.fem.kinematics import (
    AbstractKinematics,
    Planar,
    cofactor,
    determinant,
    second_piola,
)
from sorojax.material.hyperelastic import AbstractHyperelastic, strain_energy_density
from sorojax.material.kinematics import Entry

Tangent = list  # A[i][j][k][l], entries over points
_PERMUTATION = ((0.0, 1.0), (-1.0, 0.0))


def energy_density(
    material: AbstractHyperelastic, kinematics: AbstractKinematics, F: Planar
) -> Entry:
    """Psi at every point [J/m^3]."""
    return strain_energy_density(material, kinematics.embed(F))


def stress_and_tangent(
    material: AbstractHyperelastic,
    kinematics: AbstractKinematics,
    F: Planar,
    F_before: Planar,
) -> tuple[Planar, Tangent]:
    """P and A = dP/dF, its geometric parts from stresses extrapolated out of `F_before`.

    With `F_before` equal to `F` the tangent is the exact derivative.
    """

    def isochoric(F):
        return jax.grad(lambda F: jnp.sum(material.isochoric_energy(kinematics.embed(F))))(F)

    pressure = jax.grad(lambda J: jnp.sum(material.volumetric_energy(J)))
    step = jax.tree.map(lambda a, b: a - b, F, F_before)
    P, C, J = isochoric(F), cofactor(F), determinant(F)
    p, bulk = jax.jvp(pressure, (J,), (jnp.ones_like(J),))
    p_before, p_rate = jax.jvp(lambda F: pressure(determinant(F)), (F_before,), (step,))
    extra = _extrapolated(isochoric, F, F_before, step, second_piola(F, P))
    A = [[[[None, None], [None, None]] for _ in range(2)] for _ in range(2)]
    for k in range(2):
        for l in range(2):
            column = jax.jvp(isochoric, (F,), (_unit(F, k, l),))[1]
            for i in range(2):
                for j in range(2):
                    entry = column[i][j] + bulk * C[i][j] * C[k][l]
                    if i == k:
                        entry = entry + extra[j][l]
                    elif j != l:
                        sign = _PERMUTATION[i][k] * _PERMUTATION[j][l]
                        entry = entry + sign * (p_before + p_rate)
                    A[i][j][k][l] = entry  # type: ignore[call-overload]
    return jax.tree.map(lambda s, c: s + p * c, P, C), A


def _extrapolated(isochoric, F: Planar, F_before: Planar, step: Planar, S: Planar) -> Planar:
    """Second Piola-Kirchhoff stress extrapolated from `F_before` to `F`, minus S(F)."""
    before, rate = jax.jvp(lambda F: second_piola(F, isochoric(F)), (F_before,), (step,))
    return jax.tree.map(lambda s0, ds, s1: s0 + ds - s1, before, rate, S)


def _unit(F: Planar, k: int, l: int) -> Planar:
    return tuple(  # type: ignore[return-value]
        tuple(
            jnp.ones_like(F[i][j]) if (i, j) == (k, l) else jnp.zeros_like(F[i][j])
            for j in range(2)
        )
        for i in range(2)
    )
