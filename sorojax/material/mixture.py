"""Scaled and mixed materials, and materials that differ from region to region."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._types import real
from sorojax.material import checks
from sorojax.material.hyperelastic import (
    AbstractHyperelastic,
    first_invariant_energy,
    rest_stretches,
)
from sorojax.material.kinematics import Entry, Tensor


class Scaled(AbstractHyperelastic):
    """`factor` times the energy of `base`: a stiffer layer, or element densities.

    `factor` is a number or one number per cell.
    """

    base: AbstractHyperelastic
    factor: Float[Array, "..."] = eqx.field(converter=real)

    def __check_init__(self):
        checks.leaves("Scaled", self)
        _check.positive("Scaled", "factor", self.factor, "", "Remove cells instead.")

    @property
    def density(self):  # the mass is that of the base
        return self.base.density

    def isochoric_energy(self, F: Tensor) -> Entry:
        return self.factor * self.base.isochoric_energy(F)

    def volumetric_energy(self, J: Entry) -> Entry:
        return self.factor * self.base.volumetric_energy(J)


@rest_stretches.register
def _(material: Scaled):
    return rest_stretches(material.base)


@first_invariant_energy.register
def _(material: Scaled):
    base = first_invariant_energy(material.base)
    return None if base is None else lambda x: material.factor * base(x)


class Mixed(AbstractHyperelastic):
    """sum_i weight_i Psi_i: shares of a composite, or 1 and 0 for cells of a region.

    `weights` are the shares [-] of the `materials`, each a number or one per cell of the mesh.
    Every energy is evaluated everywhere, so two materials cost twice as much as one.
    """

    materials: tuple[AbstractHyperelastic, ...]
    weights: tuple[Float[Array, "..."], ...] = eqx.field(converter=checks.reals)

    def __check_init__(self):
        if len(self.materials) != len(self.weights) or not self.materials:
            raise ValueError(
                f"Mixed: got {len(self.materials)} materials and {len(self.weights)} weights, "
                "need one weight per material, at least one."
            )
        checks.leaves("Mixed", self)
        do = "Negative stiffness has no equilibrium: weights are shares from 0 to 1."
        for weight in self.weights:
            _check.finite("Mixed", "weights", weight, do)
            _check.not_negative("Mixed", "weights", weight, "", do)

    @property
    def density(self):
        if any(material.density is None for material in self.materials):
            return None
        return self._mean([material.density for material in self.materials])

    def _mean(self, values) -> Entry:
        first, *others = [w * v for w, v in zip(self.weights, values, strict=True)]
        return sum(others, start=first)

    def isochoric_energy(self, F: Tensor) -> Entry:
        return self._mean([material.isochoric_energy(F) for material in self.materials])

    def volumetric_energy(self, J: Entry) -> Entry:
        return self._mean([material.volumetric_energy(J) for material in self.materials])


@rest_stretches.register
def _(material: Mixed):  # by weight; exact where one material has all of it
    stretches = zip(*(rest_stretches(part) for part in material.materials), strict=True)
    total = material._mean([1.0] * len(material.weights))
    return tuple(material._mean(values) / total for values in stretches)


def by_region(
    num_cells: int,
    regions: Mapping[str, Int[Any, " cells"]],
    base: AbstractHyperelastic,
    materials: Mapping[str, AbstractHyperelastic],
) -> AbstractHyperelastic:
    """One material for the whole mesh with other materials in some regions.

    Materials of one class become that class with one number per cell, at no extra cost;
    of different classes a `Mixed` with weights 1 and 0, which evaluates each class once.

    Args:
        num_cells: Number of cells of the mesh.
        regions: Cell numbers of every named region; names without a material keep `base`.
        base: Material of all other cells.
        materials: Material of a region by its name.

    Returns:
        A material whose parameters have one entry per cell, or a `Mixed`.

    Raises:
        ValueError: If a name is unknown, cells lie outside the mesh or in two regions,
            or only some of the materials have a density.

    Example:
        >>> soft = material.neo_hookean(young_modulus=1e5, poisson_ratio=0.45)
        >>> stiff = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45)
        >>> body = material.by_region(4, {"layer": np.array([0, 1])}, soft, {"layer": stiff})
        >>> (body.shear_modulus / kPa).round(1).tolist()
        [344.8, 344.8, 34.5, 34.5]
    """
    members = _members(num_cells, regions, materials)
    known = [m.density is not None for m in (base, *materials.values())]
    if any(known) and not all(known):
        raise ValueError(
            "by_region: some materials have a density and some have none, need all or none. "
            "Give `density` [kg/m^3] to each."
        )
    groups: list[tuple[AbstractHyperelastic, np.ndarray]] = [(base, np.ones(num_cells, bool))]
    for name, other in materials.items():
        cells = members[name]
        groups = [(m, where & ~cells) for m, where in groups]
        for k, (m, where) in enumerate(groups):
            if jax.tree.structure(m) == jax.tree.structure(other):
                groups[k] = (_merged(num_cells, m, other, cells), where | cells)
                break
        else:
            groups.append((other, cells))
    if len(groups) == 1:
        return groups[0][0]
    return Mixed(tuple(m for m, _ in groups), tuple(where.astype(float) for _, where in groups))


def _merged(num_cells: int, inside, other, cells: np.ndarray) -> AbstractHyperelastic:
    def leaf(a, b):
        return jnp.where(cells, jnp.broadcast_to(b, num_cells), jnp.broadcast_to(a, num_cells))

    return jax.tree.map(leaf, inside, other)


def _members(num_cells: int, regions, materials) -> dict[str, np.ndarray]:
    unknown = [name for name in materials if name not in regions]
    if unknown:
        raise ValueError(
            f"by_region: no region is called {unknown[0]!r}, the mesh has "
            f"{sorted(regions)}. Name the region when you draw it."
        )
    members, taken = {}, np.zeros(num_cells, bool)
    for name in materials:
        ids = np.asarray(regions[name])
        if not np.issubdtype(ids.dtype, np.integer) or ids.ndim != 1:
            raise ValueError(
                f"by_region: region {name!r} has shape {ids.shape} of {ids.dtype}, need a "
                "list of cell numbers. Turn a mask into numbers with np.flatnonzero."
            )
        if len(ids) == 0 or ids.min() < 0 or ids.max() >= num_cells:
            raise ValueError(
                f"by_region: region {name!r} has {len(ids)} cells, need at least one and "
                f"numbers from 0 to {num_cells - 1}. Select them on the same mesh."
            )
        members[name] = np.isin(np.arange(num_cells), ids)
        if np.any(taken & members[name]):
            raise ValueError(
                f"by_region: cell {np.flatnonzero(taken & members[name])[0]} of region "
                f"{name!r} is in another region too, need disjoint regions. Take it out of one."
            )
        taken |= members[name]
    return members
