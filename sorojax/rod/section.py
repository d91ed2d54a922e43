"""Cross-sections: the constants by which a section resists and carries mass."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real


class Section(eqx.Module):
    """Constants of a cross-section in its local y-z plane; the rod axis is local x.

    Each is one number for a uniform rod, or one value per Gauss node for a tapered one.
    Bending about y resists with `second_moment_y`, about z with `second_moment_z`; a
    planar rod bends about z.

    Attributes:
        area: [m^2].
        second_moment_y: Integral of z^2 over the section [m^4].
        second_moment_z: Integral of y^2 over the section [m^4].
        torsion_constant: [m^4].
        shear_factor: Share of the area that carries shear [-].
    """

    area: Float[Array, "*quad"] = eqx.field(converter=real)
    second_moment_y: Float[Array, "*quad"] = eqx.field(converter=real)
    second_moment_z: Float[Array, "*quad"] = eqx.field(converter=real)
    torsion_constant: Float[Array, "*quad"] = eqx.field(converter=real)
    shear_factor: Float[Array, "*quad"] = eqx.field(converter=real, default=5 / 6)

    def __check_init__(self):
        do = "Write lengths in metres, e.g. with sorojax.units.mm."
        _check.positive("Section", "area", self.area, "m^2", do)
        _check.positive("Section", "second_moment_y", self.second_moment_y, "m^4", do)
        _check.positive("Section", "second_moment_z", self.second_moment_z, "m^4", do)
        _check.positive("Section", "torsion_constant", self.torsion_constant, "m^4", do)
        _check.positive("Section", "shear_factor", self.shear_factor, "-", "5/6 is usual.")


def circle(radius, *, shear_factor=9 / 10) -> Section:
    """A disc of `radius` [m]."""
    radius = real(radius)
    _check.positive("circle", "radius", radius, "m", "Give the outer radius.")
    second_moment = math.pi / 4 * radius**4
    return Section(
        area=math.pi * radius**2,
        second_moment_y=second_moment,
        second_moment_z=second_moment,
        torsion_constant=2 * second_moment,
        shear_factor=shear_factor,
    )


def rectangle(width, height, *, shear_factor=5 / 6) -> Section:
    """A solid rectangle.

    Args:
        width: Size along local z [m], out of the plane of a planar rod.
        height: Size along local y [m], in the plane of a planar rod.
        shear_factor: Share of the area that carries shear [-].

    Reference:
        Torsion constant within 4 % (exact 0.1406 a^4 for a square): Young, Budynas,
        Sadegh, Roark's Formulas for Stress and Strain, table 10.7.
    """
    width, height = real(width), real(height)
    _check.positive("rectangle", "width", width, "m", "Give the size along local z.")
    _check.positive("rectangle", "height", height, "m", "Give the size along local y.")
    long, short = jnp.maximum(width, height), jnp.minimum(width, height)
    ratio = short / long
    return Section(
        area=width * height,
        second_moment_y=height * width**3 / 12,
        second_moment_z=width * height**3 / 12,
        torsion_constant=long * short**3 * (1 / 3 - 0.21 * ratio * (1 - ratio**4 / 12)),
        shear_factor=shear_factor,
    )
