"""Filters and projections between design variables and densities.

References:
    Bourdin, "Filters in topology optimization", Int. J. Numer. Meth. Engng 50, 2001.
    Lazarov, Sigmund, "Filters in topology optimization based on Helmholtz-type
    differential equations", Int. J. Numer. Meth. Engng 86, 2011.
    Wang, Lazarov, Sigmund, "On projection methods, convergence and robust formulations
    in topology optimization", Struct. Multidisc. Optim. 43, 2011.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.math.linalg import sparse
from sorojax.mesh.elements.simplex import Tri3
from sorojax.mesh.elements.tensor import Quad4
from sorojax.mesh.mesh import Mesh


class ConeFilter(eqx.Module):
    """Means over neighbours, weighed by how much nearer than the radius they are.

    Made by `cone_filter`: cell `first` of each pair takes the value of cell `second` times
    `weights` [-], whose sum is one for each cell. Called with one number per cell it returns
    one per cell.
    """

    first: Int[Array, " pairs"]
    second: Int[Array, " pairs"]
    weights: Float[Array, " pairs"]

    def __call__(self, x: Float[Array, " cells"]) -> Float[Array, " cells"]:
        return jnp.zeros_like(x).at[self.first].add(self.weights * x[self.second])


def cone_filter(
    mesh: Mesh,
    radius: float,
    *,
    volumes: Numbers | None = None,
    periods: tuple[float | None, ...] | None = None,
) -> ConeFilter:
    """The filter of `radius` [m] between the centres of cells.

    Args:
        mesh: The cells.
        radius: Where the weight becomes zero [m]; less than a cell does nothing.
        volumes: Volumes of the cells, where they differ much.
        periods: By axis, the length [m] after which the layout repeats, `None` where it
            does not: cells at one end are then neighbours of those at the other.

    Returns:
        A function of the values of the cells.

    Raises:
        ValueError: If a period is shorter than two radii or than the mesh.
    """
    _check.positive("cone_filter", "radius", radius, "m", "About two cells is usual.")
    centres = np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(axis=1)
    lengths = _periods("cone_filter", mesh, periods, 2 * radius)
    first, second, away = _pairs(centres, float(radius), lengths)
    weights = radius - away
    if volumes is not None:
        weights = weights * np.asarray(volumes)[second]
    total = np.zeros(len(centres))
    np.add.at(total, first, weights)
    weights = weights / total[first]
    return ConeFilter(
        jnp.asarray(first, jnp.int32), jnp.asarray(second, jnp.int32), jnp.asarray(weights)
    )


def _periods(where: str, mesh: Mesh, periods, least: float) -> np.ndarray:
    """Period by axis, 0 where there is none."""
    found = np.array([p or 0.0 for p in periods or (None,) * mesh.element.dim])
    span = np.ptp(np.asarray(mesh.points), axis=0)
    if found.shape != span.shape or np.any(
        (found != 0) & (found < np.maximum((1 - 1e-9) * span, least))
    ):
        raise ValueError(
            f"{where}: got periods {periods} m, need one per axis, `None` or at least the "
            f"length {span} m of the mesh and {least:g} m. Give the length of the cell that "
            "repeats."
        )
    return found


def _pairs(centres: np.ndarray, radius: float, periods: np.ndarray):
    """Cells, their neighbours (themselves too) within `radius`, and how far away they are."""
    from sorojax.math.host import KDTree

    shifts = np.array(list(itertools.product(*([-p, 0.0, p] if p else [0.0] for p in periods))))
    owners, images = np.arange(len(centres)), centres
    if len(shifts) > 1:
        images = (centres[None] + shifts[:, None]).reshape(-1, centres.shape[1])
        owners = np.tile(owners, len(shifts))
    near = KDTree(centres).sparse_distance_matrix(
        KDTree(images), radius, output_type="coo_matrix"
    )
    return near.row, owners[near.col], near.data


class HelmholtzFilter(eqx.Module):
    """The solution y of y - l^2 laplace(y) = x with no flux through the boundary, or the
    same on both sides of a layout that repeats.

    Made by `helmholtz_filter`; costs one back-substitution, whatever the radius. `system` and
    `values` are the matrix between the nodes, `cells` the nodes of the cells, and `shares` what
    a cell gives each of them.
    """

    system: sparse.SparseSymmetric
    values: Float[Array, " nnz"]
    cells: Int[Array, "cells nodes"]
    shares: Float[Array, "cells nodes"]

    def __call__(self, x: Float[Array, " cells"]) -> Float[Array, " cells"]:
        nodal = jnp.zeros(self.system.size, x.dtype)
        nodal = nodal.at[self.cells].add(self.shares * x[:, None])
        solved = sparse.solve(self.system, self.values, nodal)
        total = jnp.sum(self.shares, axis=1)
        return jnp.sum(self.shares * solved[self.cells], axis=1) / total


def helmholtz_filter(
    mesh: Mesh, radius: float, *, periods: tuple[float | None, ...] | None = None
) -> HelmholtzFilter:
    """The filter that smooths like a cone filter of `radius` [m]: l = radius / (2 sqrt 3).

    Args:
        mesh: The cells.
        radius: Of the cone filter that smooths as much [m].
        periods: By axis, the length of the mesh [m] where the layout repeats after it,
            `None` where it does not. Nodes at both ends have to lie opposite each other.

    Returns:
        A function of the values of the cells.

    Raises:
        ValueError: If the cells are not Tri3 or Quad4, or the ends of a period do not match.
    """
    from sorojax.mesh.elements.base import quadrature, shape_functions, shape_gradients

    _check.positive("helmholtz_filter", "radius", radius, "m", "About two cells is usual.")
    if not isinstance(mesh.element, Tri3 | Quad4):
        raise ValueError(
            f"helmholtz_filter: got {mesh.element.name} cells, need Tri3 or Quad4. Use "
            "cone_filter."
        )
    at, weights = quadrature(mesh.element, 2)
    N, dN = shape_functions(mesh.element, at), shape_gradients(mesh.element, at)
    X = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    J = np.einsum("qaj,cai->cqij", dN, X)
    volume = np.linalg.det(J) * weights
    G = np.einsum("qaj,cqji->cqai", dN, np.linalg.inv(J))
    length = radius / (2 * np.sqrt(3))
    matrix = length**2 * np.einsum("cqai,cqbi,cq->cab", G, G, volume)
    matrix += np.einsum("qa,qb,cq->cab", N, N, volume)
    number = _joined_nodes(mesh, _periods("helmholtz_filter", mesh, periods, 0.0))
    cells = number[np.asarray(mesh.cells)]
    system = sparse.from_cells(int(number.max()) + 1, cells)
    return HelmholtzFilter(
        system,
        jnp.asarray(sparse.assembled_on_host(system, matrix)),
        jnp.asarray(cells, jnp.int32),
        jnp.asarray(np.einsum("qa,cq->ca", N, volume)),
    )


def _joined_nodes(mesh: Mesh, periods: np.ndarray) -> Int[np.ndarray, " nodes"]:
    """A number for every node, the same at both ends of a period."""
    from sorojax.math.host import KDTree

    points = np.asarray(mesh.points)
    low, size = points.min(axis=0), np.ptp(points)
    owner, tree = np.arange(len(points)), KDTree(points)
    for axis in np.flatnonzero(periods):
        shift = np.zeros(len(low))
        shift[axis] = periods[axis]
        end = np.flatnonzero(np.abs(points[:, axis] - low[axis] - shift[axis]) < 1e-6 * size)
        away, opposite = tree.query(points[end] - shift)
        if not len(end) or np.max(away) > 1e-6 * size:
            raise ValueError(
                f"helmholtz_filter: the nodes of the mesh do not repeat after {shift[axis]:g} "
                f"m along axis {axis}. Give the length of the mesh, and mesh both ends alike."
            )
        owner[end] = owner[opposite]
    number = np.unique(owner, return_inverse=True)[1].ravel()
    twice = np.sort(number[np.asarray(mesh.cells)], axis=1)
    if np.any(twice[:, 1:] == twice[:, :-1]):
        raise ValueError(
            "helmholtz_filter: a cell reaches from one end of a period to the other, need at "
            "least two cells. Refine the mesh."
        )
    return number


def heaviside_projection(
    x: Float[Array, "..."], sharpness: Numbers, threshold: Float[Array, ""] | float = 0.5
) -> Float[Array, "..."]:
    """Pushes densities to 0 and 1: a smooth step at `threshold`, the steeper the larger
    `sharpness` (1 does next to nothing, 16 and more make black and white).

    Args:
        x: Densities, 0 to 1.
        sharpness: Of the step [-].
        threshold: Density that becomes one half [-].

    Returns:
        Densities, 0 to 1.
    """
    settings = (s if isinstance(s, float) else real(s) for s in (sharpness, threshold))
    return _projected(real(x), *settings)


@jax.jit
def _projected(x, beta, eta):
    low, high = jnp.tanh(beta * eta), jnp.tanh(beta * (1 - eta))
    return (low + jnp.tanh(beta * (x - eta))) / (low + high)


def greyness(density: Float[Array, " cells"]) -> Float[Array, ""]:
    """Mean of 4 d (1 - d): 0 for black and white, 1 for all grey [-].

    Args:
        density: Of every cell, 0 to 1.

    Returns:
        The mean [-].
    """
    return jnp.mean(4 * density * (1 - density))


def sensitivity_filtered(
    smooth: ConeFilter, x: Float[Array, " cells"], gradient: Float[Array, " cells"]
) -> Float[Array, " cells"]:
    """Sigmund's filter of the gradient itself, a heuristic: not the derivative of anything.

    Args:
        smooth: From `cone_filter`.
        x: Densities.
        gradient: Of the objective by `x`.

    Returns:
        The filtered gradient.

    Reference: Sigmund, "A 99 line topology optimization code written in Matlab", Struct.
    Multidisc. Optim. 21, 2001.
    """
    return smooth(x * gradient) / jnp.maximum(1e-3, x)
