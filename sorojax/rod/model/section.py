"""Cross-sections: the constants by which a section resists and carries mass, of common shapes
in closed form and of any plane shape by its mesh.

The first coordinate of a plane shape is local y of the rod, the second local z.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed
from sorojax._types import Numbers, optional_real, real
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.motion.move import move
from sorojax.mesh.plane.triangulate import triangulate
from sorojax.rod.model.torsion import (
    PlaneConstants,
    plane_constants,
    principal_angle,
    shear_factors,
)
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.query import evaluate
from sorojax.sdf.sampling import finite_box


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
    """The same shape `factor` times as large [-]; an array gives one section per entry.

    Args:
        section: The section.
        factor: Ratio of lengths [-].

    Returns:
        The section of that size.
    """
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

    Returns:
        A function of s in [0, 1] that `rod` takes in place of a section.

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


def circle(radius: Numbers, *, shear_factor=9 / 10) -> Section:
    """A circular cross-section: area pi r^2, second moments pi r^4 / 4, torsion constant twice
    that.

    Args:
        radius: Radius r [m]; with one value per point for a rod that tapers.
        shear_factor: Shear area over area [-]; 9/10, that of an incompressible solid, by
            default.

    Returns:
        The constants of the section.

    Raises:
        ValueError: If the radius is not positive.

    Example:
        >>> section = rod.circle(5 * mm)
        >>> print(f"{float(section.area) / mm**2:.2f} mm^2")
        78.54 mm^2

    Reference:
        Shear factor 6 (1 + nu) / (7 + 6 nu): Cowper, The shear coefficient in Timoshenko's
        beam theory, J. Appl. Mech. 33, 1966.
    """
    radius = _length("circle", "radius", radius, "Give the outer radius.")
    return Section(*_disc(radius), shear_factor=shear_factor)


@jax.jit
def _disc(radius):
    """Area, both second moments and the torsion constant, by one small program."""
    second_moment = math.pi / 4 * radius**4
    return math.pi * radius**2, second_moment, second_moment, 2 * second_moment


def ring(radius: Numbers, inner_radius: Numbers, *, poisson_ratio=0.5) -> Section:
    """A tube of outer `radius` and `inner_radius` [m].

    Args:
        radius: Outer radius [m].
        inner_radius: Inner radius [m].
        poisson_ratio: Poisson's ratio in the shear factor [-].

    Returns:
        The constants of the section.

    Reference:
        Shear factor: Cowper, J. Appl. Mech. 33, 1966.
    """
    radius = _length("ring", "radius", radius, "Give the outer radius.")
    inner = _length("ring", "inner_radius", inner_radius, "A full disc is a `circle`.")
    wall = radius - inner
    _check.positive("ring", "radius - inner_radius", wall, "m", "Give the outer radius first.")
    second_moment = math.pi / 4 * (radius**4 - inner**4)
    nu, m = real(poisson_ratio), inner / radius
    thick = (1 + m**2) ** 2
    below = (7 + 6 * nu) * thick + (20 + 12 * nu) * m**2
    return Section(
        area=math.pi * (radius**2 - inner**2),
        second_moment_y=second_moment,
        second_moment_z=second_moment,
        torsion_constant=2 * second_moment,
        shear_factor=6 * (1 + nu) * thick / below,
    )


def rectangle(width: Numbers, height: Numbers, *, shear_factor=5 / 6) -> Section:
    """A solid rectangle.

    Args:
        width: Size along local z [m], out of the plane of a planar rod.
        height: Size along local y [m], in the plane of a planar rod.
        shear_factor: Share of the area that carries shear [-]; 10 (1 + nu) / (12 + 11 nu)
            after Cowper, of which the default is the value at nu = 0.

    Returns:
        The constants of the section.

    Reference:
        Torsion by Saint-Venant's series, exact to rounding: Timoshenko, Goodier, Theory of
        Elasticity, 1970, section 109.
    """
    width = _length("rectangle", "width", width, "Give the size along local z.")
    height = _length("rectangle", "height", height, "Give the size along local y.")
    long, short = jnp.maximum(width, height), jnp.minimum(width, height)
    return Section(
        area=width * height,
        second_moment_y=height * width**3 / 12,
        second_moment_z=width * height**3 / 12,
        torsion_constant=_rectangle_torsion(long, short),
        shear_factor=shear_factor,
    )


_ODD = tuple(range(1, 14, 2))
_SUM = 1.0045237627951384  # sum of n^-5 over odd n: 31/32 zeta(5)


@jax.jit
def _rectangle_torsion(long: Array, short: Array) -> Array:
    ratio = short / long
    # tanh x = 1 - 2 / (1 + exp 2x): what is left of the series falls like exp(-n pi).
    rest = sum(2 / (1 + jnp.exp(n * math.pi / ratio)) / n**5 for n in _ODD)
    return long * short**3 / 3 * (1 - 192 / math.pi**5 * ratio * (_SUM - rest))


def ellipse(half_width: Numbers, half_height: Numbers, *, poisson_ratio=0.5) -> Section:
    """A solid ellipse.

    Args:
        half_width: Semi-axis along local z [m].
        half_height: Semi-axis along local y [m].
        poisson_ratio: Poisson's ratio in the shear factors [-].

    Returns:
        The constants of the section.

    Reference:
        Shear factors: Cowper, J. Appl. Mech. 33, 1966.
    """
    a = _length("ellipse", "half_height", half_height, "Give the semi-axis along local y.")
    b = _length("ellipse", "half_width", half_width, "Give the semi-axis along local z.")
    nu = real(poisson_ratio)
    return Section(
        area=math.pi * a * b,
        second_moment_y=math.pi / 4 * a * b**3,
        second_moment_z=math.pi / 4 * a**3 * b,
        torsion_constant=math.pi * a**3 * b**3 / (a**2 + b**2),
        shear_factor=_ellipse_shear(a / b, nu),
        shear_factor_z=_ellipse_shear(b / a, nu),
    )


@jax.jit
def _ellipse_shear(n: Array, nu: Array) -> Array:
    below = (40 + 37 * nu) * n**4 + (16 + 10 * nu) * n**2 + nu
    return 12 * (1 + nu) * n**2 * (3 * n**2 + 1) / below


def squircle(radius: Numbers, power: Numbers, *, shear_factor=5 / 6) -> Section:
    """A superellipse |y|^power + |z|^power = radius^power, from disc (2) to square.

    The torsion constant is that of the harmonic function fitted to the boundary: within
    1e-4 for powers up to 8.

    Args:
        radius: Half of the width [m].
        power: Exponent [-], from 2 to below 50.
        shear_factor: Share of the area that carries shear [-].

    Returns:
        The constants of the section.
    """
    radius = _length("squircle", "radius", radius, "Give half the side.")
    n = real(power)
    _check.between("squircle", "power", n, 2, 50, "", "Use rectangle for more.", "[)")
    area, second, torsion = _squircle(n)
    return Section(
        area=area * radius**2,
        second_moment_y=second * radius**4,
        second_moment_z=second * radius**4,
        torsion_constant=torsion * radius**4,
        shear_factor=shear_factor,
    )


@jax.jit
def _squircle(n: Array) -> tuple[Array, Array, Array]:
    """Area, second moment and torsion constant at radius 1."""
    second = _superellipse(3.0, 1.0, n)
    return _superellipse(1.0, 1.0, n), second, _squircle_torsion(n, 2 * second)


def _superellipse(a: float, b: float, n: Array) -> Array:
    """Integral of |y|^(a-1) |z|^(b-1) over the superellipse of radius 1."""
    log = jax.lax.lgamma(a / n) + jax.lax.lgamma(b / n) - jax.lax.lgamma((a + b) / n + 1)
    return 4 / n**2 * jnp.exp(log)


def _squircle_torsion(n: Array, polar: Array) -> Array:
    """2 times the integral of Prandtl's stress function, psi - r^2/2 with psi harmonic."""
    count, samples = 10, 80
    angle = jnp.asarray((np.arange(samples) + 0.5) / samples * math.pi / 4, n.dtype)
    log = jnp.log(jnp.cos(angle)), jnp.log(jnp.sin(angle))
    r = jnp.exp(-jnp.log(jnp.exp(n * log[0]) + jnp.exp(n * log[1])) / n)
    k = 4 * jnp.arange(count, dtype=n.dtype)
    reach = r[:, None] / jnp.max(r)
    waves = jnp.cos(k[None] * angle[:, None]) * jnp.exp(k[None] * jnp.log(reach))
    share, *_ = jnp.linalg.lstsq(waves, r**2 / 2)
    discs = waves * (r**2)[:, None] / (k + 2)[None]
    return 2 * 2 * math.pi * jnp.mean(discs @ share) - polar


def from_shape(
    shape: AbstractSdf,
    *,
    mesh: Mesh | None = None,
    size: float | None = None,
    poisson_ratio=0.5,
    principal: bool = False,
) -> Section:
    """The section of any plane shape; holes are allowed.

    Everything is measured about the centroid on six-node triangles, torsion and shear by
    the warping functions that they carry.

    Args:
        shape: A plane shape: x is local y of the rod, y is local z. Concrete, unless
            `mesh` is given.
        mesh: Triangles of a nearby shape of the same structure: they are moved to fit, and
            the section is differentiable in the parameters of `shape`.
        size: Side of the triangles [m]; by default a sixteenth of the shape, less for thin
            walls.
        poisson_ratio: Poisson's ratio in the shear factors [-].
        principal: Turn the shape to its principal axes, the stiffer bending about z.

    Returns:
        The constants of the section.

    Raises:
        ValueError: If bending about y and z is coupled and `principal` is not set, or the
            shape cannot be meshed.
    """
    if mesh is None:
        size = _size(shape) if size is None else size
        mesh = triangulate(shape, size=size, order=2)
    else:
        mesh = move(mesh, shape)
    return from_mesh(mesh, poisson_ratio=poisson_ratio, principal=principal)


def from_mesh(mesh: Mesh, *, poisson_ratio=0.5, principal: bool = False) -> Section:
    """The section of a plane mesh of triangles, as `from_shape`; differentiable in points.

    Args:
        mesh: Triangles of the section [m]: x is local y of the rod, y is local z.
        poisson_ratio: Poisson's ratio in the shear factors [-].
        principal: Turn the section to its principal axes, the stiffer bending about z.

    Returns:
        The constants of the section.
    """
    found = plane_constants(mesh, principal=principal)
    _check_uncoupled(found)
    along_y, along_z = shear_factors(found, poisson_ratio)
    return Section(
        area=found.area,
        second_moment_y=found.moments[1, 1],
        second_moment_z=found.moments[0, 0],
        torsion_constant=found.torsion_constant,
        shear_factor=along_y,
        shear_factor_z=along_z,
    )


def _check_uncoupled(found: PlaneConstants) -> None:
    if not _check.is_concrete(found.moments):
        return
    moments = np.asarray(found.moments)
    if abs(moments[0, 1]) > 1e-4 * np.trace(moments):
        angle = math.degrees(float(principal_angle(found.moments)))
        raise ValueError(
            f"from_shape: the product of inertia is {moments[0, 1]:.3g} m^4, a rod needs "
            f"principal axes, which lie {angle:.2f} degrees from y. Give principal=True and "
            "turn the base of the rod by that angle, or turn the shape with sdf.rotate."
        )


def _size(shape: AbstractSdf) -> float:
    low, high = finite_box("from_shape", shape, 2)
    axes = [np.linspace(a, b, 96) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    depth = -float(np.min(np.asarray(evaluate(shape, jnp.asarray(grid)))))
    return min(float(np.min(high - low)) / 16, max(depth, 0.01 * float(np.min(high - low))))


def _length(where: str, name: str, value, do: str) -> Float[Array, "*quad"]:
    value = real(value)
    _check.positive(where, name, value, "m", do)
    return value
