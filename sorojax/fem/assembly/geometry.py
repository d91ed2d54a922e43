"""Shape tables, fields at points of all cells, and shape gradients in blocks of cells.

Polygons have one table per number of corners. Their shape functions are rational, so no rule
integrates them exactly; gradients are corrected by integrals over straight sides, so that a
linear displacement is an equilibrium.

Reference: Talischi, Pereira, Menezes, Paulino, "Gradient correction for polygonal and
polyhedral finite elements", IJNME 102, 2015.
"""

import functools
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._jax.jit import once
from sorojax.fem.assembly.energy import Entries, inverse
from sorojax.fem.assembly.space import AbstractFormulation, Space, lanes, modes
from sorojax.fem.kinematics import AbstractKinematics, Axisymmetric, identity
from sorojax.material.kinematics import Entry, Tensor, determinant
from sorojax.mesh.elements.base import (
    AbstractElement,
    Quadrature,
    nodes,
    quadrature,
    shape_functions,
    shape_gradients,
)
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.mesh import Mesh


class Tables(NamedTuple):
    """Shape functions, their slopes and weights at reference points, by kind of cell.

    Polygons have a kind per number of corners, padded by points of no weight; every other
    element has one kind.
    """

    values: Float[np.ndarray, "kinds quad cell_nodes"]
    slopes: Float[np.ndarray, "kinds quad cell_nodes dim"]
    weights: Float[np.ndarray, "kinds quad"]


@cache
def tables_at(element: AbstractElement, at: str) -> Tables:
    """Tables at the points of the rule of the stiffness ("quadrature"), of that of the mass
    ("mass"), or at the nodes ("nodes")."""
    if not isinstance(element, PolyN):
        rule = _rule(element, at)
        values, slopes = _at(element, rule)
        return Tables(values[None], slopes[None], rule.weights[None])
    kinds = [PolyN(max(n, 3)) for n in range(element.sides + 1)]
    rules = [_rule(kind, at) for kind in kinds]
    most = max(len(rule.weights) for rule in rules)
    rows = [
        _padded(kind, rule, most, element.sides)
        for kind, rule in zip(kinds, rules, strict=True)
    ]
    return Tables(*(np.stack(column) for column in zip(*rows, strict=True)))


def _rule(element: AbstractElement, at: str) -> Quadrature:
    if at == "quadrature":
        return quadrature(element)
    if at == "mass":
        return element.mass_quadrature()
    return Quadrature(nodes(element), np.ones(element.num_nodes))


def _at(element: AbstractElement, rule: Quadrature) -> tuple[np.ndarray, np.ndarray]:
    return shape_functions(element, rule.points), shape_gradients(element, rule.points)


def _padded(kind: AbstractElement, rule: Quadrature, num_points: int, num_nodes: int):
    """Tables with the last point repeated without weight, and nodes that do nothing."""
    values, slopes = _at(kind, rule)
    more = num_points - len(rule.weights)
    values = np.pad(
        np.concatenate([values, values[-1:].repeat(more, 0)]),
        ((0, 0), (0, num_nodes - kind.num_nodes)),
    )
    slopes = np.pad(
        np.concatenate([slopes, slopes[-1:].repeat(more, 0)]),
        ((0, 0), (0, num_nodes - kind.num_nodes), (0, 0)),
    )
    return values, slopes, np.pad(rule.weights, (0, more))


# Sums over polygons that their quadrature has to get right


class PolygonSums(NamedTuple):
    """Area [m^2], first moments [m^3] and, by axis, the integrals of each shape function
    times the normal over the sides of a polygon.

    In a body of revolution area and sides are weighted by the radius, `measure` [m^3] and
    `sides` [m^2], as the volumes of its points are.
    """

    area: Float[Array, "1 lanes"]
    moments: Float[Array, "2 1 lanes"]
    measure: Float[Array, "1 lanes"]
    sides: tuple[Float[Array, "cell_nodes lanes"], Float[Array, "cell_nodes lanes"]]
    revolved: bool

    def hoop(self, axis: int) -> float:
        """Share of the shape functions themselves in the mean slope: r N has the slope
        r dN/dr + N."""
        return 1.0 if self.revolved and axis == 0 else 0.0

    def shares(self, position, areas):
        """Weights of the points of a cell in the mean slope; they add up to one."""
        return areas * (position[0] if self.revolved else 1.0) / self.measure


def polygon_sums(
    x: Float[Array, "2 cell_nodes lanes"],
    kinds: Int[Array, " lanes"],
    kinematics: AbstractKinematics,
) -> PolygonSums:
    """Sums of polygons with `kinds` corners; further entries of `x` are repeats."""
    number = jnp.arange(x.shape[1])[:, None]
    count = kinds[None]
    ahead = jnp.where(number + 1 < count, number + 1, jnp.zeros_like(number))
    behind = jnp.where(number > 0, number - 1, count - 1)
    after, before = (jnp.take_along_axis(x, at[None], axis=1) for at in (ahead, behind))
    real = number < count
    zero = jnp.zeros_like(x[0])
    turn = jnp.where(real, x[0] * after[1] - x[1] * after[0], zero) / 2
    area = jnp.sum(turn, axis=0, keepdims=True)
    moments = jnp.sum(turn[None] * (x + after), axis=1, keepdims=True) / 3
    revolved = isinstance(kinematics, Axisymmetric)
    one = jnp.ones_like(zero)
    # mean of radius times shape function over the side ahead and the one behind
    here, there = (
        ((2 * x[0] + other[0]) / 6 if revolved else one / 2) for other in (after, before)
    )
    side = [
        jnp.where(real, here * (after - x)[k] + there * (x - before)[k], zero) for k in range(2)
    ]
    measure = moments[0] if revolved else area
    return PolygonSums(area, moments, measure, (side[1], -side[0]), revolved)


def exact_areas(
    sums: PolygonSums,
    position: Float[Array, "2 quad lanes"],
    areas: Float[Array, "quad lanes"],
) -> Float[Array, "quad lanes"]:
    """Areas of the points of a cell with the sum of the polygon; in a body of revolution
    with its first moments too."""
    areas = areas * (sums.area / jnp.sum(areas, axis=0, keepdims=True))
    if not sums.revolved:
        return areas
    centre = jnp.sum(areas[None] * position, axis=1, keepdims=True) / sums.area[None]
    away = position - centre
    a, b, d = (
        jnp.sum(areas * away[i] * away[k], axis=0, keepdims=True)
        for i, k in ((0, 0), (0, 1), (1, 1))
    )
    p, q = sums.moments - sums.area[None] * centre
    det = a * d - b * b
    tilt = ((d * p - b * q) / det, (a * q - b * p) / det)
    return areas * (1 + tilt[0] * away[0] + tilt[1] * away[1])


# Fields at points of all cells at once, made for differentiation by parameters: one product
# takes nodal values to reference gradients, the rest is elementwise on (points, cells)


class Points(NamedTuple):
    """Points of all cells: inverse of dX/dxi, reference volumes [m^3] and positions [m]."""

    back: Tensor
    volumes: Float[Array, "quad cells"]
    position: Float[Array, "dim quad cells"]
    tables: Tables
    kinds: Int[Array, " cells"] | None


def quadrature_points(mesh: Mesh, kinematics: AbstractKinematics) -> Points:
    """The quadrature points of the stiffness."""
    return points_at(mesh, kinematics, tables_at(mesh.element, "quadrature"))


def points_at(mesh: Mesh, kinematics: AbstractKinematics, tables: Tables) -> Points:
    """The points of every cell that `tables` are for."""
    kinds = None
    if isinstance(mesh.element, PolyN):  # the number of corners; the last is repeated
        kinds = 1 + jnp.sum(mesh.cells[:, 1:] != mesh.cells[:, :-1], axis=1)
    return _points(kinematics, tables, kinds, by_cell(mesh, mesh.points))


def _points(kinematics: AbstractKinematics, tables: Tables, kinds, x) -> Points:
    """The points of cells with corners at `x`, (dim, nodes, cells) [m]."""
    jac = _slopes(tables, kinds, x)
    full = _three([[jac[i, d] for d in range(len(jac))] for i in range(len(jac))])
    areas = determinant(full) * _of_kinds(tables.weights, kinds, x.dtype)
    position = _interpolate(tables, kinds, x)
    if kinds is not None:
        areas = exact_areas(polygon_sums(x, kinds, kinematics), position, areas)
    volumes = areas * kinematics.depth(tuple(position))
    return Points(inverse(full), volumes, position, tables, kinds)


def deformation(
    mesh: Mesh, kinematics: AbstractKinematics, points: Points, u: Float[Array, "nodes dim"]
) -> Entries:
    """Kept entries of F at the points."""
    dim, moved = mesh.element.dim, by_cell(mesh, u)
    reference = _slopes(points.tables, points.kinds, moved)
    slopes = [
        [
            functools.reduce(jnp.add, (reference[i, d] * points.back[d][j] for d in range(dim)))
            for j in range(dim)
        ]
        for i in range(dim)
    ]
    if points.kinds is not None:
        slopes = _corrected(mesh, kinematics, points, moved, slopes)
    if kinematics.num_columns > dim:
        radial = _interpolate(points.tables, points.kinds, moved[:1])[0]
        slopes[0].append(radial / points.position[0])
    kept = jnp.stack([slopes[s.component][s.column] for s in kinematics.slots])
    return kept + jnp.asarray(identity(kinematics), kept.dtype)[:, None, None]


def interpolated(mesh: Mesh, points: Points, nodal: Float[Array, "nodes dim"]) -> Entry:
    """A nodal field at the points, (dim, quad, cells)."""
    return _interpolate(points.tables, points.kinds, by_cell(mesh, nodal))


def node_gradients(
    kinematics: AbstractKinematics, points: Points, x: Float[Array, "dim cell_nodes cells"]
) -> Float[Array, "quad cell_nodes columns cells"]:
    """Gradients of the shape functions [1/m] at the points of cells with nodes at `x` [m]; in a
    body of revolution the third column is the shape function over the radius."""
    dim, kinds = x.shape[0], points.kinds
    N, slopes, _ = (_of_kinds(table, kinds, x.dtype) for table in points.tables)
    gradients = [
        functools.reduce(
            jnp.add, (slopes[:, :, d] * points.back[d][j][:, None] for d in range(dim))
        )
        for j in range(dim)
    ]
    if kinds is not None:
        sums, areas, share = _polygons(kinematics, points, x)
        for j, side in enumerate(sums.sides):
            exact = side - sums.hoop(j) * jnp.sum(areas[:, None] * N, axis=0)
            mean = jnp.sum(share[:, None] * gradients[j], axis=0)
            gradients[j] += (exact / sums.measure - mean)[None]
    if kinematics.num_columns > dim:
        gradients.append(N / points.position[0][:, None])
    return jnp.stack(gradients, axis=2)


def _corrected(mesh: Mesh, kinematics: AbstractKinematics, points: Points, moved, slopes):
    """Polygons: slopes whose mean over a cell is that of its boundary."""
    sums, areas, share = _polygons(kinematics, points, by_cell(mesh, mesh.points))
    inside = jnp.sum(areas[None] * _interpolate(points.tables, points.kinds, moved), axis=1)

    def fixed(i, j):
        exact = jnp.sum(moved[i] * sums.sides[j], axis=0) - sums.hoop(j) * inside[i]
        mean = jnp.sum(share * slopes[i][j], axis=0)
        return slopes[i][j] + (exact / sums.measure[0] - mean)[None]

    return [[fixed(i, j) for j in range(2)] for i in range(2)]


def _polygons(kinematics: AbstractKinematics, points: Points, x):
    """Sums of polygons, areas of their points and the weights of these in a mean slope."""
    assert points.kinds is not None
    sums = polygon_sums(x, points.kinds, kinematics)
    areas = points.volumes / kinematics.depth(tuple(points.position))
    return sums, areas, sums.shares(points.position, areas)


def by_cell(mesh: Mesh, nodal: Float[Array, "nodes dim"]) -> Float[Array, "dim nodes cells"]:
    """A nodal field at the nodes of every cell."""
    return jnp.moveaxis(nodal.T[:, mesh.cells], -1, 1)


def _slopes(tables: Tables, kinds, nodal) -> Float[Array, "dim dim_ref quad cells"]:
    return jnp.einsum("qadc,iac->idqc", _of_kinds(tables.slopes, kinds, nodal.dtype), nodal)


def _interpolate(tables: Tables, kinds, nodal) -> Float[Array, "dim quad cells"]:
    return jnp.einsum("qac,iac->iqc", _of_kinds(tables.values, kinds, nodal.dtype), nodal)


def _of_kinds(table: np.ndarray, kinds, dtype) -> Array:
    """The table of every cell, with the axis of cells last (of length 1 if all are equal)."""
    tables = jnp.asarray(table, dtype)
    return jnp.moveaxis(tables if kinds is None else tables[kinds], 0, -1)


def _three(rows) -> Tensor:
    """A 2x2 or 3x3 matrix as a tensor."""
    if len(rows) == 3:
        return tuple(tuple(row) for row in rows)  # type: ignore[return-value]
    return ((*rows[0], 0.0), (*rows[1], 0.0), (0.0, 0.0, 1.0))


# Shape gradients and volumes of the quadrature points, in blocks of cells


class Geometry(NamedTuple):
    """Gradients of the shape functions (see `node_gradients`), volumes and pressure functions
    of the points."""

    gradients: Float[Array, "blocks quad cell_nodes columns lanes"]
    volumes: Float[Array, "blocks quad lanes"]
    modes: Float[Array, "blocks modes quad lanes"] | None


@once
def geometry(
    space: Space,
    kinematics: AbstractKinematics,
    formulation: AbstractFormulation,
    points: Float[Array, "nodes dim"],
) -> Geometry:
    """Shape gradients [1/m] and quadrature volumes [m^3] of the cells at `points`."""

    def block(arrays):
        cells, kinds = arrays
        x = lanes(points, cells)
        at = _points(kinematics, tables_at(space.element, "quadrature"), kinds, x)
        pressures = modes(formulation, at.position, at.volumes)
        return node_gradients(kinematics, at, x), at.volumes, pressures

    return Geometry(*jax.lax.map(block, (space.cells, space.kinds)))


def gradient_entries(
    kinematics: AbstractKinematics,
    u: Float[Array, "dim cell_nodes lanes"],
    gradients: Float[Array, "quad cell_nodes columns lanes"],
) -> Entries:
    """Slopes of `u` at the quadrature points of a block, entry by entry of F."""
    G = jnp.moveaxis(gradients, 2, 0)
    slopes = functools.reduce(
        jnp.add, (u[:, None, None, a] * G[None, :, :, a] for a in range(u.shape[1]))
    )
    return jnp.stack([slopes[s.component, s.column] for s in kinematics.slots])


def deformation_gradient(kinematics: AbstractKinematics, u, gradients) -> Entries:
    """Kept entries of F = I + Grad u at the quadrature points of a block."""
    slopes = gradient_entries(kinematics, u, gradients)
    rest = jnp.asarray(identity(kinematics), slopes.dtype)
    return slopes + rest[:, None, None]
