"""The mesh: points, cells and named sets."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._arguments import sized
from sorojax._display import displayed, number
from sorojax._jax.trace_state import is_traced
from sorojax._types import integers, real
from sorojax.mesh.elements.base import AbstractElement, facet_corners, side_ends


def _int_sets(sets: dict[str, Any]) -> dict[str, jax.Array]:
    return {name: integers(ids) for name, ids in sets.items()}


@displayed
class Mesh(eqx.Module):
    """Cells of one element type over points, in the reference configuration.

    `cells` holds the numbers of the nodes of each cell in the order of `element`, the type of
    the cells, and `points` where the nodes are [m]. `node_sets` holds node numbers, `regions`
    cell numbers. `facet_sets` holds facets as their node numbers, `(facets, facet_nodes)`,
    corners first, in the plane with the domain on the left, in space counter-clockwise as seen
    from outside; then mid-side nodes. Only `points` can carry a gradient: topology is built
    outside any trace.
    """

    points: Float[Array, "nodes dim"] = eqx.field(converter=real)
    cells: Int[Array, "cells cell_nodes"] = eqx.field(converter=integers)
    element: AbstractElement
    node_sets: dict[str, Int[Array, " nodes"]] = eqx.field(
        converter=_int_sets, default_factory=dict
    )
    facet_sets: dict[str, Int[Array, "facets facet_nodes"]] = eqx.field(
        converter=_int_sets, default_factory=dict
    )
    regions: dict[str, Int[Array, " cells"]] = eqx.field(
        converter=_int_sets, default_factory=dict
    )

    def __check_init__(self):
        want = self.element.num_nodes
        if self.cells.ndim != 2 or self.cells.shape[1] != want:
            raise ValueError(
                f"Mesh: `cells` has shape {self.cells.shape}, {self.element.name} needs "
                f"(cells, {want}). List corners first, then mid-side nodes."
            )
        if self.points.ndim != 2 or self.points.shape[1] != self.element.dim:
            raise ValueError(
                f"Mesh: `points` has shape {self.points.shape}, {self.element.name} needs "
                f"(nodes, {self.element.dim})."
            )
        if not is_traced(self.cells) and self.cells.size:
            ids = np.asarray(self.cells)
            if ids.min() < 0 or ids.max() >= self.points.shape[0]:
                raise ValueError(
                    f"Mesh: `cells` names nodes {ids.min()} to {ids.max()}, "
                    f"but there are {self.points.shape[0]} points (0 to "
                    f"{self.points.shape[0] - 1}). Renumber the cells."
                )

    @property
    def num_nodes(self) -> int:
        return self.points.shape[0]

    @property
    def num_cells(self) -> int:
        return self.cells.shape[0]

    def _text(self) -> str:
        count = f"Mesh: {self.num_cells} {self.element.name} cells, {self.num_nodes} nodes"
        box = (
            f"{axis} {number(self.points[:, k])}"
            for k, axis in zip(range(self.element.dim), "xyz", strict=False)
        )
        rows = [count, f"  box [m]     {', '.join(box)}"]
        kinds = {
            "node sets": self.node_sets,
            "facet sets": self.facet_sets,
            "regions": self.regions,
        }
        for kind, sets in kinds.items():
            if sets:
                named = (f"{name} ({ids.shape[0]})" for name, ids in sets.items())
                rows.append(f"  {kind:<11} {', '.join(named)}")
        return "\n".join(rows)


@sized(Mesh)
def axis_lengths(mesh: Mesh) -> dict[str, int]:
    nodes, dim = mesh.points.shape[-2:]
    return {"nodes": nodes, "dim": dim, "cells": mesh.cells.shape[-2]}


def boundary_facets(mesh: Mesh) -> Int[np.ndarray, "facets facet_nodes"]:
    """Facets that belong to one cell only, outward as in `facet_sets` (host array).

    Args:
        mesh: The mesh.

    Returns:
        Nodes of the facets, one row per facet.
    """
    facets, first, count, _ = facet_table(mesh)
    return facets[np.sort(first[count == 1])]


def facet_table(mesh: Mesh):
    """All facets with repeats, `first` and `count` of the distinct ones, and which
    distinct facet each is: facet k belongs to cell k % num_cells."""
    cells = np.asarray(mesh.cells)
    facets = np.concatenate([cells[:, list(f)] for f in mesh.element.facets])
    corners = np.sort(facets[:, : facet_corners(mesh.element)], axis=1)
    keys = corners[:, 0].astype(np.int64)
    for column in corners.T[1:]:
        # Ranks keep the keys small: three node numbers may not fit 64 bits.
        keys = np.unique(keys, return_inverse=True)[1] * np.int64(mesh.num_nodes) + column
    # A padded polygon has sides from its last node to itself.
    _, first, number, count = np.unique(
        keys, return_index=True, return_inverse=True, return_counts=True
    )
    empty = (corners[:, 0] == corners[:, 1])[first] if mesh.element.dim == 2 else None
    return facets, first, count if empty is None else np.where(empty, 2, count), number


def valences(mesh: Mesh) -> Int[np.ndarray, " cells"]:
    """Corners of each cell; fewer than the element has where a polygon is padded."""
    cells = np.asarray(mesh.cells)[:, : mesh.element.num_corners]
    return 1 + (np.diff(cells, axis=1) != 0).sum(axis=1)


# Mid-side nodes on straight sides, for any quadratic cell


def with_side_nodes(
    points: np.ndarray, cells: np.ndarray, element: AbstractElement
) -> tuple[np.ndarray, np.ndarray]:
    """Points and cells of the quadratic `element` from those of its corners."""
    sides = side_ends(element)
    ends = np.sort(np.concatenate([cells[:, list(s)] for s in sides]), axis=1)
    n = len(points)
    keys, number = np.unique(ends[:, 0] * np.int64(n) + ends[:, 1], return_inverse=True)
    middles = points[np.stack(np.divmod(keys, n), axis=1)].mean(axis=1)
    columns = n + number.reshape(len(sides), -1).T
    return np.concatenate([points, middles]), np.concatenate([cells, columns], axis=1)


def nodes_between(
    cells: np.ndarray, element: AbstractElement, ends: np.ndarray
) -> Int[np.ndarray, "..."]:
    """Mid-side nodes of `cells` of a quadratic element between corners `ends` (.., 2)."""
    sides, n = side_ends(element), np.int64(cells.max() + 1)
    pairs = np.sort(np.concatenate([cells[:, list(s)] for s in sides]), axis=1)
    middles = cells[:, element.num_corners :][:, : len(sides)].T.ravel()
    order = np.argsort(pairs @ [n, 1])
    place = np.searchsorted((pairs @ [n, 1])[order], np.sort(ends, axis=-1) @ [n, 1])
    return middles[order][place]


# Several bodies as one mesh


def merge(**bodies: Mesh) -> Mesh:
    """One mesh of several bodies that share no nodes, for contact between them.

    `merge(finger=a, ball=b)` names the cells of each body in `regions`, its nodes in
    `node_sets`, and its sets "finger.top"; nodes keep their order, body after body.
    Differentiable in the points.

    Args:
        **bodies: Meshes by name.

    Returns:
        The mesh of all.

    Raises:
        ValueError: If there is no body, or the elements differ.
    """
    kinds = {type(body.element).__name__ for body in bodies.values()}
    if len(kinds) != 1:
        raise ValueError(
            f"mesh.merge: got bodies of {sorted(kinds)}, need one kind of cells for all. "
            "Mesh them alike."
        )
    nodes, cells, node_sets, facet_sets, regions = 0, [], {}, {}, {}
    num_cells = 0
    for name, body in bodies.items():
        cells.append(np.asarray(body.cells) + nodes)
        node_sets[name] = np.arange(nodes, nodes + body.num_nodes)
        regions[name] = np.arange(num_cells, num_cells + body.num_cells)
        node_sets |= {f"{name}.{key}": ids + nodes for key, ids in body.node_sets.items()}
        facet_sets |= {f"{name}.{key}": ids + nodes for key, ids in body.facet_sets.items()}
        regions |= {f"{name}.{key}": ids + num_cells for key, ids in body.regions.items()}
        nodes, num_cells = nodes + body.num_nodes, num_cells + body.num_cells
    points = jnp.concatenate([body.points for body in bodies.values()])
    element = next(iter(bodies.values())).element
    return Mesh(points, np.concatenate(cells), element, node_sets, facet_sets, regions)
