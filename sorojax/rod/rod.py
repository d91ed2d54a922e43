"""The rod: what a user chose about it, and nothing else."""

from typing import Generic, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import optional_real, real
from sorojax.material.hyperelastic import AbstractHyperelastic, small_strain_moduli
from sorojax.math.lie import SE2, SE3
from sorojax.rod.basis import STRAINS, StrainBasis
from sorojax.rod.section import Section

G = TypeVar("G", SE2, SE3)

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
        _check.between(where, "poisson_ratio", self.poisson_ratio, -1, 0.5 + 1e-12, "-", do)


def elastic(material: AbstractHyperelastic) -> Elastic:
    """Small-strain constants of a hyperelastic material.

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
        rest_strain: Constant curvatures [1/m], then stretch and shears [-], or None.
        nodes: Number of Gauss nodes along the rod.
    """

    group: G
    basis: StrainBasis
    section: Section
    material: Elastic
    length: Float[Array, ""] = eqx.field(converter=real)
    rest_strain: Float[Array, " strain"] | None = eqx.field(converter=optional_real)
    nodes: int = eqx.field(static=True)

    def __check_init__(self):
        _check.positive("rod", "length", self.length, "m", "Give the rest length.")
        names = strain_names(self.group)
        wrong = [name for name in self.basis.active if name not in names]
        if wrong:
            raise ValueError(
                f"rod: the basis activates {', '.join(wrong)}, {type(self.group).__name__} "
                f"has {', '.join(names)}. A planar rod bends about z; use SE3() otherwise."
            )
        if self.rest_strain is not None:
            do = f"Give one value per strain: {', '.join(names)}; stretch rests at 1."
            _check.shape("rod", "rest_strain", self.rest_strain, (len(names),), do)


def rod(
    group: G,
    basis: StrainBasis,
    section: Section,
    material: Elastic | None = None,
    *,
    length,
    young_modulus=None,
    poisson_ratio=None,
    density=None,
    rest_strain=None,
    nodes: int | None = None,
) -> Rod[G]:
    """A rod from a basis, a section and a material or its three constants.

    Args:
        group: `SE2()` for a planar, `SE3()` for a spatial rod.
        basis: Active strains and their modes, e.g. `chebyshev(kappa_z=3)`.
        section: e.g. `circle(6 * mm)`.
        material: `Elastic` constants; otherwise give the three that follow.
        length: Rest length [m].
        young_modulus: [Pa].
        poisson_ratio: [-].
        density: [kg/m^3].
        rest_strain: Constant strain of the unloaded rod, curvatures [1/m] first.
        nodes: Gauss nodes; by default what resolves the modes. Add some when the rod
            turns by more than half a turn.
    """
    if material is None:
        given = {
            "young_modulus": young_modulus,
            "poisson_ratio": poisson_ratio,
            "density": density,
        }
        missing = [name for name, value in given.items() if value is None]
        if missing:
            raise ValueError(
                f"rod: got no `material` and no {', '.join(missing)}; need all three "
                "constants. Write young_modulus=1 * MPa, poisson_ratio=0.49, density=1070."
            )
        material = Elastic(young_modulus, poisson_ratio, density)
    nodes = basis.resolution if nodes is None else nodes
    if nodes < 2:
        raise ValueError(f"rod: `nodes` must be 2 or more, got {nodes}. 8 suit 3 modes.")
    return Rod(group, basis, section, material, length, rest_strain, nodes)


def strain_names(group: SE2 | SE3) -> tuple[str, ...]:
    """Names of the strain components in their order."""
    return _PLANAR if group.space_dim == 2 else STRAINS
