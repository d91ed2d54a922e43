"""Checks of what `fem.problem` is given, before any long computation."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._jax.jit import once
from sorojax._jax.trace_state import is_traced
from sorojax.fem.assembly.space import (
    AbstractFormulation,
    ConstantPressure,
    Displacement,
    LinearPressure,
    Space,
)
from sorojax.fem.kinematics import AbstractKinematics, Axisymmetric
from sorojax.fem.supports import AbstractSupport, known_components, known_dofs
from sorojax.material.hyperelastic import AbstractHyperelastic, small_strain_moduli
from sorojax.material.softening.law import Softening
from sorojax.material.viscoelastic import Viscoelastic
from sorojax.mesh.elements.base import nodes as reference_nodes, shape_gradients
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.mesh import Mesh

#: Ratio of bulk to shear modulus above which a pressure at every point locks.
LOCKING_RATIO = {1: 10.0, 2: 100.0}
_NOTICED = 10.0  # bulk over shear modulus, from which on quadratic cells are noticeably stiff


def kinematics(mesh: Mesh, given: AbstractKinematics | None) -> AbstractKinematics:
    if given is None:
        raise ValueError(
            f"fem.problem: {mesh.element.name} cells lie in a plane. Say how the plane is "
            "completed: kinematics=fem.PlaneStrain(thickness), fem.PlaneStress(thickness) or "
            "fem.Axisymmetric()."
        )
    if given.dim != mesh.element.dim:
        raise ValueError(
            f"fem.problem: kinematics {type(given).__name__} is for cells of dimension "
            f"{given.dim}, {mesh.element.name} has {mesh.element.dim}. Leave `kinematics` out "
            "in space, or choose a plane one."
        )
    if isinstance(given, Axisymmetric) and not is_traced(mesh.points):
        radius = np.asarray(mesh.points)[:, 0]
        if radius.min() < -1e-12 * np.ptp(radius):
            raise ValueError(
                f"fem.problem: a node has radius {radius.min():.3g} m, need x >= 0 in a body "
                "of revolution about the y axis. Move the mesh to the right of the axis."
            )
    return given


def space(mesh: Mesh, given: Space) -> None:
    if given.num_nodes != mesh.num_nodes or given.num_cells != mesh.num_cells:
        raise ValueError(
            f"fem.problem: `space` belongs to a mesh of {given.num_nodes} nodes, this mesh "
            f"has {mesh.num_nodes}. Call fem.space(mesh) for this mesh."
        )


def cells(mesh: Mesh) -> None:
    if is_traced(mesh):
        return
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    _check.finite("fem.problem", "mesh.points", points, "Repair the mesh first.")
    if isinstance(mesh.element, PolyN):
        after, before = np.roll(points[cells], -1, axis=1), points[cells]
        turn = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
        least = turn.sum(axis=1)
    else:
        slopes = shape_gradients(mesh.element, reference_nodes(mesh.element))
        least = np.linalg.det(np.einsum("qad,cai->cqid", slopes, points[cells])).min(axis=1)
    bad = np.flatnonzero(least <= 0)
    if len(bad):
        raise ValueError(
            f"fem.problem: {len(bad)} of {len(cells)} cells are inverted or flat "
            f"(first: {bad[:5].tolist()}). List corners counter-clockwise, or re-mesh."
        )


def material(mesh: Mesh, given: AbstractHyperelastic) -> None:
    inner = given.base if isinstance(given, Viscoelastic) else given
    inner = inner.base if isinstance(inner, Softening) else inner
    kinds = (Viscoelastic, Softening)
    parts = jax.tree.leaves(inner, is_leaf=lambda part: isinstance(part, kinds))
    for part in parts:
        if isinstance(part, kinds):
            raise ValueError(
                f"fem.problem: `material` has a {type(part).__name__} within a "
                f"{type(given).__name__}, but it stands outermost. Write "
                "Viscoelastic(Softening(the law of all cells, r, m), spectrum), or one of the "
                "two, with shares per cell, 0 where there is no branch, and r, infinite where "
                "nothing softens."
            )
    for leaf in jax.tree.leaves(given):
        if jnp.ndim(leaf) and jnp.shape(leaf) != (mesh.num_cells,):
            raise ValueError(
                f"fem.problem: a leaf of `material` has shape {jnp.shape(leaf)}, need () or "
                f"one number per cell, ({mesh.num_cells},)."
            )


def no_peaks(where: str, given: AbstractHyperelastic) -> None:
    """Refuse a material that softens where states before a state are not remembered."""
    law = given.base if isinstance(given, Viscoelastic) else given
    if isinstance(law, Softening) and law.remembers:
        raise ValueError(
            f"{where}: got a body that softens, need one without memory: fem.solve_path, "
            "fem.simulate and networks remember. Take material.preconditioned(rubber, "
            "stretch=...), or its `base`, the first loading."
        )


def formulation(mesh: Mesh, kinematics: AbstractKinematics, given: AbstractFormulation) -> None:
    """Refuse pairs of displacement and pressure that lock or are unstable."""
    element = mesh.element
    if isinstance(given, Displacement):
        return
    if not kinematics.has_volume:
        raise ValueError(
            "fem.problem: plane stress has no pressure of its own, got "
            f"{type(given).__name__}. Leave `formulation` out."
        )
    if isinstance(given, ConstantPressure) and element.num_nodes == element.dim + 1:
        raise ValueError(
            f"fem.problem: a constant pressure in {element.name} is the displacement element "
            "and locks. Use order=2 and mesh.enrich, or quadrilaterals."
        )
    if isinstance(given, LinearPressure) and not element.pressure_order:
        raise ValueError(
            f"fem.problem: a linear pressure in {element.name} is not stable, need Tri7, Quad9 "
            "or Tet15. Call mesh.enrich(mesh) first, or use fem.ConstantPressure()."
        )


def locking(
    mesh: Mesh,
    material: AbstractHyperelastic,
    kinematics: AbstractKinematics,
    chosen: AbstractFormulation,
) -> None:
    """Refuse nearly incompressible materials in cells whose default would lock, and warn of
    those that quadratic cells carry with an error.

    The error that is named was measured on cantilevers ten times as long as thick, of one and
    of two Tri6 through the thickness, against enriched cells: 5 to 11 and 0.7 to 1.5 % too
    stiff at Poisson ratios from 0.45 to 0.495.
    """
    if not isinstance(chosen, Displacement) or not kinematics.has_volume or is_traced(material):
        return
    ratio = _bulk_over_shear(material)
    limit = LOCKING_RATIO[mesh.element.order]
    if ratio > limit:
        poisson = (3 * ratio - 2) / (6 * ratio + 2)
        remedy = (
            "Use order=2 cells and mesh.enrich(mesh), or quadrilaterals"
            if mesh.element.order == 1
            else "Call mesh.enrich(mesh) first"
        )
        raise ValueError(
            f"fem.problem: {mesh.element.name} would lock at a Poisson ratio of {poisson:.4f} "
            f"(K / mu = {ratio:.0f}, need at most {limit:.0f}). {remedy}; to accept it pass "
            "formulation=fem.Displacement()."
        )
    if mesh.element.order == 2 and ratio > _NOTICED:
        share = ratio / (ratio + _NOTICED)
        poisson = (3 * ratio - 2) / (6 * ratio + 2)
        _check.warn(
            f"fem.problem: {mesh.element.name} at a Poisson ratio of {poisson:.3f} is too "
            f"stiff, in bending by about {12 * share:.0f} % with one cell through a wall and "
            f"{1.7 * share:.1f} % with two. Call mesh.enrich(mesh) first; to accept it pass "
            "formulation=fem.Displacement()."
        )


def _bulk_over_shear(material: AbstractHyperelastic) -> float:
    """Largest ratio over all cells; 0 where the material cannot tell."""
    leaves, tree = jax.tree.flatten(material)
    length = max((leaf.size for leaf in leaves if jnp.ndim(leaf)), default=0)
    if not length:
        shear, bulk = small_strain_moduli(material)
        return float(bulk / shear)
    values = np.stack([np.broadcast_to(np.asarray(leaf), (length,)) for leaf in leaves], axis=1)
    kinds = np.unique(values, axis=0)
    kinds = kinds[np.linspace(0, len(kinds) - 1, min(len(kinds), 8)).astype(int)]
    ratios = []
    for kind in kinds:
        shear, bulk = small_strain_moduli(
            jax.tree.unflatten(tree, [jnp.asarray(v) for v in kind])
        )
        ratios.append(float(bulk / shear))
    return max(ratios)


def supports(
    mesh: Mesh, kinematics: AbstractKinematics, given: tuple[AbstractSupport, ...]
) -> np.ndarray:
    dim = mesh.element.dim
    for support in given:
        where = f"{type(support).__name__}"
        if support.nodes.size == 0:
            raise ValueError(
                f"fem.problem: `{where}` holds no node. Check the predicate with "
                "mesh.nodes_where; lengths are in metres."
            )
        check_ids(where, support.nodes, mesh.num_nodes)
        _check_components(where, support, dim)
        _check.finite(
            "fem.problem",
            f"{where} displacement",
            support.displacement,
            "Give displacements in metres.",
        )
    known = known_dofs(given, mesh.num_nodes, dim)
    if isinstance(kinematics, Axisymmetric) and not is_traced(mesh.points):
        _check_axis(np.asarray(mesh.points), known)
    return known


def _check_components(where: str, support: AbstractSupport, dim: int) -> None:
    components = known_components(support, dim)
    if not components or min(components) < 0 or max(components) >= dim:
        raise ValueError(
            f"fem.problem: `{where}` names components {components}, the mesh has 0 to "
            f"{dim - 1}."
        )
    shape = jnp.shape(support.displacement)
    if shape not in ((), (len(components),), (support.nodes.size, len(components))):
        raise ValueError(
            f"fem.problem: `{where}` has a displacement of shape {shape}, need "
            f"({len(components)},) or ({support.nodes.size}, {len(components)}): one entry per "
            "known component."
        )


def _check_axis(points: np.ndarray, known: np.ndarray) -> None:
    on = np.flatnonzero(points[:, 0] <= 1e-12 * np.ptp(points[:, 0]))
    loose = on[~known.reshape(-1, 2)[on, 0]]
    if len(loose):
        raise ValueError(
            f"fem.problem: {len(loose)} nodes on the axis may leave it (first: "
            f"{loose[:4].tolist()}). Add Fixed(nodes, components=(0,)) for the nodes at x = 0."
        )


def held(problem: Any, known: np.ndarray) -> None:
    """Refuse a body that could move rigidly: supports and springs must hold it."""
    if is_traced((problem.mesh.points, problem.loads, problem.supports)):
        return
    modes = rigid_modes(np.asarray(problem.mesh.points), problem.kinematics)
    rows = modes.reshape(len(modes), -1)[:, known]
    if springs := [load for load in problem.loads if load.holds]:
        stiffness = np.asarray(_curvature(problem, springs, jnp.asarray(modes)))
        size = max(np.abs(stiffness).max(), np.finfo(float).tiny)
        rows = np.concatenate([rows, stiffness / size], axis=1)
    free = len(modes) - (np.linalg.matrix_rank(rows, tol=1e-8) if rows.size else 0)
    if free:
        raise ValueError(
            f"fem.problem: the supports leave {free} rigid-body mode(s), so there is no "
            "unique equilibrium. Add a support, for example Fixed(nodes_where(...))."
        )


@once
def _curvature(problem: Any, springs: list, modes) -> Float[Array, "modes modes"]:
    """Second derivatives of the potential of springs in the rigid modes."""

    def energy(amounts):
        u = jnp.einsum("m,mni->ni", amounts, modes)
        return sum(load.potential(problem, u) for load in springs)

    return jax.hessian(energy)(jnp.zeros(len(modes)))


def rigid_modes(points: np.ndarray, kinematics: AbstractKinematics) -> np.ndarray:
    """Small rigid motions of the nodes, (modes, nodes, dim), of about unit size."""
    dim = points.shape[1]
    x = (points - points.mean(axis=0)) / np.ptp(points, axis=0).max()
    moves = [np.broadcast_to(axis, x.shape) for axis in np.eye(dim)]
    if isinstance(kinematics, Axisymmetric):
        return np.stack(moves[1:])
    turns = []
    for i in range(dim):
        for j in range(i + 1, dim):
            turn = np.zeros_like(x)
            turn[:, i], turn[:, j] = -x[:, j], x[:, i]
            turns.append(turn)
    return np.stack(moves + turns)


def check_ids(where: str, ids: Any, count: int) -> None:
    ids = np.asarray(ids)
    if ids.min() < 0 or ids.max() >= count:
        raise ValueError(
            f"fem.problem: `{where}` names nodes {ids.min()} to {ids.max()}, the mesh has 0 "
            f"to {count - 1}. Select them on this mesh."
        )
