"""Stress and tangent at points, elementwise on the entries of F.

The tangent may take its geometric part from a stress that is extrapolated linearly
from the previous iterate (mixed integration point method): the residual is untouched,
and Newton's method for nearly incompressible solids needs a fraction of the iterations.

Reference: Magisano, Leonetti, Garcea, "How to improve efficiency and robustness of the
Newton method in geometrically non-linear structural problem discretized via
displacement-based finite elements", CMAME 313, 2017.
"""

import jax
import jax.numpy as jnp

from sorojax.fem.kinematics import AbstractKinematics, Planar, second_piola
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.material.kinematics import Entry

Tangent = list  # A[i][j][k][l], entries over points


def stress(
    material: AbstractHyperelastic, kinematics: AbstractKinematics, F: Planar
) -> Planar:
    """In-plane P = dPsi/dF at every point [Pa]."""
    return jax.grad(lambda F: jnp.sum(energy_density(material, kinematics, F)))(F)


def energy_density(
    material: AbstractHyperelastic, kinematics: AbstractKinematics, F: Planar
) -> Entry:
    """Psi at every point [J/m^3]."""
    return material.strain_energy_density(kinematics.embed(F))


def stress_and_tangent(
    material: AbstractHyperelastic,
    kinematics: AbstractKinematics,
    F: Planar,
    F_before: Planar,
) -> tuple[Planar, Tangent]:
    """P and A = dP/dF, its geometric part from the stress extrapolated out of `F_before`.

    With `F_before` equal to `F` the tangent is the exact derivative.
    """

    def P_of(F):
        return stress(material, kinematics, F)

    P = P_of(F)
    A = [[[[None, None], [None, None]] for _ in range(2)] for _ in range(2)]
    for k in range(2):
        for l in range(2):
            column = jax.jvp(P_of, (F,), (_unit(F, k, l),))[1]
            for i in range(2):
                for j in range(2):
                    A[i][j][k][l] = column[i][j]  # type: ignore[call-overload]
    change = _extrapolated(P_of, F, F_before, second_piola(F, P))
    for i in range(2):
        for j in range(2):
            for l in range(2):
                A[i][j][i][l] = A[i][j][i][l] + change[j][l]  # type: ignore[operator]
    return P, A


def _extrapolated(P_of, F: Planar, F_before: Planar, S: Planar) -> Planar:
    """Second Piola-Kirchhoff stress extrapolated from `F_before` to `F`, minus S(F)."""
    step = jax.tree.map(lambda a, b: a - b, F, F_before)
    before, rate = jax.jvp(lambda F: second_piola(F, P_of(F)), (F_before,), (step,))
    return jax.tree.map(lambda s0, ds, s1: s0 + ds - s1, before, rate, S)


def _unit(F: Planar, k: int, l: int) -> Planar:
    return tuple(  # type: ignore[return-value]
        tuple(
            jnp.ones_like(F[i][j]) if (i, j) == (k, l) else jnp.zeros_like(F[i][j])
            for j in range(2)
        )
        for i in range(2)
    )
