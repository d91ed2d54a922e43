"""Fields at points of all cells at once, made for differentiation by parameters.

One product takes nodal values to reference gradients; the rest is elementwise, with
entries of shape (points, cells).
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax.fem.assembly.energy import Entries, inverse
from sorojax.fem.assembly.geometry import (
    Tables,
    exact_areas,
    node_tables,
    polygon_sums,
    quadrature_tables,
    three,
)
from sorojax.fem.assembly.space import AbstractFormulation, Modes, modes
from sorojax.fem.kinematics import AbstractKinematics, identity
from sorojax.material.kinematics import Entry, Tensor, determinant
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.mesh import Mesh


class Points(NamedTuple):
    """Points of all cells: inverse of dX/dxi, reference volumes [m^3] and positions [m]."""

    back: Tensor
    volumes: Float[Array, "quad cells"]
    position: Float[Array, "dim quad cells"]
    tables: Tables
    kinds: Int[Array, " cells"] | None


def quadrature_points(mesh: Mesh, kinematics: AbstractKinematics) -> Points:
    """The quadrature points of the stiffness."""
    return _points(mesh, kinematics, quadrature_tables(mesh.element))


def node_points(mesh: Mesh, kinematics: AbstractKinematics) -> Points:
    """The nodes of every cell; their volumes mean nothing."""
    return _points(mesh, kinematics, node_tables(mesh.element))


def points_of(mesh: Mesh, kinematics: AbstractKinematics, tables: Tables) -> Points:
    """The points of another rule, one table for all cells or one per kind of polygon."""
    return _points(mesh, kinematics, tables)


def points_at(mesh: Mesh, kinematics: AbstractKinematics, tables: Tables) -> Points:
    """The points of every cell that `tables` are for."""
    return _points(mesh, kinematics, tables)


def pressure_modes(formulation: AbstractFormulation, points: Points) -> Modes | None:
    """Orthonormal pressure functions at the quadrature points of all cells."""
    return modes(formulation, points.position, points.volumes)


def _points(mesh: Mesh, kinematics: AbstractKinematics, tables: Tables) -> Points:
    kinds = None
    if isinstance(mesh.element, PolyN):  # the number of corners; the last is repeated
        kinds = 1 + jnp.sum(mesh.cells[:, 1:] != mesh.cells[:, :-1], axis=1)
    x = _by_cell(mesh, mesh.points)
    jac = _slopes(tables, kinds, x)
    full = three([[jac[i, d] for d in range(mesh.element.dim)] for i in range(len(jac))])
    weights = _of_cells(tables.weights.astype(x.dtype), kinds)
    areas = determinant(full) * weights
    position = _interpolate(tables, kinds, x)
    if kinds is not None:
        areas = exact_areas(polygon_sums(x, kinds, kinematics), position, areas)
    volumes = areas * kinematics.depth(tuple(position))
    return Points(inverse(full), volumes, position, tables, kinds)


def deformation(
    mesh: Mesh, kinematics: AbstractKinematics, points: Points, u: Float[Array, "nodes dim"]
) -> Entries:
    """Kept entries of F at the points."""
    dim = mesh.element.dim
    by_cell = _by_cell(mesh, u)
    reference = _slopes(points.tables, points.kinds, by_cell)
    slopes = [
        [
            functools.reduce(jnp.add, (reference[i, d] * points.back[d][j] for d in range(dim)))
            for j in range(dim)
        ]
        for i in range(dim)
    ]
    if points.kinds is not None:
        slopes = _corrected(mesh, kinematics, points, by_cell, slopes)
    if kinematics.num_columns > dim:
        radial = _interpolate(points.tables, points.kinds, by_cell[:1])[0]
        slopes[0].append(radial / points.position[0])
    kept = jnp.stack([slopes[s.component][s.column] for s in kinematics.slots])
    return kept + jnp.asarray(identity(kinematics), kept.dtype)[:, None, None]


def interpolated(mesh: Mesh, points: Points, nodal: Float[Array, "nodes dim"]) -> Entry:
    """A nodal field at the points, (dim, quad, cells)."""
    return _interpolate(points.tables, points.kinds, _by_cell(mesh, nodal))


def _corrected(mesh: Mesh, kinematics: AbstractKinematics, points: Points, by_cell, slopes):
    """Polygons: slopes whose mean over a cell is that of its boundary."""
    kinds = points.kinds
    assert kinds is not None
    sums = polygon_sums(_by_cell(mesh, mesh.points), kinds, kinematics)
    areas = points.volumes / kinematics.depth(tuple(points.position))
    share = sums.shares(points.position, areas)
    inside = jnp.sum(areas[None] * _interpolate(points.tables, kinds, by_cell), axis=1)

    def fixed(i, j):
        exact = jnp.sum(by_cell[i] * sums.sides[j], axis=0) - sums.hoop(j) * inside[i]
        mean = jnp.sum(share * slopes[i][j], axis=0)
        return slopes[i][j] + (exact / sums.measure[0] - mean)[None]

    return [[fixed(i, j) for j in range(2)] for i in range(2)]


def _by_cell(mesh: Mesh, nodal: Float[Array, "nodes dim"]):
    return jnp.moveaxis(nodal.T[:, mesh.cells], -1, 1)  # dim, nodes, cells


def _slopes(tables: Tables, kinds, by_cell) -> Float[Array, "dim dim_ref quad cells"]:
    dtype = by_cell.dtype
    if kinds is None:
        return jnp.einsum("qad,iac->idqc", jnp.asarray(tables.slopes[0], dtype), by_cell)
    return jnp.einsum("cqad,iac->idqc", jnp.asarray(tables.slopes, dtype)[kinds], by_cell)


def _interpolate(tables: Tables, kinds, by_cell) -> Float[Array, "dim quad cells"]:
    dtype = by_cell.dtype
    if kinds is None:
        return jnp.einsum("qa,iac->iqc", jnp.asarray(tables.values[0], dtype), by_cell)
    return jnp.einsum("cqa,iac->iqc", jnp.asarray(tables.values, dtype)[kinds], by_cell)


def _of_cells(table: np.ndarray, kinds):
    if kinds is None:
        return jnp.asarray(table[0])[:, None]
    return jnp.asarray(table)[kinds].T
