"""Stresses, forces and energies of an equilibrium; continuous stresses at the nodes by
superconvergent patch recovery.

Reference: Zienkiewicz, Zhu, "The superconvergent patch recovery and a posteriori error
estimates, part 1", IJNME 33, 1992.
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._jax.trace_state import is_traced
from sorojax.fem.assembly.energy import Entries, energy_density, pressure, stack_matrix
from sorojax.fem.assembly.geometry import (
    Points,
    Tables,
    deformation,
    points_at,
    quadrature_points,
    tables_at,
)
from sorojax.fem.assembly.space import coefficients, modes
from sorojax.fem.kinematics import PlaneStress
from sorojax.fem.loads.facets import cavity_volume
from sorojax.fem.problem import Problem, body, body_at
from sorojax.material.kinematics import Entry, Tensor, determinant
from sorojax.mesh.elements.base import (
    AbstractElement,
    nodes as reference_nodes,
    shape_functions,
    shape_gradients,
)
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.elements.tensor import AbstractHypercube
from sorojax.mesh.measure import check_some
from sorojax.mesh.mesh import Mesh, boundary_facets


def deformation_gradient(
    problem: Problem, u: Float[Array, "nodes dim"]
) -> Float[Array, "cells cell_nodes 3 3"]:
    """F in three dimensions at the nodes of every cell.

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].

    Returns:
        The gradient F [-].
    """
    return _deformation_gradient(body(problem), u)


@jax.jit
def _deformation_gradient(problem: Problem, u) -> Float[Array, "cells cell_nodes 3 3"]:
    points = _node_points(problem)
    F = full_deformation(
        problem, points, deformation(problem.mesh, problem.kinematics, points, u)
    )
    return jnp.swapaxes(stack_matrix(F, points.volumes), 0, 1)


def cauchy_stress(
    problem: Problem, u: Float[Array, "nodes dim"]
) -> Float[Array, "cells cell_nodes 3 3"]:
    """Cauchy stress sigma = P F' / J at the nodes of every cell, not averaged between cells.

    P is the first Piola-Kirchhoff stress dW/dF. Where cells carry a pressure of their own,
    it is that pressure, extended to the nodes. `nodal_stress` recovers a continuous field.

    Args:
        problem: The problem, for its mesh, material and formulation.
        u: Displacement of the nodes [m].

    Returns:
        Stress [Pa], three-dimensional also in the plane.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                      element=mesh.Quad9())
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)
        >>> problem = fem.problem(bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...                       supports=(fem.Fixed(bar.node_sets["left"]),))
        >>> u = jnp.zeros_like(bar.points).at[:, 0].set(0.01 * bar.points[:, 0])  # 1 %
        >>> print(f"{float(fem.cauchy_stress(problem, u)[0, 0, 0, 0]) / kPa:.1f} kPa")
        37.9 kPa

    Reference:
        Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2008.
    """
    return _cauchy_stress(body(problem), u)


@jax.jit
def _cauchy_stress(problem: Problem, u) -> Float[Array, "cells cell_nodes 3 3"]:
    return stress_at(problem, u, _node_points(problem))


def stress_at(
    problem: Problem, u: Float[Array, "nodes dim"], points: Points
) -> Float[Array, "cells points 3 3"]:
    """Cauchy stress at `points` of every cell [Pa]."""
    F = full_deformation(
        problem, points, deformation(problem.mesh, problem.kinematics, points, u)
    )
    material = body_at(problem, points).material
    entries = jax.tree.map(
        lambda e: jnp.broadcast_to(jnp.asarray(e, points.volumes.dtype), points.volumes.shape),
        F,
    )
    P = jax.grad(lambda F: jnp.sum(material.isochoric_energy(F)))(entries)
    J = determinant(entries)
    matrix_P, matrix_F = (stack_matrix(T, points.volumes) for T in (P, entries))
    shape = jnp.einsum("qcij,qckj->qcik", matrix_P, matrix_F) / J[..., None, None]
    spread = jnp.eye(3, dtype=J.dtype)[None, None]
    sigma = shape + _pressure_at(problem, u, points, J)[..., None, None] * spread
    return jnp.swapaxes(sigma, 0, 1)


def _node_points(problem: Problem) -> Points:
    """The nodes of every cell; their volumes mean nothing."""
    if any(jnp.ndim(leaf) > 1 for leaf in jax.tree.leaves(problem.material)):
        raise ValueError(
            "fem.cauchy_stress: got a body at an instant, whose memory is "
            "known at quadrature points only. Take fem.stress.stress_at(problem, u, points) at "
            "fem.assembly.geometry.quadrature_points(mesh, kinematics)."
        )
    return points_at(problem.mesh, problem.kinematics, tables_at(problem.mesh.element, "nodes"))


def full_deformation(problem: Problem, points: Points, F: Entries) -> Tensor:
    """F in three dimensions, the thickness stretch of a sheet included."""
    kinematics = problem.kinematics
    if not isinstance(kinematics, PlaneStress):
        return kinematics.embed(tuple(F))
    material = body_at(problem, points).material
    (a, b, _), (c, d, _), _ = kinematics.embed(tuple(F))
    return (
        (a, b, 0.0),
        (c, d, 0.0),
        (0.0, 0.0, kinematics.thickness_stretch(material, tuple(F))),
    )


def _pressure_at(problem: Problem, u, points: Points, J: Entry) -> Entry:
    """dU/dJ at the nodes: of J there, or the pressure that the cells carry."""
    inside = quadrature_points(problem.mesh, problem.kinematics)
    body = body_at(problem, inside)
    if body.modes is None:
        volumetric = body_at(problem, points).material.volumetric_energy
        return jax.grad(lambda J: jnp.sum(volumetric(J)))(J)
    F = deformation(problem.mesh, problem.kinematics, inside, u)
    carried = coefficients(body.modes, body.volumes, pressure(body, F))
    return jnp.sum(_extended(problem, inside, points) * carried[:, None], axis=0)


def _extended(problem: Problem, inside: Points, points: Points):
    """The orthonormal pressure functions of the quadrature points, at other points."""
    given = jnp.stack(problem.formulation.pressures(inside.position))
    wanted = jnp.stack(problem.formulation.pressures(points.position))
    from_given = modes(problem.formulation, inside.position, inside.volumes)
    assert from_given is not None
    weights = inside.volumes[None, None]
    gram = jnp.sum(weights * given[:, None] * given[None], axis=2)
    mixed = jnp.sum(weights * given[:, None] * from_given[None], axis=2)
    change = jnp.linalg.solve(jnp.moveaxis(gram, 2, 0), jnp.moveaxis(mixed, 2, 0))
    return jnp.einsum("cfm,fqc->mqc", change, wanted)


def von_mises_stress(
    problem: Problem, u: Float[Array, "nodes dim"]
) -> Float[Array, "cells cell_nodes"]:
    """Von Mises stress sqrt(3/2 s:s) at the nodes of every cell, s the deviator of sigma.

    Not averaged between cells. At rest it is zero, with zero for its derivative.

    Args:
        problem: The problem, for its mesh, material and formulation.
        u: Displacement of the nodes [m].

    Returns:
        Stress [Pa] at the nodes of every cell.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                      element=mesh.Quad9())
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)
        >>> problem = fem.problem(bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...                       supports=(fem.Fixed(bar.node_sets["left"]),))
        >>> u = jnp.zeros_like(bar.points).at[:, 0].set(0.01 * bar.points[:, 0])  # 1 %
        >>> print(f"{float(fem.von_mises_stress(problem, u)[0, 0]) / kPa:.2f} kPa")
        6.82 kPa
    """
    return _von_mises(cauchy_stress(problem, u))


@jax.jit
def _von_mises(sigma: Float[Array, "cells cell_nodes 3 3"]):
    mean = jnp.trace(sigma, axis1=-2, axis2=-1) / 3
    deviator = sigma - mean[..., None, None] * jnp.eye(3, dtype=sigma.dtype)[None, None]
    square = 1.5 * jnp.sum(deviator**2, axis=(-2, -1))
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def principal_stresses(
    problem: Problem, u: Float[Array, "nodes dim"]
) -> Float[Array, "cells cell_nodes 3"]:
    """Principal Cauchy stresses at the nodes of every cell, rising [Pa].

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].

    Returns:
        Three stresses [Pa].
    """
    return jnp.linalg.eigvalsh(cauchy_stress(problem, u))


def nodal_average(
    problem: Problem, field: Float[Array, "cells cell_nodes *value"]
) -> Float[Array, "nodes *value"]:
    """Mean over the cells that share a node, of numbers, vectors or tensors at the nodes of
    every cell.

    Args:
        problem: The boundary value problem.
        field: Values at the nodes of every cell.

    Returns:
        One value per node.
    """
    return _nodal_average(problem.mesh, field)


@jax.jit
def _nodal_average(mesh: Mesh, field: Float[Array, "cells cell_nodes *value"]):
    zero = jnp.zeros((mesh.num_nodes, *field.shape[2:]), field.dtype)
    total = zero.at[mesh.cells].add(field)
    return total / zero.at[mesh.cells].add(jnp.ones_like(field))


def enclosed_volume(
    problem: Problem,
    u: Float[Array, "nodes dim"],
    facets: Int[Array, "facets facet_nodes"],
) -> Float[Array, ""]:
    """Volume of the cavities that closed sets of `facets` enclose [m^3].

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].
        facets: Nodes of the facets, one row per facet.

    Returns:
        Volume [m^3].

    Raises:
        ValueError: If there is no facet.
    """
    check_some("fem.enclosed_volume", facets)
    return _enclosed_volume(body(problem), u, facets)


_enclosed_volume = jax.jit(cavity_volume)


# Continuous stresses at the nodes by superconvergent patch recovery, and energy per cell


_SURE = 0.02  # smallest singular value of a fit over the largest


class Patches(NamedTuple):
    """For every node the `samples` of the cells around it, as cell times samples per cell plus
    sample, and the `weights` that add up to the value there; padded by zero weights."""

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

    Inside, a polynomial of the order of the element is fitted to the samples of the cells that
    share a node, of one more ring of cells where these are too few; so a field of that order
    is recovered exactly. In Quad4 and Hex8 the mean of the cells at the node is as good there:
    its error is that of a central difference. On the boundary quadrilaterals and Hex8 take
    that mean, triangles and tetrahedra the fit, in which near samples count more: each is the
    better one at the root of an ellipse (NAFEMS LE1) and at the rim of a hole.

    Args:
        mesh: Cells that are not polygons.

    Returns:
        What `nodal_stress` needs of the mesh.

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
    rings, powers, count = _rings(mesh, cells), _powers(mesh.element), at.shape[1]
    edge = np.zeros(mesh.num_nodes, bool)
    edge[np.unique(boundary_facets(mesh))] = True
    inner = len(mesh.element.stress_points())
    product = isinstance(mesh.element, AbstractHypercube)
    by_mean = (edge | (mesh.element.order == 1)) & product

    def at_node(node):
        if by_mean[node]:
            return _mean(cells, next(rings(node)), node, inner, count)
        return _fit(points[node], at[:, :inner], rings(node), powers, count)

    found = [at_node(node) for node in range(mesh.num_nodes)]
    most = max(len(samples) for samples, _ in found)
    samples = np.zeros((mesh.num_nodes, most), np.int32)
    weights = np.zeros((mesh.num_nodes, most))
    for node, (ids, share) in enumerate(found):
        samples[node, : len(ids)], weights[node, : len(ids)] = ids, share
    return Patches(jnp.asarray(samples), jnp.asarray(weights))


def nodal_stress(
    problem: Problem, u: Float[Array, "nodes dim"], fit: Patches | None = None
) -> Float[Array, "nodes 3 3"]:
    """Cauchy stress [Pa] at the nodes, continuous: inside more accurate than the mean of the
    cells (`nodal_average` of `cauchy_stress`), on the boundary at least as accurate.

    To be taken where a stress is read off a coarse mesh, or compared with a strength; the mean
    costs nothing once and is enough for pictures. At an interface of two materials, where
    stress jumps, it is smoothed. Pass `patches(problem.mesh)` to compute them once for many
    states.

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].
        fit: `patches(problem.mesh)`; computed here if omitted.

    Returns:
        Stress [Pa].
    """
    fit = patches(problem.mesh) if fit is None else fit
    return _fitted(body(problem), u, fit)


@jax.jit
def _fitted(problem: Problem, u, fit: Patches) -> Float[Array, "nodes 3 3"]:
    points = points_at(problem.mesh, problem.kinematics, _sample_table(problem.mesh.element))
    return fit(stress_at(problem, u, points))


def strain_energy(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, " cells"]:
    """Stored energy of every cell [J].

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].

    Returns:
        Energy [J].
    """
    return _strain_energy(body(problem), u)


@jax.jit
def _strain_energy(problem: Problem, u) -> Float[Array, " cells"]:
    points = quadrature_points(problem.mesh, problem.kinematics)
    F = deformation(problem.mesh, problem.kinematics, points, u)
    return jnp.sum(points.volumes * energy_density(body_at(problem, points), F), axis=0)


def sample_points(mesh: Mesh) -> Float[Array, "cells samples dim"]:
    """Where the stresses of a cell are taken [m]: its points of reduced integration, in
    quadrilaterals and Hex8 its nodes as well.

    Args:
        mesh: The mesh.

    Returns:
        Points [m] of every cell.
    """
    values = jnp.asarray(_sample_table(mesh.element).values[0])
    return jnp.einsum("qa,cai->cqi", values, mesh.points[mesh.cells])


def _sample_table(element: AbstractElement) -> Tables:
    at = element.stress_points()
    if isinstance(element, AbstractHypercube):
        at = np.concatenate([at, reference_nodes(element)])
    tables = shape_functions(element, at), shape_gradients(element, at), np.ones(len(at))
    return Tables(*(table[None] for table in tables))


def _mean(
    cells: np.ndarray, own: np.ndarray, node: int, inner: int, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The samples of the cells `own` at their common node, with equal weights; the `inner`
    points of a cell are the first of its `count`."""
    corner = np.argmax(cells[own] == node, axis=1)
    return own * count + inner + corner, np.full(len(own), 1 / max(len(own), 1))


def _powers(element: AbstractElement) -> np.ndarray:
    """Exponents of the polynomials up to the order of the element."""
    grid = itertools.product(range(element.order + 1), repeat=element.dim)
    return np.array([p for p in grid if sum(p) <= element.order])


def _rings(mesh: Mesh, cells: np.ndarray):
    """The cells around a node, grown ring by ring on request."""
    order = np.argsort(cells.ravel(), kind="stable")
    starts = np.searchsorted(cells.ravel()[order], np.arange(mesh.num_nodes + 1))
    owners = order // cells.shape[1]

    def around(nodes):
        return np.unique(np.concatenate([owners[starts[n] : starts[n + 1]] for n in nodes]))

    def grown(node):
        own = around([node])
        yield own
        while len(more := around(np.unique(cells[own]))) > len(own):
            own = more
            yield own

    return grown


def _fit(point, at, rings, powers, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Samples and their weights in the least squares fit at `point`, over as many rings of
    cells as it takes for a sure one.

    Near samples count more: a further ring only has to tell the curvature and leaves the
    value to the cells next to the node.
    """
    ids, weights = np.zeros(0, int), np.zeros(0)
    constant = np.flatnonzero(powers.sum(axis=1) == 0)[0]
    for own in rings:
        if not len(own):  # a node without cells
            break
        place = at[own].reshape(-1, at.shape[2]) - point
        distance = np.sqrt(np.sum(place**2, axis=1))
        basis = np.prod((place / distance.max())[:, None] ** powers[None], axis=2)
        trust = 1 / (0.1 + (distance / distance.min()) ** 2)
        values = np.linalg.svd(basis, compute_uv=False)
        ids = (own[:, None] * count + np.arange(at.shape[1])).ravel()
        weights = np.linalg.pinv(trust[:, None] * basis, rcond=1e-8)[constant] * trust
        if len(basis) > len(powers) and values[-1] > _SURE * values[0]:
            break
    return ids, weights
