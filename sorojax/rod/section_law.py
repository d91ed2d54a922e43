"""A nonlinear law of the section: moments and forces from strains, by a user function."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax.math.quadrature import gauss_legendre
from sorojax.rod.forces import AbstractElastic
from sorojax.rod.motion import operators
from sorojax.rod.rod import Rod, strain_names


class SectionLaw(AbstractElastic):
    """Elasticity from a function of the strain of the section, from `section_law`.

    Attributes:
        stress: (strain change, s) -> moments [N m], then forces [N].
        rows: Strain per coordinate at the Gauss nodes.
        weights: Gauss weights [m].
        s: The nodes in [0, 1].
    """

    stress: Callable[[Float[Array, " strain"], Float[Array, ""]], Float[Array, " strain"]]
    rows: Float[Array, "quad strain dof"]
    weights: Float[Array, " quad"]
    s: Float[Array, " quad"]

    def restoring_force(self, q):
        stress = jax.vmap(self.stress)(self.rows @ q, self.s)
        do = "Return one moment or force per strain of the rod."
        _check.shape("SectionLaw", "stress", stress, self.rows.shape[:2], do)
        loads = (self.weights[:, None] * stress).reshape(-1)
        return loads @ self.rows.reshape(-1, q.shape[0])


def section_law(
    rod: Rod,
    stress: Callable[[Float[Array, " strain"], Float[Array, ""]], Float[Array, " strain"]],
) -> SectionLaw:
    """An elastic law for `rod` in place of its linear one.

    Args:
        rod: The rod; build the law again where it changes.
        stress: (strain beyond that at rest, s) -> moments [N m] and forces [N], both in the
            order of `strain_names(rod.group)`. The gradient of an energy per length keeps
            energy.
    """
    rows, weights, s = _rows(rod)
    return SectionLaw(stress, rows, weights, s)


@eqx.filter_jit
def _rows(rod: Rod) -> tuple[Array, Array, Array]:
    """Strain per coordinate at the Gauss nodes, their weights [m] and places."""
    constants = operators(rod)
    active = dict(zip(rod.basis.active, constants.strain_rows, strict=True))
    none = jnp.zeros(constants.strain_rows.shape[1:], rod.length.dtype)
    rows = jnp.stack([active.get(name, none) for name in strain_names(rod.group)], axis=1)
    s = jnp.asarray(gauss_legendre(rod.quadrature)[0], rod.length.dtype)
    return rows, constants.weights, s


class EnergyLaw(eqx.Module):
    """The stress of an energy per length [J/m], a function of (strain, s)."""

    energy: Callable[[Float[Array, " strain"], Float[Array, ""]], Float[Array, ""]]

    def __call__(self, strain: Float[Array, " strain"], s: Float[Array, ""]) -> Array:
        return jax.grad(self.energy)(strain, s)
