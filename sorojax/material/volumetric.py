"""Laws of the volume ratio; all have the bulk modulus K as their curvature at J = 1."""

import abc

import equinox as eqx
import jax.numpy as jnp

from sorojax.material.kinematics import Entry


class AbstractVolumetricLaw(eqx.Module):
    """Energy per bulk modulus of a volume ratio, elementwise."""

    @abc.abstractmethod
    def __call__(self, J: Entry) -> Entry:
        """U(J) / K [-]."""


class Quadratic(AbstractVolumetricLaw):
    """(J - 1)^2 / 2: pressure linear in the volume, finite at J = 0."""

    def __call__(self, J: Entry) -> Entry:
        return (J - 1) ** 2 / 2


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
