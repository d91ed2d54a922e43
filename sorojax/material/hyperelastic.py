"""Stored energies; stress and tangent follow by differentiation."""

import abc
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._display import displayed
from sorojax._jax.jit import once
from sorojax.material import checks
from sorojax.material.kinematics import Entry, Tensor, determinant, from_matrix


@displayed
class AbstractHyperelastic(eqx.Module):
    """A stored energy per reference volume, isochoric plus volumetric.

    The hooks are elementwise code on the entries of F, so one call serves any number of points.
    `density` [kg/m^3] is for weight and inertia, None without. A leaf may also hold one number
    per cell of a mesh.
    """

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        density: ClassVar[Float[Array, "..."] | None]

    @abc.abstractmethod
    def isochoric_energy(self, F: Tensor) -> Entry:
        """The part that depends on F not only through J, per reference volume [J/m^3]."""

    @abc.abstractmethod
    def volumetric_energy(self, J: Entry) -> Entry:
        """Energy of the volume ratio J per reference volume [J/m^3]."""


def bulk_modulus(shear_modulus: Float[Array, "..."], poisson_ratio: float):
    """K of a solid with small-strain `shear_modulus` [Pa] and `poisson_ratio` [Pa].

    Args:
        shear_modulus: At small strains [Pa].
        poisson_ratio: At small strains [-].

    Returns:
        The modulus [Pa].

    Raises:
        ValueError: If `poisson_ratio` is outside (-1, 0.5).
    """
    checks.poisson_ratio("bulk_modulus", poisson_ratio)
    nu = poisson_ratio
    return 2 * shear_modulus * (1 + nu) / (3 * (1 - 2 * nu))


def strain_energy_density(material: AbstractHyperelastic, F: Tensor) -> Entry:
    """Psi per reference volume [J/m^3], elementwise on the entries of F.

    Args:
        material: The material.
        F: Rows of the deformation gradient [-], each entry a number or an array.

    Returns:
        Energy per reference volume [J/m^3].
    """
    return material.isochoric_energy(F) + material.volumetric_energy(determinant(F))


def first_piola_kirchhoff_stress(
    material: AbstractHyperelastic, F: Float[Array, "3 3"]
) -> Float[Array, "3 3"]:
    """P = dPsi/dF [Pa].

    Args:
        material: The material.
        F: Deformation gradient [-].

    Returns:
        Stress [Pa].
    """
    return jax.grad(lambda F: strain_energy_density(material, from_matrix(F)))(F)


def cauchy_stress(
    material: AbstractHyperelastic, F: Float[Array, "3 3"]
) -> Float[Array, "3 3"]:
    """sigma = P F' / J [Pa].

    Args:
        material: The material.
        F: Deformation gradient [-].

    Returns:
        Stress [Pa].
    """
    return first_piola_kirchhoff_stress(material, F) @ F.T / determinant(from_matrix(F))


def elasticity_tensor(
    material: AbstractHyperelastic, F: Float[Array, "3 3"]
) -> Float[Array, "3 3 3 3"]:
    """A = dP/dF [Pa].

    Args:
        material: The material.
        F: Deformation gradient [-].

    Returns:
        The tensor [Pa].
    """
    return jax.jacfwd(lambda F: first_piola_kirchhoff_stress(material, F))(F)


@functools.singledispatch
def first_invariant_energy(material: AbstractHyperelastic) -> Callable[[Entry], Entry] | None:
    """The isochoric energy as a function of I1_bar - 3, `None` where it is not one."""
    return getattr(material, "first_invariant_energy", None)


@functools.singledispatch
def finite_share(material: AbstractHyperelastic) -> Float[Array, "..."] | None:
    """Share of the displacement gradient whose finite strain is stored, `None` for all of
    it: cells without any may invert."""
    return None


@functools.singledispatch
def rest_stretches(material: AbstractHyperelastic) -> tuple[Entry, Entry, Entry]:
    """Stretches along the axes at which `material` is free of stress [-].

    Args:
        material: The material.

    Returns:
        Stretch along x, y and z [-].
    """
    return 1.0, 1.0, 1.0


def small_strain_moduli(
    material: AbstractHyperelastic,
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Shear and bulk modulus of `material` at rest [Pa], one pair per cell if leaves are.

    The stiffness is that of Cauchy stress about the stress-free state, so growth changes
    no modulus. Of a material with a stiff direction it is the average over all
    directions; take `elasticity_tensor` to see them.

    Args:
        material: The material.

    Returns:
        Shear modulus, bulk modulus [Pa].
    """
    axes = jax.tree.map(lambda leaf: 0 if jnp.ndim(leaf) else None, material)
    if all(axis is None for axis in jax.tree.leaves(axes, is_leaf=lambda a: a is None)):
        return _moduli_at_rest(material)
    return jax.vmap(_moduli_at_rest, in_axes=(axes,))(material)


def small_strain_young_modulus(material: AbstractHyperelastic) -> Float[Array, "..."]:
    """Young's modulus of `material` at rest [Pa], one per cell if leaves are."""
    shear, bulk = small_strain_moduli(material)
    return 9 * bulk * shear / (3 * bulk + shear)


@once
def _moduli_at_rest(material):
    stretch = jnp.stack(
        [jnp.asarray(s, jnp.result_type(float)) for s in rest_stretches(material)]
    )
    A = elasticity_tensor(material, jnp.diag(stretch))
    c = jnp.einsum("ijkl,j,l->ijkl", A, stretch, stretch) / jnp.prod(stretch)
    trace, square = jnp.einsum("iijj", c), jnp.einsum("ijij", c)
    return (square - trace / 3) / 10, trace / 9


# Laws of the volume ratio; all have the bulk modulus K as their curvature at J = 1


class AbstractVolumetricLaw(eqx.Module):
    """Energy per bulk modulus of a volume ratio, elementwise."""

    @abc.abstractmethod
    def __call__(self, J: Entry) -> Entry:
        """U(J) / K [-]."""


class Quadratic(AbstractVolumetricLaw):
    """(J - 1)^2 / 2: pressure linear in the volume, finite at J = 0."""

    def __call__(self, J: Entry) -> Entry:
        return (J - 1) ** 2 / 2


class AbstractRubber(AbstractHyperelastic):
    """An energy whose volumetric part is K U(J), with `bulk_modulus` for K [Pa] and
    `volumetric` for U."""

    if TYPE_CHECKING:  # fields that subclasses have, in their own order
        bulk_modulus: ClassVar[Float[Array, "..."]]
        volumetric: ClassVar[AbstractVolumetricLaw]

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.bulk_modulus * self.volumetric(J)


class SimoMiehe(AbstractVolumetricLaw):
    """(J^2 - 1 - 2 ln J) / 4: convex in J and infinite at J = 0.

    Reference: Simo & Miehe, CMAME 98, 1992.
    """

    def __call__(self, J: Entry) -> Entry:
        return (J**2 - 1) / 4 - jnp.log(J) / 2


class SimoTaylor(AbstractVolumetricLaw):
    """((J - 1)^2 + (ln J)^2) / 4: infinite at J = 0.

    Reference: Simo, Taylor & Pister, CMAME 51, 1985.
    """

    def __call__(self, J: Entry) -> Entry:
        return ((J - 1) ** 2 + jnp.log(J) ** 2) / 4


class Logarithmic(AbstractVolumetricLaw):
    """(ln J)^2 / 2: infinite at J = 0, softens beyond J = e."""

    def __call__(self, J: Entry) -> Entry:
        return jnp.log(J) ** 2 / 2
