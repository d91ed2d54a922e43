"""Fibres and fabrics inside a rubber: stiff along one direction."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, optional_real, real
from sorojax.material import checks
from sorojax.material.hyperelastic import AbstractHyperelastic, rest_stretches
from sorojax.material.kinematics import Entry, Tensor, plus, times

Direction = tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]


def _direction(value: Numbers) -> Direction:
    """Three leaves from three numbers, an array (3,) or one row per cell (cells, 3)."""
    entries: Any = value
    if not isinstance(value, list | tuple):
        entries = jnp.moveaxis(real(value), -1, 0) if np.ndim(entries) else (entries,)
    return tuple(real(entry) for entry in entries)  # type: ignore[return-value]


class FibreReinforced(AbstractHyperelastic):
    """The energy of `base` plus that of fibres along `direction`.

    With e = (|F a|^2 - 1) / 2, the Green-Lagrange strain of the unit direction a, the
    fibres store `modulus`/2 e^2: `modulus` [Pa] adds to Young's modulus along them, so
    it is the fibre's own times its share of the volume. Two families are two nested
    fibre terms. The term uses the whole F, not the isochoric part.

    `direction` is given in the reference body by three numbers or one row per cell and
    need not have unit length. `slack` [-] makes the fibres bear tension only: their
    stiffness is zero for e < 0 and rises linearly until e = `slack`, as crimped fibres
    do, which keeps the energy twice continuously differentiable. `stiffening` k [-] turns
    the energy W into `modulus` (exp(k W / `modulus`) - 1) / k, which limits the strain.

    Reference: Holzapfel, Gasser & Ogden, J. Elasticity 61, 2000.
    """

    base: AbstractHyperelastic
    modulus: Float[Array, "..."] = eqx.field(converter=real)
    direction: Direction = eqx.field(converter=_direction)
    slack: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)
    stiffening: Float[Array, "..."] | None = eqx.field(converter=optional_real, default=None)

    def __check_init__(self):
        where = "FibreReinforced"
        if len(self.direction) != 3:
            raise ValueError(
                f"{where}: `direction` has {len(self.direction)} components, need 3. In the "
                "plane write (1, 0, 0); per cell an array (cells, 3)."
            )
        checks.leaves(where, self)
        _check.positive(where, "modulus", self.modulus, "Pa", checks.MODULUS)
        for entry in self.direction:
            _check.finite(where, "direction", entry, "Write (1, 0, 0), for example.")
        square = sum(entry**2 for entry in self.direction[1:]) + self.direction[0] ** 2
        _check.positive(where, "length of direction", square, "", "Write (1, 0, 0).")
        for name, value in (("slack", self.slack), ("stiffening", self.stiffening)):
            if value is not None:
                _check.positive(where, name, value, "", "Leave it out for none.")

    @property
    def density(self):  # that of the base: embedded fibres replace as much rubber
        return self.base.density

    def isochoric_energy(self, F: Tensor) -> Entry:
        strain = (fibre_stretch_square(F, self.direction) - 1) / 2
        density = _spring(strain, self.slack)
        if self.stiffening is not None:
            density = jnp.expm1(self.stiffening * density) / self.stiffening
        return self.base.isochoric_energy(F) + self.modulus * density

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.base.volumetric_energy(J)


@rest_stretches.register
def _(material: FibreReinforced):
    return rest_stretches(material.base)


def fibre_stretch_square(F: Tensor, direction: Direction) -> Entry:
    """|F a|^2 / |a|^2, the squared stretch of the material line `direction`."""
    total: Entry = 0.0
    for row in F:
        entry: Entry = 0.0
        for f, a in zip(row, direction, strict=True):
            entry = plus(entry, times(f, a))
        total = plus(total, times(entry, entry))
    a, b, c = direction
    return total / (a**2 + b**2 + c**2)


def _spring(strain: Entry, slack: Entry | None) -> Entry:
    """e^2 / 2, or its one-sided form with a stiffness that rises over `slack`."""
    if slack is None:
        return strain**2 / 2
    rising = jnp.clip(strain, 0, slack)
    over = jnp.maximum(strain - slack, 0)
    return rising**3 / (6 * slack) + over * (slack + over) / 2


def fibre_direction(angle: Float[Any, "..."]) -> Direction:
    """Direction in the plane at `angle` [rad] from the first axis, a number or per cell.

    Args:
        angle: Angle [rad].

    Returns:
        The components of a unit vector.
    """
    angle = real(angle)
    return jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
