"""Quadratic cells from linear ones, and the inner nodes that a linear pressure needs."""

import jax.numpy as jnp
import numpy as np

from sorojax._jax.trace_state import is_traced
from sorojax._types import from_host
from sorojax.mesh.elements.base import (
    AbstractElement,
    exported_elements,
    facet_corners,
    nodes as reference_nodes,
    shape_functions,
    side_ends,
)
from sorojax.mesh.elements.simplex import Tet4, Tet10, Tri3, Tri6
from sorojax.mesh.mesh import Mesh, with_side_nodes

_QUADRATIC: dict[str, AbstractElement] = {Tri3().name: Tri6(), Tet4().name: Tet10()}


def quadratic(mesh: Mesh) -> Mesh:
    """`mesh` with a node in the middle of every side: Tri3 becomes Tri6, Tet4 Tet10.

    For meshes from elsewhere, which mostly have linear cells; `enrich` goes on from there.
    Sides stay straight, where `triangulate` and `tetrahedralise` with `order=2` put their
    nodes on the shape. Old nodes keep their numbers. A node set gains the middles of the
    sides whose ends it both holds.

    Args:
        mesh: A mesh of `Tri3` or `Tet4` cells.

    Returns:
        The mesh with more nodes.

    Raises:
        ValueError: If the mesh has other cells, or if they are traced.

    Example:
        >>> plain = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1), element=Tri3())
        >>> mesh.enrich(mesh.quadratic(plain)).element.name
        'Tri7'
    """
    if is_traced(mesh.cells):
        raise ValueError("quadratic: `mesh.cells` is traced. Make the mesh outside jit.")
    if mesh.element.name not in _QUADRATIC:
        raise ValueError(
            f"quadratic: got {mesh.element.name} cells, need one of {', '.join(_QUADRATIC)}. "
            "Quadratic cells are ready for `enrich`."
        )
    element, old = _QUADRATIC[mesh.element.name], np.asarray(mesh.cells)
    cells = with_side_nodes(np.zeros((mesh.num_nodes, 1)), old, element)[1]
    first = np.unique(cells[:, old.shape[1] :], return_index=True)[1]
    ends = old[:, side_ends(element)].reshape(-1, 2)[first]
    points = jnp.concatenate([mesh.points, jnp.mean(mesh.points[ends], axis=1)])
    rows = np.concatenate([cells[:, facet] for facet in element.facets])
    sets = {name: _found(rows, np.asarray(own)) for name, own in mesh.facet_sets.items()}
    nodes = {}
    for name, ids in mesh.node_sets.items():
        held = np.zeros(mesh.num_nodes, bool)
        held[np.asarray(ids)] = True
        middles = mesh.num_nodes + np.flatnonzero(held[ends].all(axis=1))
        nodes[name] = np.concatenate([np.asarray(ids), middles])
    return Mesh(points, cells, element, nodes, sets, mesh.regions)


def _found(rows: np.ndarray, facets: np.ndarray) -> np.ndarray:
    """Of the `rows`, facets of all cells, those with the corners of `facets`."""
    count = facets.shape[1]
    both = np.sort(np.concatenate([rows[:, :count], facets]), axis=1)
    key = np.unique(both, axis=0, return_inverse=True)[1].ravel()
    lookup = np.full(key.max(initial=0) + 1, -1)
    lookup[key[: len(rows)]] = np.arange(len(rows))
    place = lookup[key[len(rows) :]]
    if (place < 0).any():
        raise ValueError(
            f"quadratic: {int((place < 0).sum())} of {len(facets)} facets belong to no cell of "
            "the mesh. Take them from this mesh."
        )
    return rows[place]


def enrich(mesh: Mesh) -> Mesh:
    """`mesh` with a node at the centre of every cell, and of every face in space.

    Tri6 becomes Tri7, Quad8 Quad9 and Tet10 Tet15: the displacements that, with a pressure
    linear in each cell, neither lock nor oscillate in nearly incompressible rubber. The
    geometry is unchanged, and old nodes keep their numbers. A node set gains the centres of
    the faces, and of the cells, all of whose nodes it holds.

    Args:
        mesh: A mesh of `Tri6`, `Quad8` or `Tet10` cells.

    Returns:
        The mesh with more nodes.

    Raises:
        ValueError: If the mesh has other cells, or if they are traced.

    Example:
        >>> plain = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1), order=2)
        >>> mesh.enrich(plain).element.name, mesh.enrich(plain).num_nodes - plain.num_nodes
        ('Tri7', 8)

    Reference:
        Crouzeix and Raviart, Conforming and nonconforming finite element methods for solving
        the stationary Stokes equations, RAIRO 7 (R3), 1973.
    """
    if is_traced(mesh.cells):
        raise ValueError("enrich: `mesh.cells` is traced. Enrich the mesh outside jit.")
    richer = {kind.plain.name: kind() for kind in exported_elements() if kind.plain}
    if mesh.element.name not in richer:
        names = ", ".join(richer)
        how = " Make them so by `mesh.quadratic`." if mesh.element.name in _QUADRATIC else ""
        raise ValueError(f"enrich: got {mesh.element.name} cells, need one of {names}.{how}")
    element = richer[mesh.element.name]
    cells = np.asarray(mesh.cells)
    new = reference_nodes(element)[mesh.element.num_nodes :]
    xp = jnp if is_traced(mesh.points) else np  # NumPy has nothing to compile
    old = xp.asarray(mesh.points)
    at = shape_functions(mesh.element, new).astype(old.dtype)
    where = xp.einsum("an,cni->cai", at, old[cells])
    first, number = np.unique(_owners(mesh, element), return_index=True, return_inverse=True)[
        1:
    ]
    columns = mesh.num_nodes + number.reshape(len(cells), -1)
    points = from_host(xp.concatenate([old, where.reshape(-1, element.dim)[first]]))
    richer = Mesh(points, np.concatenate([cells, columns], axis=1), element)
    sets = {name: with_centres(richer, f) for name, f in mesh.facet_sets.items()}
    nodes = {name: _with_inner(mesh, columns, ids) for name, ids in mesh.node_sets.items()}
    return Mesh(points, richer.cells, element, nodes, sets, mesh.regions)


def _with_inner(mesh: Mesh, columns: np.ndarray, ids) -> np.ndarray:
    """A node set with the new nodes of faces and cells that lie in it."""
    inside = np.zeros(mesh.num_nodes, bool)
    inside[np.asarray(ids)] = True
    held = inside[np.asarray(mesh.cells)]
    faces = mesh.element.facets if mesh.element.dim == 3 else ()
    whole = [held[:, list(face)].all(axis=1) for face in faces] + [held.all(axis=1)]
    return np.concatenate([np.asarray(ids), np.unique(columns[np.stack(whole, axis=1)])])


def _owners(mesh: Mesh, element: AbstractElement) -> np.ndarray:
    """A number for each new node of each cell, equal where cells share the node."""
    cells = np.asarray(mesh.cells)
    own = mesh.num_nodes + np.arange(len(cells))[:, None]
    if element.dim == 2:
        return own
    count = facet_corners(element)
    faces = np.stack([np.sort(cells[:, f[:count]], axis=1) for f in element.facets], axis=1)
    shared = np.unique(faces.reshape(-1, count), axis=0, return_inverse=True)[1]
    return np.concatenate([shared.reshape(len(cells), -1), own + shared.max()], axis=1)


def with_centres(mesh: Mesh, facets) -> np.ndarray:
    """Facets of the mesh before it was enriched, with the node in the middle of each face."""
    facets = np.asarray(facets)
    if mesh.element.dim == 2 or not len(facets):
        return facets
    count = facet_corners(mesh.element)
    cells = np.asarray(mesh.cells)
    known = np.concatenate([cells[:, f[:count]] for f in mesh.element.facets])
    centres = np.concatenate([cells[:, f[-1]] for f in mesh.element.facets])
    both = np.concatenate([np.sort(known, axis=1), np.sort(facets[:, :count], axis=1)])
    key = np.unique(both, axis=0, return_inverse=True)[1].ravel()
    lookup = np.full(key.max() + 1, -1)
    lookup[key[: len(known)]] = centres
    found = lookup[key[len(known) :], None]
    if (found < 0).any():
        raise ValueError(
            f"enrich: {int((found < 0).sum())} of {len(facets)} facets belong to no cell of "
            "the mesh. Take them from this mesh, or from the one that it was enriched from."
        )
    return np.concatenate([facets, found], axis=1)
