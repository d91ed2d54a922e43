"""The rod: basis, section, material and length, from which everything else is computed."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._display import displayed, number
from sorojax._types import Numbers, optional_real, real
from sorojax.material.hyperelastic import AbstractHyperelastic, small_strain_moduli
from sorojax.math.lie import SE2, SE3
from sorojax.math.quadrature import Quadrature, gauss_legendre
from sorojax.rod.model.basis import STRAINS, StrainBasis, checked_breaks, merged
from sorojax.rod.model.section import Section

G = TypeVar("G", SE2, SE3)
T = TypeVar("T")
AlongRod: TypeAlias = Callable[[Float[np.ndarray, " points"]], T]

_PLANAR = ("kappa_z", "sigma_x", "sigma_y")


class Elastic(eqx.Module):
    """Small-strain constants of an isotropic solid.

    Attributes:
        young_modulus: [Pa].
        poisson_ratio: [-], 0.5 for an incompressible solid.
        density: [kg/m^3].
    """

    young_modulus: Float[Array, "*quad"] = eqx.field(converter=real)
    poisson_ratio: Float[Array, "*quad"] = eqx.field(converter=real)
    density: Float[Array, "*quad"] = eqx.field(converter=real)

    def __check_init__(self):
        where = "Elastic"
        _check.positive(where, "young_modulus", self.young_modulus, "Pa", "Use units.kPa.")
        _check.positive(where, "density", self.density, "kg/m^3", "Rubber has about 1070.")
        do = "An incompressible rubber has 0.5."
        _check.between(where, "poisson_ratio", self.poisson_ratio, -1, 0.5, "-", do, "(]")


def elastic(material: AbstractHyperelastic) -> Elastic:
    """Small-strain constants of a hyperelastic material.

    Args:
        material: Hyperelastic, with a density.

    Returns:
        Young's modulus [Pa], Poisson's ratio [-] and density [kg/m^3].

    Raises:
        ValueError: If the material has no density.
    """
    if material.density is None:
        raise ValueError(
            f"rod.elastic: the {type(material).__name__} has no density, a rod needs its mass. "
            "Give density= in kg/m^3."
        )
    shear, bulk = small_strain_moduli(material)
    young = 9 * bulk * shear / (3 * bulk + shear)
    return Elastic(young, young / (2 * shear) - 1, material.density)


@displayed
class Rod(eqx.Module, Generic[G]):
    """A Cosserat rod clamped at its base, whose strains are affine in coordinates q.

    The strain at s in [0, 1] is `rest_strain + basis(s) q`; without a rest strain the
    rod is straight along x and unstretched. Every mechanical quantity is computed from
    these fields when it is asked for, so each is differentiable.

    Attributes:
        group: `SE2()` or `SE3()`: a planar or a spatial rod.
        basis: Shapes that the strains may take.
        section: Constants of the cross-section.
        material: Small-strain constants and density.
        length: Rest length [m].
        rest_strain: Curvatures [1/m], then stretch and shears [-], or None; one column per
            node if they vary.
        nodes: Number of Gauss nodes along the rod.
        breaks: Where section or rest strain jump; those of the basis need no mention.
        mass_section: Section by which the rod carries mass, if it is not that which resists.
    """

    group: G
    basis: StrainBasis
    section: Section
    material: Elastic
    length: Float[Array, ""] = eqx.field(converter=real)
    rest_strain: Float[Array, "strain *quad"] | None = eqx.field(converter=optional_real)
    nodes: int = eqx.field(static=True)
    breaks: tuple[float, ...] = eqx.field(static=True, default=())
    mass_section: Section | None = None

    def __check_init__(self):
        _check.positive("rod", "length", self.length, "m", "Give the rest length.")
        names = strain_names(self.group)
        wrong = [name for name in self.basis.active if name not in names]
        if wrong:
            raise ValueError(
                f"rod: the basis activates {', '.join(wrong)}, {type(self.group).__name__} "
                f"has {', '.join(names)}. A planar rod bends about z; use SE3() otherwise."
            )
        _check_nodes(self.nodes, self.basis, self.quadrature)
        for part in (self.section, self.material, self.mass_section):
            for field in () if part is None else dataclasses.fields(part):
                _check_field(field.name, getattr(part, field.name), self.nodes)
        if self.rest_strain is not None:
            do = f"Give one value per strain: {', '.join(names)}; stretch rests at 1."
            varies = len(jnp.shape(self.rest_strain)) == 2
            want = (len(names), self.nodes) if varies else (len(names),)
            _check.shape("rod", "rest_strain", self.rest_strain, want, do)

    @property
    def quadrature(self) -> Quadrature:
        """The Gauss rule of the rod: breaks of the basis and its own divide it."""
        breaks = self.basis.breaks
        breaks = merged(breaks, self.breaks) if self.breaks else breaks
        return Quadrature(self.nodes // (len(breaks) + 1), breaks)

    def _text(self) -> str:
        modes = ", ".join(f"{name} {m.count}" for name, m in self.basis.modes.items())
        section, material = self.section, self.material
        return (
            f"Rod in {type(self.group).__name__}: length {number(self.length, 'm')}, modes "
            f"{modes}, {self.nodes} nodes\n"
            f"  section   area {number(section.area, 'm^2')}, second moments y "
            f"{number(section.second_moment_y)}, z {number(section.second_moment_z, 'm^4')}"
            f"{'' if self.mass_section is None else '; mass by another'}\n"
            f"  material  E {number(material.young_modulus, 'Pa')}, nu "
            f"{number(material.poisson_ratio)}, density {number(material.density, 'kg/m^3')}"
        )


def rod(
    group: G,
    basis: StrainBasis,
    section: Section | AlongRod[Section],
    material: Elastic | None = None,
    *,
    length: Numbers,
    young_modulus: Numbers | AlongRod[Any] | None = None,
    poisson_ratio: Numbers | AlongRod[Any] | None = None,
    density: Numbers | AlongRod[Any] | None = None,
    rest_strain: Numbers | AlongRod[Any] | None = None,
    nodes: int | None = None,
    breaks: Sequence[float] = (),
    mass_section: Section | AlongRod[Section] | None = None,
) -> Rod[G]:
    """A Cosserat rod whose strains are combinations of modes, clamped at its base.

    xi(s) = xi_0(s) + B(s) q: curvatures, stretch and shears along s in [0, 1] are a rest strain
    plus the strain basis times the coordinates q (piecewise or global strain parametrisation).
    Without a rest strain the rod is straight along local x.

    Args:
        group: `SE2()` for a planar, `SE3()` for a spatial rod.
        basis: Active strains and their modes, e.g. `chebyshev(kappa_z=3)`.
        section: Cross-section, e.g. `circle(6 * mm)`, or a function that takes points s in
            [0, 1] to a section with one value per point, e.g. `taper(circle, 6 * mm, 3 * mm)`.
        material: `Elastic` constants, as `elastic(...)` makes them; by default the three
            numbers below.
        length: Rest length [m].
        young_modulus: Young's modulus [Pa], a number or a function of s.
        poisson_ratio: Poisson's ratio [-], a number or a function of s.
        density: Mass per volume [kg/m^3], a number or a function of s.
        rest_strain: Strain of the unloaded rod, curvatures [1/m] before stretch and shears
            [-]: one value per strain, or a function of s that gives (points, strains).
            Straight and unstretched by default.
        nodes: Gauss nodes; by default what resolves the modes, and coils of the rest strain
            where its numbers are known. Add some when the rod bends by turns. With breaks a
            multiple of the spans.
        breaks: Where section or rest strain jump or kink, in (0, 1); nowhere by default.
        mass_section: Section whose area and second moments carry mass, where they are not
            those that resist: a backbone within soft skin, cables, a fluid. `section` by
            default.

    Returns:
        The rod.

    Raises:
        ValueError: If there is neither `material` nor all three constants, a number is out of
            range, the basis has strains that the group has not, or `nodes` are too few for the
            modes or no multiple of the spans.

    Example:
        >>> finger = rod.rod(SE2(), rod.chebyshev(kappa_z=3), rod.circle(5 * mm), length=0.1,
        ...                  young_modulus=1e6, poisson_ratio=0.5, density=1000)
        >>> finger.basis.num_dof, finger.basis.active
        (3, ('kappa_z',))

    Reference:
        Boyer, Lebastard, Candelier and Renda, Dynamics of continuum and soft robots: a strain
        parameterization based approach, IEEE T-RO 37, 2021.
    """
    given = {"young_modulus": young_modulus, "poisson_ratio": poisson_ratio, "density": density}
    if material is None:
        missing = [name for name, value in given.items() if value is None]
        if missing:
            raise ValueError(
                f"rod: got no `material` and no {', '.join(missing)}; need all three "
                "constants. Write young_modulus=1 * MPa, poisson_ratio=0.49, density=1070."
            )
    own = checked_breaks("rod", breaks)
    spans = len(merged(basis.breaks, own)) + 1
    if nodes is None:
        turn = _turn_at_rest(group, rest_strain, length)
        nodes = spans * max(basis.resolution, 5 + math.ceil(turn / (_PER_NODE * spans)))
    s = gauss_legendre(Quadrature(max(nodes // spans, 1), merged(basis.breaks, own)))[0]
    if material is None:
        material = Elastic(*(_at(given[name], s) for name in given))
    if callable(rest_strain):
        rest_strain = real(rest_strain(s)).T
    carrying = _at(mass_section, s)
    return Rod(
        group, basis, _at(section, s), material, length, rest_strain, nodes, own, carrying
    )


_PER_NODE = 3.0  # [rad] of a coil; leaves less than 1e-4 of the length at the tip


def _turn_at_rest(group: SE2 | SE3, rest_strain: Any, length: Any) -> float:
    """How far the sections of the unloaded rod turn at most [rad]; 0 where that is traced."""
    if rest_strain is None:
        return 0.0
    values = rest_strain(np.linspace(0.0, 1.0, 33)) if callable(rest_strain) else rest_strain
    if not all(map(_check.is_concrete, jax.tree.leaves((values, length)))):
        return 0.0
    rows = np.atleast_2d(np.asarray(values, float))
    curvatures = rows[:, : 1 if group.space_dim == 2 else 3]
    turn = np.max(np.linalg.norm(curvatures, axis=1)) * np.max(np.asarray(length))
    return float(turn) if np.isfinite(turn) else 0.0


def _at(value: Any, s: np.ndarray) -> Any:
    return value(s) if callable(value) else value


def _check_nodes(nodes: int, basis: StrainBasis, rule: Quadrature) -> None:
    """Raise a `ValueError` unless the nodes fit the breaks and tell the modes apart."""
    spans = len(rule.breaks) + 1
    if nodes % spans:
        raise ValueError(
            f"rod: `nodes` is {nodes}, need a multiple of {spans}: breaks divide the rod into "
            f"{spans} spans. Give {spans * max(2, round(nodes / spans))}."
        )
    name, least = max(
        ((name, modes.least) for name, modes in basis.modes.items()), key=lambda pair: pair[1]
    )
    if rule.count < max(2, least):
        modes = basis.modes[name].count
        raise ValueError(
            f"rod: `nodes` is {nodes}, {rule.count} between breaks, need {max(2, least)} or "
            f"more there to tell the {modes} modes of {name} apart. "
            f"{spans * basis.resolution} resolve them."
        )


def _check_field(name: str, value: Any, nodes: int) -> None:
    if value is not None and (shape := jnp.shape(value)) not in ((), (nodes,)):
        raise ValueError(
            f"rod: `{name}` has shape {shape}, need one number or ({nodes},), one per Gauss "
            "node. Give a function of s, such as taper(circle, 6 * mm, 3 * mm)."
        )


def strain_names(group: SE2 | SE3) -> tuple[str, ...]:
    """Names of the strain components in their order.

    Args:
        group: `SE2()` or `SE3()`.

    Returns:
        The names, as `chebyshev` takes them.
    """
    return _PLANAR if group.space_dim == 2 else STRAINS
