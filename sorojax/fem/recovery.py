"""Continuous stresses at the nodes by superconvergent patch recovery, and energy per cell.

Reference: Zienkiewicz, Zhu, "The superconvergent patch recovery and a posteriori error
estimates, part 1", IJNME 33, 1992.
"""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._types import is_traced
from sorojax.fem.energy import energy_density
from sorojax.fem.energy_form import body_at
from sorojax.fem.points import deformation, points_at, quadrature_points
from sorojax.fem.problem import Problem
from sorojax.fem.stress import stress_at
from sorojax.fem.tables import Tables
from sorojax.mesh.elements import AbstractElement, Hex8, PolyN, Quad4, Quad8, Quad9
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.shape import quadrature, shape_functions, shape_gradients


class Patches(NamedTuple):
    """For every node the samples of the cells around it, as cell times samples per cell
    plus sample, and the weights that add up to the value there; padded by zero weights."""

    samples: Int[Array, "nodes patch"]
    weights: Float[Array, "nodes patch"]

    def __call__(
        self, field: Float[Array, "cells samples *value"]
    ) -> Float[Array, "nodes *value"]:
        """Nodal values of a field given at the samples; differentiable in the field."""
        flat = field.reshape(-1, *field.shape[2:])
        return jnp.einsum("np,np...->n...", self.weights, flat[self.samples])


def patches(mesh: Mesh) -> Patches:
    """Patches of `mesh`, for fields at its `sample_points` (on the host, once per mesh).

    A polynomial of the order of the element is fitted to the samples of the cells that
    share a node, of one more ring of cells where these are too few; so a field of that
    order is recovered exactly, also on the boundary.

    Raises:
        ValueError: If the mesh is traced, has polygons, or too few cells for a fit.
    """
    if is_traced(mesh) or isinstance(mesh.element, PolyN):
        raise ValueError(
            "fem.patches: need concrete triangles, quadrilaterals or solid cells, got a "
            f"{'traced' if is_traced(mesh) else 'polygonal'} mesh. Use fem.nodal_average."
        )
    cells, points = np.asarray(mesh.cells), np.asarray(mesh.points)
    at = np.einsum("qa,cai->cqi", _sample_table(mesh.element).values[0], points[cells])
    rings = _rings(mesh, cells)
    powers = _powers(mesh.element)
    found = [_fit(points[node], at, rings(node, at.shape[1], len(powers)), powers)
             for node in range(mesh.num_nodes)]  # fmt: skip
    most = max(len(samples) for samples, _ in found)
    samples = np.zeros((mesh.num_nodes, most), np.int32)
    weights = np.zeros((mesh.num_nodes, most))
    for node, (ids, share) in enumerate(found):
        samples[node, : len(ids)], weights[node, : len(ids)] = ids, share
    return Patches(jnp.asarray(samples), jnp.asarray(weights))


def nodal_stress(
    problem: Problem, u: Float[Array, "nodes dim"], fit: Patches | None = None
) -> Float[Array, "nodes 3 3"]:
    """Cauchy stress [Pa] at the nodes, continuous, better than a mean on the boundary.

    Inside a uniform mesh `nodal_average` is of the same order and may be closer.
    At an interface of two materials, where stress jumps, it is smoothed. Pass
    `patches(problem.mesh)` to compute them once for many states.
    """
    fit = patches(problem.mesh) if fit is None else fit
    points = points_at(problem.mesh, problem.kinematics, _sample_table(problem.mesh.element))
    return fit(stress_at(problem, u, points))


def strain_energy(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, " cells"]:
    """Stored energy of every cell [J]."""
    points = quadrature_points(problem.mesh, problem.kinematics)
    F = deformation(problem.mesh, problem.kinematics, points, u)
    return jnp.sum(points.volumes * energy_density(body_at(problem, points), F), axis=0)


def sample_points(mesh: Mesh) -> Float[Array, "cells samples dim"]:
    """Where the stresses of a cell are best [m]: its points of reduced integration."""
    values = jnp.asarray(_sample_table(mesh.element).values[0])
    return jnp.einsum("qa,cai->cqi", values, mesh.points[mesh.cells])


def _sample_table(element: AbstractElement) -> Tables:
    if isinstance(element, Quad4 | Quad8 | Quad9 | Hex8):
        line = np.array([0.0]) if element.order == 1 else np.array([-1.0, 1.0]) / np.sqrt(3)
        at = np.array(list(itertools.product(line, repeat=element.dim)))
    else:
        at = quadrature(element, element.order).points
    tables = shape_functions(element, at), shape_gradients(element, at), np.ones(len(at))
    return Tables(*(table[None] for table in tables))


def _powers(element: AbstractElement) -> np.ndarray:
    """Exponents of the polynomials up to the order of the element."""
    grid = itertools.product(range(element.order + 1), repeat=element.dim)
    return np.array([p for p in grid if sum(p) <= element.order])


def _rings(mesh: Mesh, cells: np.ndarray):
    """The cells around a node, grown until a fit has half as many samples again as needed."""
    order = np.argsort(cells.ravel(), kind="stable")
    starts = np.searchsorted(cells.ravel()[order], np.arange(mesh.num_nodes + 1))
    owners = order // cells.shape[1]

    def around(nodes):
        return np.unique(np.concatenate([owners[starts[n] : starts[n + 1]] for n in nodes]))

    def grown(node, samples_per_cell, needed):
        own = around([node])
        while len(own) and len(own) * samples_per_cell < 1.5 * needed:
            more = around(np.unique(cells[own]))
            if len(more) == len(own):
                break
            own = more
        return own

    return grown


def _fit(point, at, own, powers) -> tuple[np.ndarray, np.ndarray]:
    """Samples of the cells `own` and their weights in the least squares fit at `point`."""
    if not len(own):  # a node without cells
        return np.zeros(0, int), np.zeros(0)
    place = at[own].reshape(-1, at.shape[2]) - point
    place = place / np.abs(place).max()
    basis = np.prod(place[:, None] ** powers[None], axis=2)
    constant = np.flatnonzero(powers.sum(axis=1) == 0)[0]
    ids = (own[:, None] * at.shape[1] + np.arange(at.shape[1])).ravel()
    return ids, np.linalg.pinv(basis, rcond=1e-8)[constant]
