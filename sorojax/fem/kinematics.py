"""How a planar deformation is completed to three dimensions."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.material.kinematics import Entry, Tensor

Planar = tuple[tuple[Entry, Entry], tuple[Entry, Entry]]


class AbstractKinematics(eqx.Module):
    """Completes the in-plane deformation gradient."""

    @abc.abstractmethod
    def embed(self, F: Planar) -> Tensor:
        """The full deformation gradient."""

    @property
    @abc.abstractmethod
    def depth(self) -> Float[Array, ""]:
        """Length out of the plane that forces and energies refer to [m]."""


class PlaneStrain(AbstractKinematics):
    """No strain out of the plane; forces are those of a body `thickness` deep [m]."""

    thickness: Float[Array, ""] = eqx.field(converter=real, default=1.0)

    def __check_init__(self):
        _check.positive(
            "PlaneStrain", "thickness", self.thickness, "m", "Write 20 * mm, for example."
        )

    @property
    def depth(self) -> Float[Array, ""]:
        return self.thickness

    def embed(self, F: Planar) -> Tensor:
        (a, b), (c, d) = F
        return ((a, b, 0.0), (c, d, 0.0), (0.0, 0.0, 1.0))


def cofactor(F: Planar) -> Planar:
    """dJ/dF of a planar gradient."""
    (a, b), (c, d) = F
    return ((d, -c), (-b, a))


def determinant(F: Planar) -> Entry:
    """J of a planar gradient."""
    (a, b), (c, d) = F
    return a * d - b * c


def second_piola(F: Planar, P: Planar) -> Planar:
    """S = F^-1 P."""
    (a, b), (c, d) = F
    J = determinant(F)
    inverse = ((d / J, -b / J), (-c / J, a / J))
    return tuple(  # type: ignore[return-value]
        tuple(inverse[i][0] * P[0][j] + inverse[i][1] * P[1][j] for j in range(2))
        for i in range(2)
    )


def stack(F: Planar) -> Float[Array, "2 2 ..."]:
    return jnp.stack([jnp.stack(row) for row in F])


def unstack(F: Float[Array, "2 2 ..."]) -> Planar:
    return ((F[0, 0], F[0, 1]), (F[1, 0], F[1, 1]))
