"""Checks of the loads that `fem.problem` is given."""

import dataclasses
from typing import Any

import numpy as np

from sorojax import _check
from sorojax._jax.trace_state import is_traced
from sorojax.fem.assembly.space import Space
from sorojax.fem.checks import check_ids
from sorojax.fem.contact.obstacle import Contact
from sorojax.fem.kinematics import AbstractKinematics, Axisymmetric
from sorojax.fem.loads.facets import open_nodes
from sorojax.fem.loads.loads import AbstractLoad, Force, Gravity, Pressure, Traction
from sorojax.fem.loads.springs import Cable, Foundation, Tendon
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.math.linalg import sparse
from sorojax.mesh.enrich import with_centres
from sorojax.mesh.mesh import Mesh


def enriched(mesh: Mesh, load: AbstractLoad) -> AbstractLoad:
    """`load` on the facets of an enriched mesh, where it has those of the mesh before."""
    new = {}
    for what in ("facets", "others"):
        facets = getattr(load, what, None)
        count = len(mesh.element.facets[0])
        if facets is None or is_traced(facets) or mesh.element.plain is None:
            continue
        if mesh.element.dim == 3 and facets.ndim == 2 and facets.shape[1] == count - 1:
            new[what] = with_centres(mesh, facets)
    return dataclasses.replace(load, **new) if new else load


def sets(mesh: Mesh, given: tuple[AbstractLoad, ...]) -> None:
    """Refuse loads on nodes or facets that are not there."""
    for load in given:
        where = f"{type(load).__name__} '{load.name}'"
        for what in ("facets", "nodes"):
            ids = getattr(load, what, None)
            if ids is None:
                continue
            if ids.size == 0:
                raise ValueError(
                    f"fem.problem: {where} acts on no {what[:-1]}. Check the shape given to "
                    "mesh.facets_on; lengths are in metres."
                )
            check_ids(where, ids, mesh.num_nodes)
            if what == "facets":
                _check_facets(where, ids, mesh)
        if isinstance(load, Tendon | Cable):
            check_ids(where, load.route.nodes, mesh.num_nodes)


def loads(
    mesh: Mesh,
    kinematics: AbstractKinematics,
    material: AbstractHyperelastic,
    given: tuple[AbstractLoad, ...],
    known: np.ndarray,
) -> None:
    names = [load.name for load in given]
    if len(set(names)) != len(names):
        raise ValueError(
            f"fem.problem: loads are called {names}, need different names. Set `name=`."
        )
    for load in given:
        where = f"{type(load).__name__} '{load.name}'"
        _check.finite("fem.problem", f"{where} value", load.value, "SI units: 20 * kPa.")
        _check_value(where, load, mesh.element.dim)
        if isinstance(load, Gravity) and material.density is None:
            raise ValueError(
                f"fem.problem: {where} needs a density, the {type(material).__name__} has "
                "none. Give density= in kg/m^3."
            )
        load.check(where, mesh, kinematics)
        if isinstance(load, Pressure):
            _check_closed(where, load, mesh, kinematics, known)


def room(space: Space, given: tuple[AbstractLoad, ...]) -> None:
    """Refuse a space whose pattern has no place for the stiffness of a load."""
    for load in given:
        if (groups := load.couples()) is None:
            continue
        dofs = (groups[:, :, None] * space.dim + np.arange(space.dim)).reshape(len(groups), -1)
        try:
            sparse.slots_of(space.system, dofs)
        except ValueError as reason:
            raise ValueError(
                f"fem.problem: `space` has no room for {type(load).__name__} '{load.name}', "
                "which couples nodes of different cells. Build it with fem.space(mesh, loads)."
            ) from reason


def _check_value(where: str, load: AbstractLoad, dim: int) -> None:
    """A vector where the load has a direction, else a number; a bed of springs has both."""
    directed = load.directed or isinstance(load, Force | Traction | Gravity | Contact)
    want = ((dim,),) if directed else ((),)
    if isinstance(load, Foundation):
        want = ((), (dim,))
    if load.value.shape not in want:
        raise ValueError(
            f"fem.problem: {where} has a value of shape {load.value.shape}, need "
            f"{' or '.join(map(str, want))}" + (": one entry per axis." if want[-1] else ".")
        )


def _check_facets(where: str, facets: Any, mesh: Mesh) -> None:
    facets = np.asarray(facets)
    need = len(mesh.element.facets[0])
    if facets.ndim != 2 or facets.shape[1] != need:
        raise ValueError(
            f"fem.problem: {where} has facets of shape {facets.shape}, a facet of "
            f"{mesh.element.name} has {need} nodes. Take them from this mesh: "
            "mesh.facets_on(mesh, shape) or mesh.facet_sets."
        )


def parallel_to_ends(
    mesh: Mesh, kinematics: AbstractKinematics, given: tuple[AbstractLoad, ...], known
) -> tuple[AbstractLoad, ...]:
    """The loads, pressures with a field of divergence one along the planes of their ends."""
    if is_traced((mesh.points, given)) or isinstance(kinematics, Axisymmetric):
        return given
    return tuple(
        _parallel(mesh, load, known) if isinstance(load, Pressure) else load for load in given
    )


def _parallel(mesh: Mesh, load: Pressure, known) -> Pressure:
    held, through = _ends(mesh, load, known)[1:]
    rows = held[~(held.all(axis=1) | (held & through).any(axis=1))]
    across = np.zeros(mesh.element.dim, bool)
    for row in rows[np.argsort(rows.sum(axis=1), kind="stable")]:
        if row.any() and not (row & across).any():
            across[np.flatnonzero(row)[0]] = True
    if not across.any() or across.all():
        return load
    shares = tuple(float(share) for share in ~across / np.sum(~across))
    return dataclasses.replace(load, flux_shares=shares)


def _ends(mesh: Mesh, load: Pressure, known):
    """Nodes at open ends, which of their components are held, and whether they lie in the
    plane through the origin of the load across each axis."""
    ends = open_nodes(mesh.element, np.asarray(load.facets))
    held = known.reshape(-1, mesh.element.dim)[ends]
    if is_traced((mesh.points, load)):
        return ends, held, np.zeros_like(held)
    origin = np.zeros(mesh.element.dim) if load.origin is None else np.asarray(load.origin)
    points = np.asarray(mesh.points)
    through = np.abs(points[ends] - origin) <= 1e-9 * np.ptp(points, axis=0).max()
    return ends, held, through


def _check_closed(where: str, load: Pressure, mesh: Mesh, kinematics, known) -> None:
    """An open end must be held, or slide in a plane that the load has no flux through."""
    ends, held, parallel = _ends(mesh, load, known)
    if load.flux_shares is not None:
        parallel = parallel | (np.asarray(load.flux_shares) == 0)
    sliding = held & parallel
    if isinstance(kinematics, Axisymmetric):
        sliding[:, 1] = held[:, 1]
    safe = held.all(axis=1) | sliding.any(axis=1)
    if not safe.all():
        raise ValueError(
            f"fem.problem: {where} acts on facets with an open end at nodes "
            f"{ends[~safe][:4].tolist()}, so it has no potential: its work depends on the "
            "way that the end takes. Close the cavity, fix the nodes at its ends, let them "
            "slide in planes of symmetry through `origin`, or use fem.Traction. Where the "
            "drawing is closed, its mesh is too coarse: lower `size`."
        )
