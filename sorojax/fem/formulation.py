"""Which pressures a cell can carry: the remedy against volumetric locking.

The volume ratio J is projected onto constants or linear functions of each cell (weighted by
reference volume), theta = pi J, and the energy is W(F) + U(theta). Its derivative is
the pressure p = pi U'(theta), so the unknowns stay displacements, and the tangent stays
symmetric, positive definite at stable states.

Reference: Simo, Taylor, Pister, "Variational and projection methods for the volume
constraint in finite deformation elasto-plasticity", CMAME 51, 1985.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.kinematics import AbstractKinematics
from sorojax.material.kinematics import Entry
from sorojax.mesh.elements import AbstractElement, Hex8, PolyN, Quad4, Quad9, Tet15, Tri7

Modes = Float[Array, "modes quad lanes"]


class AbstractFormulation(eqx.Module):
    """How the pressure varies within a cell."""

    @abc.abstractmethod
    def pressures(self, position: Float[Array, "dim quad lanes"]) -> list[Entry]:
        """Functions of position that pressures are made of; none for pointwise."""


class Displacement(AbstractFormulation):
    """Pressure from J at every quadrature point: for compressible materials."""

    def pressures(self, position):
        return []


class ConstantPressure(AbstractFormulation):
    """One pressure per cell, from its mean volume ratio (mean dilatation)."""

    def pressures(self, position):
        return [jnp.ones_like(position[0])]


class LinearPressure(AbstractFormulation):
    """Pressures linear in each cell, discontinuous between cells."""

    def pressures(self, position):
        return [jnp.ones_like(position[0]), *position]


def default_formulation(
    element: AbstractElement, kinematics: AbstractKinematics
) -> AbstractFormulation:
    """The formulation of `element` that does not lock, or else `Displacement()`."""
    if not kinematics.has_volume:
        return Displacement()
    if isinstance(element, Tri7 | Quad9 | Tet15):
        return LinearPressure()
    if isinstance(element, Quad4 | Hex8 | PolyN):
        return ConstantPressure()
    return Displacement()


def modes(
    formulation: AbstractFormulation,
    position: Float[Array, "dim quad lanes"],
    volumes: Float[Array, "quad lanes"],
) -> Modes | None:
    """Pressure functions of each cell, orthonormal over its reference volume."""
    found: list[Entry] = []
    for function in formulation.pressures(position):
        for other in found:
            function = function - other * _sum(volumes * other * function)
        found.append(function / jnp.sqrt(_sum(volumes * function**2)))
    return jnp.stack(found) if found else None


def _sum(field: Entry) -> Entry:
    return jnp.sum(field, axis=0, keepdims=True)


def coefficients(modes: Modes, volumes: Float[Array, "quad lanes"], field: Entry) -> Entry:
    """Integrals of `field` times each mode, (modes, lanes)."""
    return jnp.sum(modes * (volumes * field)[None], axis=1)


def project(modes: Modes | None, volumes: Float[Array, "quad lanes"], field: Entry) -> Entry:
    """Best approximation of `field` by the pressure functions; itself when pointwise."""
    if modes is None:
        return field
    return jnp.sum(modes * coefficients(modes, volumes, field)[:, None], axis=0)
