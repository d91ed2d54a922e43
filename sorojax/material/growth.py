"""Growth, swelling and thermal expansion: a rest state that is not the reference one."""

import equinox as eqx
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.material import checks
from sorojax.material.hyperelastic import AbstractHyperelastic, rest_stretches
from sorojax.material.kinematics import Entry, Tensor, absent

Stretches = tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]


def _stretches(value: Numbers) -> Stretches:
    """Three leaves from one number (or one per cell), or from a tuple of three."""
    entries = value if isinstance(value, list | tuple) else (value,) * 3
    return tuple(real(entry) for entry in entries)  # type: ignore[return-value]


class Grown(AbstractHyperelastic):
    """`base` after every free piece of it has stretched by `stretch` [-].

    F = F_e F_g with F_g = diag(`stretch`): the body is free of stress at F = F_g and
    stores det(F_g) Psi(F F_g^-1) per volume of the body before it grew. `stretch` is one
    number in all directions, or a tuple of three along the axes; each may hold one
    number per cell. A temperature change dT with expansion coefficient alpha is
    `Grown(base, 1 + alpha * dT)`; a muscle that shortens along x at constant volume is
    `Grown(base, (g, g**-0.5, g**-0.5))`. In plane strain the third direction is held,
    so growth across the plane presses. The mass is that before growth.

    Reference: Rodriguez, Hoger & McCulloch, J. Biomech. 27, 1994.
    """

    base: AbstractHyperelastic
    stretch: Stretches = eqx.field(converter=_stretches)

    def __check_init__(self):
        if len(self.stretch) != 3:
            raise ValueError(
                f"Grown: `stretch` has {len(self.stretch)} entries, need one number or three "
                "along the axes. One number per cell is an array, not a list."
            )
        checks.leaves("Grown", self)
        for stretch in self.stretch:
            _check.positive("Grown", "stretch", stretch, "", "1 is no growth, 1.1 is 10 %.")

    @property
    def density(self):
        return self.base.density

    def isochoric_energy(self, F: Tensor) -> Entry:
        elastic = tuple(
            tuple(
                0.0 if absent(entry) else entry / g
                for entry, g in zip(row, self.stretch, strict=True)
            )
            for row in F
        )
        return growth_volume(self) * self.base.isochoric_energy(elastic)  # type: ignore

    def volumetric_energy(self, J: Entry) -> Entry:
        volume = growth_volume(self)
        return volume * self.base.volumetric_energy(J / volume)


@rest_stretches.register
def _(grown: Grown) -> Stretches:
    pairs = zip(rest_stretches(grown.base), grown.stretch, strict=True)
    return tuple(before * g for before, g in pairs)  # type: ignore[return-value]


def growth_volume(grown: Grown) -> Float[Array, "..."]:
    """Volume of a free piece after growth over that before [-]."""
    a, b, c = grown.stretch
    return a * b * c
