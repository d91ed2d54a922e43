"""The boundary value problem: a noun, and the constructor that checks it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax import _check
from sorojax._types import is_traced
from sorojax.fem.kinematics import AbstractKinematics
from sorojax.fem.loads import AbstractLoad, Gravity, Pressure, open_ends
from sorojax.fem.space import Space, space as make_space
from sorojax.fem.supports import AbstractSupport, known_dofs
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.shape import nodes as reference_nodes, shape_gradients


class Problem(eqx.Module):
    """A hyperelastic body, how it is held and what loads it.

    Every number in it can carry a gradient; print it to see what is paid for.
    """

    mesh: Mesh
    material: AbstractHyperelastic
    kinematics: AbstractKinematics
    supports: tuple[AbstractSupport, ...]
    loads: tuple[AbstractLoad, ...]
    space: Space

    def __repr__(self) -> str:
        held = ", ".join(f"{type(s).__name__}({s.nodes.size} nodes)" for s in self.supports)
        loads = ", ".join(f"{type(load).__name__} '{load.name}'" for load in self.loads)
        return (
            f"Problem({self.mesh.element.name}: {self.mesh.num_cells} cells, "
            f"{self.space.num_dofs} dof; {type(self.material).__name__}; "
            f"{type(self.kinematics).__name__}; supports: {held}; loads: {loads or 'none'})"
        )


def problem(
    mesh: Mesh,
    material: AbstractHyperelastic,
    *,
    kinematics: AbstractKinematics,
    supports: tuple[AbstractSupport, ...],
    loads: tuple[AbstractLoad, ...] = (),
    space: Space | None = None,
) -> Problem:
    """A checked boundary value problem.

    Args:
        mesh: Cells in the reference configuration; points may be traced, cells not.
        material: Stored energy; its leaves are numbers or arrays with one entry per cell.
        kinematics: `PlaneStrain(thickness)`.
        supports: `Fixed(nodes)`, `Prescribed(nodes, displacement)`.
        loads: `Pressure`, `Traction`, `Gravity`.
        space: The mesh's `space(mesh)`, to share between problems on the same topology.

    Raises:
        ValueError: If the body could move rigidly, a set is empty, a cell is inverted, the
            material does not fit the mesh, or a pressure acts on an open run of facets.
    """
    _check.float64("fem.problem", mesh.points)
    supports, loads = tuple(supports), tuple(loads)
    space = make_space(mesh) if space is None else space
    _check_space(mesh, space)
    _check_cells(mesh)
    _check_material(mesh, material)
    known = _check_supports(mesh, supports)
    _check_loads(mesh, material, loads, known)
    return Problem(mesh, material, kinematics, supports, loads, space)


def _check_space(mesh: Mesh, space: Space) -> None:
    if space.num_nodes != mesh.num_nodes or space.system.slots.shape[0] != mesh.num_cells:
        raise ValueError(
            f"fem.problem: `space` belongs to a mesh of {space.num_nodes} nodes, this mesh "
            f"has {mesh.num_nodes}. Call fem.space(mesh) for this mesh."
        )


def _check_cells(mesh: Mesh) -> None:
    if is_traced(mesh):
        return
    points, cells = np.asarray(mesh.points), np.asarray(mesh.cells)
    _check.finite("fem.problem", "mesh.points", points, "Repair the mesh first.")
    slopes = shape_gradients(mesh.element, reference_nodes(mesh.element))
    jac = np.einsum("qad,cai->cqid", slopes, points[cells])
    bad = np.flatnonzero((np.linalg.det(jac) <= 0).any(axis=1))
    if len(bad):
        raise ValueError(
            f"fem.problem: {len(bad)} of {len(cells)} cells are inverted or flat "
            f"(first: {bad[:5].tolist()}). List corners counter-clockwise, or re-mesh."
        )


def _check_material(mesh: Mesh, material: AbstractHyperelastic) -> None:
    for leaf in jax.tree.leaves(material):
        if jnp.ndim(leaf) and jnp.shape(leaf) != (mesh.num_cells,):
            raise ValueError(
                f"fem.problem: a leaf of `material` has shape {jnp.shape(leaf)}, need () or "
                f"one number per cell, ({mesh.num_cells},)."
            )


def _check_supports(mesh: Mesh, supports: tuple[AbstractSupport, ...]) -> np.ndarray:
    for support in supports:
        where = f"{type(support).__name__}"
        if support.nodes.size == 0:
            raise ValueError(
                f"fem.problem: `{where}` holds no node. Check the predicate with "
                "mesh.nodes_where; lengths are in metres."
            )
        _check_ids(where, support.nodes, mesh.num_nodes)
    known = known_dofs(supports, mesh.num_nodes, mesh.element.dim)
    if not is_traced(mesh.points) and (free := _num_rigid_modes(mesh.points, known)):
        raise ValueError(
            f"fem.problem: the supports leave {free} rigid-body mode(s), so there is no "
            "unique equilibrium. Add a support, for example Fixed(nodes_where(...))."
        )
    return known


def _num_rigid_modes(points: Any, known: np.ndarray) -> int:
    points = np.asarray(points)
    scale = np.ptp(points, axis=0).max()
    x, y = ((points - points.mean(axis=0)) / scale).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    modes = np.stack([np.stack(m, 1).ravel() for m in ((one, zero), (zero, one), (-y, x))], 1)
    held = modes[known]
    return 3 - (np.linalg.matrix_rank(held, tol=1e-8) if len(held) else 0)


def _check_ids(where: str, ids: Any, count: int) -> None:
    ids = np.asarray(ids)
    if ids.min() < 0 or ids.max() >= count:
        raise ValueError(
            f"fem.problem: `{where}` names nodes {ids.min()} to {ids.max()}, the mesh has 0 "
            f"to {count - 1}. Select them on this mesh."
        )


def _check_loads(mesh, material, loads: tuple[AbstractLoad, ...], known: np.ndarray) -> None:
    names = [load.name for load in loads]
    if len(set(names)) != len(names):
        raise ValueError(
            f"fem.problem: loads are called {names}, need different names. Set `name=`."
        )
    for load in loads:
        where = f"{type(load).__name__} '{load.name}'"
        _check.finite("fem.problem", f"{where} value", load.value, "SI units: 20 * kPa.")
        if isinstance(load, Gravity) and material.density is None:
            raise ValueError(
                f"fem.problem: {where} needs a density, the {type(material).__name__} has "
                "none. Give density= in kg/m^3."
            )
        facets = getattr(load, "facets", None)
        if facets is None:
            continue
        if facets.size == 0:
            raise ValueError(
                f"fem.problem: {where} acts on no facet. Check the shape given to "
                "mesh.facets_on; lengths are in metres."
            )
        _check_ids(where, facets, mesh.num_nodes)
        if isinstance(load, Pressure):
            _check_closed(where, facets, known.reshape(-1, mesh.element.dim))


def _check_closed(where: str, facets: Any, known: np.ndarray) -> None:
    ends = open_ends(np.asarray(facets))
    loose = ends[~known[ends].all(axis=1)]
    if len(loose):
        raise ValueError(
            f"fem.problem: {where} acts on a run of facets that ends at free nodes "
            f"{loose[:4].tolist()}, so it has no potential. Close the cavity, or fix the "
            "nodes at its ends."
        )
