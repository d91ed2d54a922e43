"""From design variables to densities of cells (symmetry, filter, projection), and stiffness
as a function of density.

References:
    Bendsoe, Sigmund, Topology Optimization, 2003.
    Stolpe, Svanberg, "An alternative interpolation scheme for minimum compliance topology
    optimization", Struct. Multidisc. Optim. 22, 2001.
"""

import abc
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax import _check
from sorojax._types import real
from sorojax.design.density.filters import (
    ConeFilter,
    HelmholtzFilter,
    cone_filter,
    heaviside_projection,
)
from sorojax.mesh.measure import cell_areas, cell_volumes
from sorojax.mesh.mesh import Mesh


class AbstractSymmetry(eqx.Module):
    """A rule that takes every point to the one that decides about it."""

    @abc.abstractmethod
    def fold(self, points: Float[np.ndarray, "n dim"]) -> Float[np.ndarray, "n dim"]:
        """Where the point lies whose density each point has [m]."""


class Mirrored(AbstractSymmetry):
    """The same on both sides of the plane across `axis` at `at` [m]."""

    axis: int = eqx.field(static=True)
    at: float = eqx.field(static=True)

    def fold(self, points):
        folded = points.copy()
        folded[:, self.axis] = self.at + np.abs(points[:, self.axis] - self.at)
        return folded


class Repeated(AbstractSymmetry):
    """The same in every strip of length `pitch` [m] along `axis`, the first one at `at` [m]."""

    axis: int = eqx.field(static=True)
    pitch: float = eqx.field(static=True)
    at: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        _check.positive("Repeated", "pitch", self.pitch, "m", "Give the length of a strip.")

    def fold(self, points):
        folded = points.copy()
        folded[:, self.axis] = self.at + np.mod(points[:, self.axis] - self.at, self.pitch)
        return folded


def shared_variables(
    mesh: Mesh, symmetries: Sequence[AbstractSymmetry]
) -> tuple[Int[np.ndarray, " cells"], int]:
    """The variable of every cell, and how many there are.

    Symmetries apply in their order: of a repeated and mirrored layout, repeat first.

    Raises:
        ValueError: If a cell has no counterpart: the mesh has not the symmetry.
    """
    from sorojax.math.host import KDTree

    centres = np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(axis=1)
    folded = centres
    for symmetry in symmetries:
        folded = symmetry.fold(folded)
    tree = KDTree(centres)
    away, owner = tree.query(folded)
    size = np.median(tree.query(centres, k=2)[0][:, 1]) if len(centres) > 1 else 1.0
    if np.max(away) > 0.1 * size:
        worst = int(np.argmax(away))
        raise ValueError(
            f"shared_variables: cell {worst} at {centres[worst]} m has its counterpart at "
            f"{folded[worst]} m, {away[worst] / size:.2g} of a cell away from the nearest "
            "centre, need less than 0.1. Mesh the part with the symmetry, or half of it."
        )
    owners, number = np.unique(owner, return_inverse=True)
    return number.ravel(), len(owners)


# From the variables of a design to the densities of its cells


class Layout(eqx.Module):
    """Variables -> symmetric -> smoothed -> projected -> densities, by `layout`.

    Called with `num_variables` numbers from 0 to 1 and the sharpness of the projection (`None`
    for none) it returns one density per cell. Cells of `solid` and `void` have theirs whatever
    the variables say. `number` is that of the variable of each cell, `smooth` the filter,
    `volumes` are those of the cells, areas in the plane, and `threshold` is that of the
    projection.
    """

    number: Int[Array, " cells"]
    smooth: ConeFilter | HelmholtzFilter | None
    solid: Bool[Array, " cells"]
    void: Bool[Array, " cells"]
    volumes: Float[Array, " cells"]
    threshold: Float[Array, ""] = eqx.field(converter=real)
    num_variables: int = eqx.field(static=True)

    def __call__(
        self, x: Float[Array, " variables"], sharpness: Any = None
    ) -> Float[Array, " cells"]:
        density = self._decided(x[self.number])
        if self.smooth is not None:
            density = self.smooth(density)
        if sharpness is not None:
            density = heaviside_projection(density, sharpness, self.threshold)
        return self._decided(density)

    def _decided(self, density):
        density = jnp.where(self.solid, jnp.ones_like(density), density)
        return jnp.where(self.void, jnp.zeros_like(density), density)

    def volume_fraction(self, density: Float[Array, " cells"]) -> Float[Array, ""]:
        """Volume of solid over that of the domain [-]."""
        return jnp.sum(self.volumes * density) / jnp.sum(self.volumes)

    def variables(self, density: Float[Array, " cells"]) -> Float[Array, " variables"]:
        """The variables whose cells have `density` on average, to start from."""
        total = jnp.zeros(self.num_variables).at[self.number].add(self.volumes)
        weighted = self.volumes * jnp.broadcast_to(real(density), self.volumes.shape)
        return jnp.zeros(self.num_variables).at[self.number].add(weighted) / total


def layout(
    mesh: Mesh,
    *,
    radius: float | None = None,
    smooth: ConeFilter | HelmholtzFilter | None = None,
    symmetries: Sequence[AbstractSymmetry] = (),
    solid: Int[Any, " cells"] = (),
    void: Int[Any, " cells"] = (),
    threshold: float = 0.5,
) -> Layout:
    """The map from design variables in [0, 1] to the densities of the cells of `mesh`.

    Symmetry, then a filter of weighted means, then a smoothed step (Heaviside projection).

    Args:
        mesh: The cells, points [m].
        radius: Radius of a cone filter [m]; no filter by default.
        smooth: Any filter in its place, a periodic one for example.
        symmetries: `Mirrored` and `Repeated`, applied in their order; none by default.
        solid: Numbers of the cells that are solid in every design; none by default.
        void: Numbers of the cells that are empty in every design; none by default.
        threshold: Filtered density at which the projection steps [-].

    Returns:
        A function of the variables, and of the sharpness of the projection, to one density per
        cell [-].

    Raises:
        ValueError: If `radius` and `smooth` are both given, a cell is solid and void, or the
            mesh does not have the symmetry.

    Example:
        >>> cells = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                        element=mesh.Quad4())
        >>> density = design.layout(cells, radius=15 * mm, solid=np.array([0]))
        >>> density(jnp.array([0.0, 0.0, 0.0, 1.0])).round(2).tolist()
        [1.0, 0.2, 0.2, 0.75]

    Reference:
        Wang, Lazarov and Sigmund, On projection methods, convergence and robust formulations in
        topology optimization, Struct. Multidisc. Optim. 43, 2011.
    """
    if radius is not None and smooth is not None:
        raise ValueError("layout: got `radius` and `smooth`, need at most one. Drop one.")
    _check.between("layout", "threshold", threshold, 0.0, 1.0, "", "0.5 is usual.")
    masks = [_mask(mesh, name, ids) for name, ids in (("solid", solid), ("void", void))]
    if np.any(masks[0] & masks[1]):
        raise ValueError(
            f"layout: cell {int(np.argmax(masks[0] & masks[1]))} is in `solid` and in `void`, "
            "need one of them. Take it out of the other."
        )
    number, count = shared_variables(mesh, symmetries)
    volumes = cell_areas(mesh) if mesh.element.dim == 2 else cell_volumes(mesh)
    if radius is not None:
        smooth = cone_filter(mesh, radius)
    return Layout(
        jnp.asarray(number, jnp.int32),
        smooth,
        jnp.asarray(masks[0]),
        jnp.asarray(masks[1]),
        volumes,
        threshold,
        count,
    )


def _mask(mesh: Mesh, name: str, ids) -> Bool[np.ndarray, " cells"]:
    ids = np.asarray(ids, int).ravel()
    if ids.size and (ids.min() < 0 or ids.max() >= mesh.num_cells):
        raise ValueError(
            f"layout: `{name}` has cells from {ids.min()} to {ids.max()}, need 0 to "
            f"{mesh.num_cells - 1}. Find them with mesh.cells_where on the same mesh."
        )
    return np.isin(np.arange(mesh.num_cells), ids)


# Stiffness as a function of density


class Simp(eqx.Module):
    """least + (1 - least) density^penalty, as a factor of the full stiffness.

    Attributes:
        penalty: Exponent; 3 makes grey material uneconomic.
        least: Factor of the void, so that the tangent has an inverse.
    """

    penalty: Float[Array, ""] = eqx.field(converter=real, default=3.0)
    least: Float[Array, ""] = eqx.field(converter=real, default=1e-9)

    def __call__(self, density: Float[Array, " cells"]) -> Float[Array, " cells"]:
        # 0^penalty has no finite derivative of all orders
        safe = jnp.maximum(density, 1e-12)
        return self.least + (1 - self.least) * safe**self.penalty


class Ramp(eqx.Module):
    """least + (1 - least) density / (1 + q (1 - density)): has a slope at zero density.

    Attributes:
        q: 0 is linear; 8 is about as severe as `Simp(3)`.
        least: Factor of the void.
    """

    q: Float[Array, ""] = eqx.field(converter=real, default=8.0)
    least: Float[Array, ""] = eqx.field(converter=real, default=1e-9)

    def __call__(self, density: Float[Array, " cells"]) -> Float[Array, " cells"]:
        return self.least + (1 - self.least) * density / (1 + self.q * (1 - density))
