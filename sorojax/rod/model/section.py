"""Cross-sections: the constants by which a section resists and carries mass."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import Numbers, optional_real, real


@displayed
class Section(eqx.Module):
    """Constants of a cross-section in its local y-z plane; the rod axis is local x.

    Each is one number for a uniform rod, or one value per Gauss node for a tapered one:
    `taper` and functions of s give these for any number of nodes.
    Bending about y resists with `second_moment_y`, about z with `second_moment_z`; a
    planar rod bends about z.

    Attributes:
        area: [m^2].
        second_moment_y: Integral of z^2 over the section [m^4].
        second_moment_z: Integral of y^2 over the section [m^4].
        torsion_constant: [m^4].
        shear_factor: Share of the area that carries shear [-].
        shear_factor_z: The same for shear along z, if it differs from that along y.
        mass_offset_y: From the axis to the centre of mass, along y [m].
        mass_offset_z: The same along z.
    """

    area: Float[Array, "*quad"] = eqx.field(converter=real)
    second_moment_y: Float[Array, "*quad"] = eqx.field(converter=real)
    second_moment_z: Float[Array, "*quad"] = eqx.field(converter=real)
    torsion_constant: Float[Array, "*quad"] = eqx.field(converter=real)
    shear_factor: Float[Array, "*quad"] = eqx.field(converter=real, default=5 / 6)
    shear_factor_z: Float[Array, "*quad"] | None = eqx.field(
        converter=optional_real, default=None
    )
    mass_offset_y: Float[Array, "*quad"] | None = eqx.field(
        converter=optional_real, default=None
    )
    mass_offset_z: Float[Array, "*quad"] | None = eqx.field(
        converter=optional_real, default=None
    )

    def __check_init__(self):
        do = "Write lengths in metres, e.g. with sorojax.units.mm."
        _check.positive("Section", "area", self.area, "m^2", do)
        _check.positive("Section", "second_moment_y", self.second_moment_y, "m^4", do)
        _check.positive("Section", "second_moment_z", self.second_moment_z, "m^4", do)
        _check.positive("Section", "torsion_constant", self.torsion_constant, "m^4", do)
        _check.positive("Section", "shear_factor", self.shear_factor, "-", "5/6 is usual.")
        if self.shear_factor_z is not None:
            do = "Leave it out if it is that along y."
            _check.positive("Section", "shear_factor_z", self.shear_factor_z, "-", do)
        do = "Both are about the axis: the mass cannot lie further away than they say."
        for offset, about in ((self.mass_offset_y, "z"), (self.mass_offset_z, "y")):
            if offset is not None:
                left = getattr(self, f"second_moment_{about}") - self.area * offset**2
                name = f"second_moment_{about} - area mass_offset^2"
                _check.positive("Section", name, left, "m^4", do)


def scaled(section: Section, factor: Numbers) -> Section:
    """The same shape `factor` times as large [-]; an array gives one section per entry."""
    factor = real(factor)
    _check.positive("scaled", "factor", factor, "-", "1 leaves the section as it is.")
    return Section(
        area=section.area * factor**2,
        second_moment_y=section.second_moment_y * factor**4,
        second_moment_z=section.second_moment_z * factor**4,
        torsion_constant=section.torsion_constant * factor**4,
        shear_factor=section.shear_factor,
        shear_factor_z=section.shear_factor_z,
        mass_offset_y=None if section.mass_offset_y is None else factor * section.mass_offset_y,
        mass_offset_z=None if section.mass_offset_z is None else factor * section.mass_offset_z,
    )


def taper(
    section: Callable[..., Section], start: Numbers, end: Numbers
) -> Callable[..., Section]:
    """A section whose sizes change linearly from base to tip, as a function of s.

    Args:
        section: Makes a section of sizes, e.g. `circle`, or `lambda k: scaled(made, k)`.
        start: Size [m] at the base, or a tuple with one per argument of `section`.
        end: The same at the tip.

    Raises:
        ValueError: If `start` and `end` hold different numbers of sizes.
    """
    first = start if isinstance(start, tuple) else (start,)
    last = end if isinstance(end, tuple) else (end,)
    if len(first) != len(last):
        raise ValueError(
            f"taper: `start` has {len(first)} sizes and `end` {len(last)}, need as many. Give "
            "one per argument of the section, e.g. (width, height)."
        )
    return jax.tree_util.Partial(_tapered, section, jax.tree.map(real, (first, last)))


def _tapered(section, ends, s: Float[np.ndarray, " points"]) -> Section:
    first, last = ends
    sizes = (a + (b - a) * jnp.asarray(s, a.dtype) for a, b in zip(first, last, strict=True))
    return section(*sizes)
